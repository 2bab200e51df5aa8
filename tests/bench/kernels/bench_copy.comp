// What the device moves at most: 16 bytes a thread, read and written in order.
// in   from
// out  to
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "common/index.glsl"

layout(push_constant) uniform Push {
    uint quads;
} push;

layout(set = 0, binding = 0, std430) readonly buffer From { vec4 from[]; };
layout(set = 0, binding = 1, std430) writeonly buffer To { vec4 to[]; };

void main() {
    const uint i = thread_index();
    if (i < push.quads) {
        to[i] = from[i];
    }
}
