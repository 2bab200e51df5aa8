// Disparity of each pixel of the right image, from the left image's sums: pixel (x, y) there is (x + d, y) here. One thread
// a pixel; of equal sums the nearest to zero.
// in   sums: 16 bit, a pixel's disparities in a row
// out  right
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint disparities;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Sums { uint sums[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Right { uint right[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.size.x * push.size.y) {
        return;
    }
    const uint n = min(push.disparities, push.size.x - i % push.size.x), words = push.disparities / 2;
    uint least = 0xffffffffu, best = 0;
    for (uint d = 0; d < n; ++d) {
        const uint sum = (sums[(i + d) * words + d / 2] >> (16 * (d & 1u))) & 0xffffu;
        if (sum < least) {
            least = sum;
            best = d;
        }
    }
    right[i] = best;
}
