// The gradients of one Gaussian's intersections lie in a row, one slot each. A row of CHUNK slots from a multiple of
// CHUNK on that are all one Gaussian's is a chunk, which sum_chunks.comp sums in place.

layout(constant_id = 8) const uint CHUNK = 16;  // 1: there are none
const uint WORTH = 5;  // word of a slot: α dL/dα

/// How many slots the one at `i` stands for, of a Gaussian whose last is before `end`.
uint slots_at(uint i, uint end) {
    return i % CHUNK == 0 && i + CHUNK <= end ? CHUNK : 1;
}
