// What the device calculates at most: 16 independent chains of multiply-adds a thread, from registers.
// in   factor (one number, so that nothing is known to the compiler)
// out  result[thread]
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "common/index.glsl"

layout(push_constant) uniform Push {
    uint rounds;  // of 16 multiply-adds
} push;

layout(set = 0, binding = 0, std430) readonly buffer Factor { float factor[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Result { float result[]; };

void main() {
    const uint i = thread_index();
    const vec4 f = vec4(factor[0]), g = vec4(factor[1]);
    vec4 a = f, b = f + 1.0, c = f + 2.0, d = f + 3.0;
    for (uint k = 0; k < push.rounds; ++k) {
        a = fma(a, f, g);
        b = fma(b, f, g);
        c = fma(c, f, g);
        d = fma(d, f, g);
    }
    const vec4 sum = (a + b) + (c + d);
    result[i] = (sum.x + sum.y) + (sum.z + sum.w);
}
