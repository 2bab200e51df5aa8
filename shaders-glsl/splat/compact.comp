// Lists the visible slots with their depth keys, in slot order: equal depths sort the same in every run.
// in   projected, visible_offsets (exclusive prefix sum of `visible`, one longer than the pool)
// out  keys, slots; visible_count[0]
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/camera.glsl"
#include "../common/index.glsl"

const uint DEPTH_BITS = 22;

layout(push_constant) uniform Push {
    uint splats;
} push;

layout(set = 0, binding = 0, std430) readonly buffer ProjectedIn { Projected projected[]; };
layout(set = 0, binding = 1, std430) readonly buffer VisibleOffsets { uint visible_offsets[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 3, std430) writeonly buffer Slots { uint slots[]; };
layout(set = 0, binding = 4, std430) writeonly buffer VisibleCount { uint visible_count[]; };

/// Positive floats order as their bits. Cut to DEPTH_BITS: 4e-6 of the depth, up to 3 km.
uint depth_key(float z) {
    return min((floatBitsToUint(z) - floatBitsToUint(NEAR)) >> 5, (1u << DEPTH_BITS) - 1);
}

void main() {
    const uint slot = thread_index();
    if (slot >= push.splats) {
        if (slot == push.splats) {
            visible_count[0] = visible_offsets[slot];
        }
        return;
    }
    const uint at = visible_offsets[slot], next = visible_offsets[slot + 1];
    if (next != at) {
        keys[at] = depth_key(projected[slot].conic_shade.w);
        slots[at] = slot;
    }
}
