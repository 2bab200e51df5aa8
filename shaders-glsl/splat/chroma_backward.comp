// Sums each visible Gaussian's gradients by green and blue in fixed order and takes one Adam step on them; the first level
// of its colour is project_backward's, which runs next and counts the step: one thread a rank. Colour maps only.
// in   visible_count, slots (by depth), tile_offsets, steps (before this one), isect_gradients
// out  chroma, chroma_moments (first of both, second of both)
// A step that is not finite is not taken; project_backward counts it. What a view hardly shows takes none.
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/finite.glsl"
#include "../common/importance.glsl"
#include "../common/index.glsl"
#include "../common/chunks.glsl"

layout(push_constant) uniform Push {
    uint capacity;  // intersections
    float rate;
} push;

layout(set = 0, binding = 0, std430) readonly buffer VisibleCount { uint visible_count[]; };
layout(set = 0, binding = 1, std430) readonly buffer Slots { uint slots[]; };
layout(set = 0, binding = 2, std430) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(set = 0, binding = 3, std430) readonly buffer Steps { uint steps[]; };
layout(set = 0, binding = 4, std430) readonly buffer IsectGradients { vec4 isect_gradients[]; };
layout(set = 0, binding = 5, std430) buffer Chroma { vec2 chroma[]; };
layout(set = 0, binding = 6, std430) buffer ChromaMoments { vec4 chroma_moments[]; };

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;

void main() {
    const uint rank = thread_index();
    if (rank >= visible_count[0]) {
        return;
    }
    const uint begin = tile_offsets[rank], end = min(tile_offsets[rank + 1], push.capacity);
    // A list that lost Gaussians shows holes, which are nothing to learn from.
    if (begin >= end || tile_offsets[visible_count[0]] > push.capacity) {
        return;
    }
    vec2 g = vec2(0.0);
    float worth = 0.0;
    for (uint i = begin, n; i < end; i += n) {
        n = slots_at(i, end);
        g += isect_gradients[3 * i + 2].xy;
        worth += n == 1 ? abs(isect_gradients[3 * i + 1][WORTH - 4]) : isect_gradients[3 * (i + 1)].x;
    }
    const uint slot = slots[rank], step = min(steps_of(steps[slot]) + 1, STEPS_MAX);
    // As project_backward does.
    if (worth == 0.0 || !shown(steps[slot], worth)) {
        return;
    }
    const vec2 debias = 1.0 / (1.0 - exp2(float(step) * log2(vec2(BETA1, BETA2))));
    const vec4 old = chroma_moments[slot];
    const vec2 m = BETA1 * old.xy + (1.0 - BETA1) * g, v = BETA2 * old.zw + (1.0 - BETA2) * g * g;
    const vec2 next = chroma[slot] - push.rate * m * debias.x / (sqrt(v * debias.y) + EPSILON);
    if (finite(vec4(next, v))) {
        chroma[slot] = clamp(next, 0.0, COLOUR_MAX);
        chroma_moments[slot] = vec4(m, v);
    }
}
