// Joins neighbours whose disparities are close into regions. One thread a pixel.
// in   disparity
// out  labels: trees, see labels.glsl
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    float close;  // px
} push;

layout(set = 0, binding = 0, std430) readonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 1, std430) coherent buffer Labels { uint labels[]; };

#include "labels.glsl"

void main() {
    const uint i = thread_index();
    if (i >= push.size.x * push.size.y || disparity[i] < 0.0) {
        return;
    }
    if (i % push.size.x + 1 < push.size.x && disparity[i + 1] >= 0.0
            && abs(disparity[i + 1] - disparity[i]) <= push.close) {
        join(i, i + 1);
    }
    if (i / push.size.x + 1 < push.size.y && disparity[i + push.size.x] >= 0.0
            && abs(disparity[i + push.size.x] - disparity[i]) <= push.close) {
        join(i, i + push.size.x);
    }
}
