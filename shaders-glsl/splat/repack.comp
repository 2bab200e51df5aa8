// Closes the gaps of an array over the pool, whatever its elements: one thread a word. Slots only move down and keep
// their order, so a run of slots is lifted into scratch, then set down where it belongs, before the next is lifted.
// in   kept_offsets (exclusive prefix sum of what prune kept, one longer than the pool)
// out  words, scratch
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint first;   // slot
    uint count;   // slots
    uint stride;  // words a slot
    uint lift;    // 1: words -> scratch; 0: scratch -> words
} push;

layout(set = 0, binding = 0, std430) readonly buffer KeptOffsets { uint kept_offsets[]; };
layout(set = 0, binding = 1, std430) buffer Words { uint words[]; };
layout(set = 0, binding = 2, std430) buffer Scratch { uint scratch[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.count * push.stride) {
        return;
    }
    const uint slot = push.first + i / push.stride, word = i % push.stride;
    if (push.lift != 0) {
        scratch[i] = words[slot * push.stride + word];
        return;
    }
    const uint to = kept_offsets[slot];
    if (kept_offsets[slot + 1] != to) {
        words[to * push.stride + word] = scratch[i];
    }
}
