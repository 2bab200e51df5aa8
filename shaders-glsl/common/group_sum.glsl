// Sum over a workgroup, whose size is a power of two, in a fixed order; all invocations must call it.

shared float group_sum_terms[gl_WorkGroupSize.x];

float group_sum(float v) {
    const uint i = gl_LocalInvocationID.x;
    barrier();
    group_sum_terms[i] = v;
    for (uint half_width = gl_WorkGroupSize.x / 2; half_width > 0; half_width /= 2) {
        barrier();
        if (i < half_width) {
            group_sum_terms[i] += group_sum_terms[i + half_width];
        }
    }
    barrier();
    return group_sum_terms[0];
}
