// The colour of each visible Gaussian towards the eye, where it is more than one grey level: one thread a rank.
// in   visible_count, slots (by depth), splats (the first channel's constant), coefficients
// out  projected: its shade, grey or red; tints: green and blue
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/harmonics.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    vec4 eye;  // world, m
} push;

layout(set = 0, binding = 0, std430) readonly buffer VisibleCount { uint visible_count[]; };
layout(set = 0, binding = 1, std430) readonly buffer Slots { uint slots[]; };
layout(set = 0, binding = 2, std430) readonly buffer Splats { Splat splats[]; };
layout(set = 0, binding = 3, std430) readonly buffer Coefficients { float coefficients[]; };
layout(set = 0, binding = 4, std430) buffer ProjectedInOut { Projected projected[]; };
layout(set = 0, binding = 5, std430) writeonly buffer Tints { vec2 tints[]; };

void main() {
    const uint rank = thread_index();
    if (rank >= visible_count[0]) {
        return;
    }
    const uint slot = slots[rank], base = slot * EXTRA;
    float c[3] = float[3](splats[slot].scale_colour.w, 0.0, 0.0);
    for (uint channel = 1; channel < CHANNELS; ++channel) {
        c[channel] = coefficients[base + channel - 1];
    }
    if (DEGREE > 0) {
        const float b[BASIS_MAX] = basis_of(normalize(splats[slot].mean_opacity.xyz - push.eye.xyz));
        for (uint k = 0; k < BASIS; ++k) {
            for (uint channel = 0; channel < CHANNELS; ++channel) {
                c[channel] += b[k] * coefficients[base + coefficient(k, channel)];
            }
        }
        projected[slot].conic_shade.z = c[0];
    }
    if (CHANNELS == 3) {
        tints[slot] = vec2(c[1], c[2]);
    }
}
