// Forgets the disparities of regions that are too small: islands of wrong matches, not things. One thread a pixel.
// in   labels (roots), areas
// out  disparity
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint pixels;
    uint area_min;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Labels { uint labels[]; };
layout(set = 0, binding = 1, std430) readonly buffer Areas { uint areas[]; };
layout(set = 0, binding = 2, std430) buffer Disparity { float disparity[]; };

void main() {
    const uint i = thread_index();
    if (i < push.pixels && disparity[i] >= 0.0 && areas[labels[i]] < push.area_min) {
        disparity[i] = -1.0;
    }
}
