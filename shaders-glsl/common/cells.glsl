// Cells of space in a table of fixed size: a cell has two places, by two hashes, and in them a tag.

const uint FREE = 0xffffffffu;

/// Finaliser of MurmurHash3.
uint mixed(uint h) {
    h = (h ^ (h >> 16)) * 0x85ebca6bu;
    h = (h ^ (h >> 13)) * 0xc2b2ae35u;
    return h ^ (h >> 16);
}

struct Cell {
    uvec2 places;
    uint tag;
};

/// `mask` is the number of places less one.
Cell cell_of(vec3 p, float per_metre, uint mask) {
    const uvec3 c = uvec3(ivec3(floor(p * per_metre)));
    const uint key = mixed(c.x ^ mixed(c.y ^ mixed(c.z + 1)));
    return Cell(uvec2(key, mixed(key + 1)) & mask, min(mixed(key + 2), FREE - 1));
}
