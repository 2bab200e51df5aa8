// Sums each visible Gaussian's gradients by green and blue in fixed order and takes one Adam step on them; the first level
// of its colour is project_backward's, which runs next and counts the step: one thread a rank. Colour maps only.
// in   visible_count, slots (by depth), tile_offsets, steps (before this one), isect_gradients
// out  chroma, chroma_moments (first of both, second of both)
// A step that is not finite is not taken; project_backward counts it. What a view hardly shows takes none.
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/finite.glsl"
#include "../common/importance.glsl"
#include "../common/index.glsl"
#include "../common/chunks.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uint capacity;  // intersections
    float rate;
} push;

READ_UINTS(0, VisibleCount, visible_count)
READ_UINTS(1, Slots, slot_of)
READ_UINTS(2, TileOffsets, tile_offset)
READ_UINTS(3, Steps, step_state)
READ_VEC4S(4, IsectGradients, isect_gradient)
layout(set = 0, binding = 5, std430) buffer Chroma { vec2 chroma[]; };
layout(set = 0, binding = 6, std430) buffer ChromaMoments { vec4 chroma_moments[]; };

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;

void main() {
    const uint rank = thread_index();
    if (rank >= visible_count(0)) {
        return;
    }
    const uint begin = tile_offset(rank), end = min(tile_offset(rank + 1), push.capacity);
    // A list that lost Gaussians shows holes, which are nothing to learn from.
    if (begin >= end || tile_offset(visible_count(0)) > push.capacity) {
        return;
    }
    vec2 g = vec2(0.0);
    float worth = 0.0;
    for (uint i = begin, n; i < end; i += n) {
        n = slots_at(i, end);
        g += isect_gradient(3 * i + 2).xy;
        worth += n == 1 ? abs(isect_gradient(3 * i + 1)[WORTH - 4]) : isect_gradient(3 * (i + 1)).x;
    }
    const uint slot = slot_of(rank), step = min(steps_of(step_state(slot)) + 1, STEPS_MAX);
    // As project_backward does.
    if (worth == 0.0 || !shown(step_state(slot), worth)) {
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
