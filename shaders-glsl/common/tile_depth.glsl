// What an intersection is listed by, and how it is sorted. The numbers of tiles, slots and intersections are bounded by Shape::check.

/// An intersection that there is not.
const uint NOWHERE = 0xffffffffu;
const uint INTERSECTION_BITS = 26;

/// Positive floats order as their bits. 16 are kept: 2.4e-4 of the depth, up to 3 km; what is nearer to each other stays in the order of
/// slots.
uint depth_key(float z) {
    return min((floatBitsToUint(max(z, NEAR)) - floatBitsToUint(NEAR)) >> 11, 0xffffu);
}

uint tile_and_depth(uint tile, uint depth) {
    return tile << 16 | depth;
}

uint tile_of(uint tile_depth) {
    return tile_depth >> 16;
}

/// Element of a list: 16 bits of depth, 22 of the slot, the intersection.
uvec2 element_of(uint tile_depth, uint slot, uint isect) {
    return uvec2(tile_depth << 16 | slot >> 6, slot << INTERSECTION_BITS | isect);
}

uint intersection_of(uvec2 element) {
    return element.y & ((1u << INTERSECTION_BITS) - 1);
}

bool before(uvec2 a, uvec2 b) {
    return a.x < b.x || (a.x == b.x && a.y < b.y);
}
