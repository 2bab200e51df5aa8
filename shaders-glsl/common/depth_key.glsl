// Keys that sort visible Gaussians front to back.

const uint DEPTH_BITS = 16;
/// Not visible: left out by the sort.
const uint NONE = 0xffffffffu;

/// Positive floats order as their bits. Cut to DEPTH_BITS: 2.4e-4 of the depth, up to 3 km; equal keys stay in slot
/// order. The sort takes 8 bits a pass.
uint depth_key(float z) {
    return min((floatBitsToUint(max(z, NEAR)) - floatBitsToUint(NEAR)) >> 11, (1u << DEPTH_BITS) - 1);
}
