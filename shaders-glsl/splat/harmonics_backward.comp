// Sums each visible Gaussian's gradients by colour in fixed order and takes one Adam step on the coefficients beyond its
// record; the record's constant and the position are project_backward's, which runs next: one thread a rank.
// in   visible_count, slots (by depth), tile_offsets, splats, steps (before this one)
// out  coefficients, coefficient_moments (first, second); isect_gradients: of each Gaussian's first slot, words 8 to 10
//      become the gradient by its position through the direction it is seen in
// A step whose gradient is not finite is not taken; project_backward counts it. Without LEARN none is.
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;
layout(constant_id = 7) const bool LEARN = true;

#include "../common/types.glsl"
#include "../common/finite.glsl"
#include "../common/worth.glsl"
#include "../common/harmonics.glsl"
#include "../common/index.glsl"
#include "../common/chunks.glsl"

layout(push_constant) uniform Push {
    vec4 eye;  // world, m
    uint capacity;         // intersections
    float rate_colour;     // of the constants
    float rate_harmonics;  // of the rest
} push;

layout(set = 0, binding = 0, std430) readonly buffer VisibleCount { uint visible_count[]; };
layout(set = 0, binding = 1, std430) readonly buffer Slots { uint slots[]; };
layout(set = 0, binding = 2, std430) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(set = 0, binding = 3, std430) readonly buffer Splats { Splat splats[]; };
layout(set = 0, binding = 4, std430) readonly buffer Steps { uint steps[]; };
layout(set = 0, binding = 5, std430) buffer IsectGradients { vec4 isect_gradients[]; };
layout(set = 0, binding = 6, std430) buffer Coefficients { float coefficients[]; };
layout(set = 0, binding = 7, std430) buffer CoefficientMoments { vec2 coefficient_moments[]; };

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;

float descend(uint at, float g, float rate, vec2 debias) {
    if (!LEARN) {
        return coefficients[at];
    }
    const vec2 old = coefficient_moments[at];
    const vec2 m = vec2(BETA1 * old.x + (1.0 - BETA1) * g, BETA2 * old.y + (1.0 - BETA2) * g * g);
    const float c = coefficients[at], next = c - rate * m.x * debias.x / (sqrt(m.y * debias.y) + EPSILON);
    if (!(finite(next) && finite(m.y))) {
        return c;
    }
    coefficient_moments[at] = m;
    return next;
}

void main() {
    const uint rank = thread_index();
    if (rank >= visible_count[0]) {
        return;
    }
    const uint begin = tile_offsets[rank], end = min(tile_offsets[rank + 1], push.capacity);
    float v[3] = float[3](0.0, 0.0, 0.0);
    for (uint i = begin; i < end; i += slots_at(i, end)) {
        v[0] += isect_gradients[3 * i + 1].z;
        if (CHANNELS == 3) {
            const vec2 tint = isect_gradients[3 * i + 2].xy;
            v[1] += tint.x;
            v[2] += tint.y;
        }
    }
    if (begin >= end) {
        return;
    }
    const uint slot = slots[rank], base = slot * EXTRA;
    const uint step = min(steps_of(steps[slot]) + 1, STEPS_MAX);
    const vec2 debias = 1.0 / (1.0 - exp2(float(step) * log2(vec2(BETA1, BETA2))));
    for (uint channel = 1; channel < CHANNELS; ++channel) {
        const uint at = base + channel - 1;
        coefficients[at] = clamp(descend(at, v[channel], push.rate_colour, debias), 0.0, COLOUR_MAX);
    }
    if (DEGREE > 0) {
        const vec3 away = splats[slot].mean_opacity.xyz - push.eye.xyz;
        const float distance = length(away);
        const vec3 d = away / distance;
        const float b[BASIS_MAX] = basis_of(d);
        float w[BASIS_MAX];
        for (uint k = 0; k < BASIS; ++k) {
            w[k] = 0.0;
            for (uint channel = 0; channel < CHANNELS; ++channel) {
                const uint at = base + coefficient(k, channel);
                w[k] += v[channel] * coefficients[at];
                coefficients[at] = descend(at, v[channel] * b[k], push.rate_harmonics, debias);
            }
        }
        const vec3 slope = slope_of(d, w);
        isect_gradients[3 * begin + 2] = vec4((slope - d * dot(d, slope)) / distance, 0.0);
    }
}
