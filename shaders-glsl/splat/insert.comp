// Puts new Gaussians into given slots and clears their training state: one thread each.
// in   arrivals, arrival_slots
// out  splats, moments, steps
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint arrivals;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Arrivals { Splat arrivals[]; };
layout(set = 0, binding = 1, std430) readonly buffer ArrivalSlots { uint arrival_slots[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Splats { Splat splats[]; };
layout(set = 0, binding = 3, std430) writeonly buffer MomentsOut { Moments moments[]; };
layout(set = 0, binding = 4, std430) writeonly buffer Steps { uint steps[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.arrivals) {
        return;
    }
    const uint slot = arrival_slots[i];
    splats[slot] = arrivals[i];
    for (int k = 0; k < 3; ++k) {
        moments[slot].m[k] = vec4(0.0);
        moments[slot].v[k] = vec4(0.0);
    }
    steps[slot] = 0;
}
