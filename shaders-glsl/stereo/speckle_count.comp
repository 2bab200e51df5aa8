// Counts the pixels of each region at its root. One thread a pixel.
// in   disparity, labels (each pixel's becomes its root)
// out  areas, cleared before
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint pixels;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 1, std430) coherent buffer Labels { uint labels[]; };
layout(set = 0, binding = 2, std430) buffer Areas { uint areas[]; };

#include "labels.glsl"

void main() {
    const uint i = thread_index();
    if (i >= push.pixels || disparity[i] < 0.0) {
        return;
    }
    const uint root = root_of(i);
    labels[i] = root;
    atomicAdd(areas[root], 1);
}
