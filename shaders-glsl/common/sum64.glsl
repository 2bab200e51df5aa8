// Sum over a workgroup of 64 in a fixed order; all invocations must call it.

shared float sum64_terms[64];

float sum64(float v) {
    const uint i = gl_LocalInvocationID.x;
    barrier();
    sum64_terms[i] = v;
    for (uint half_width = 32; half_width > 0; half_width /= 2) {
        barrier();
        if (i < half_width) {
            sum64_terms[i] += sum64_terms[i + half_width];
        }
    }
    barrier();
    return sum64_terms[0];
}
