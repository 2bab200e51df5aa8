// Finiteness by exponent bits: float comparisons with NaN may be reordered by a compiler, integers not.

bool finite(float x) {
    return (floatBitsToUint(x) & 0x7f800000u) != 0x7f800000u;
}

bool finite(vec4 v) {
    const uvec4 e = floatBitsToUint(v) & 0x7f800000u;
    return all(notEqual(e, uvec4(0x7f800000u)));
}
