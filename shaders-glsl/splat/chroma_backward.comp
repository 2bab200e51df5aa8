// Sums each visible Gaussian's gradients by green and blue in fixed order and takes one Adam step on them; the first level
// of its colour is project_backward's, which runs next and counts the step: one thread a slot. Colour maps only.
// in   counts, runs, steps (before this one), isect_gradients
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
    uint splats;    // end of the slots
    uint capacity;  // intersections
    float rate;
} push;

layout(set = 0, binding = 0, std430) readonly buffer CountsIn { Counts counts[]; };
READ_UVEC2S(1, Runs, run_of)
READ_UINTS(2, Steps, step_state)
READ_VEC4S(3, IsectGradients, isect_gradient)
layout(set = 0, binding = 4, std430) buffer Chroma { vec2 chroma[]; };
layout(set = 0, binding = 5, std430) buffer ChromaMoments { vec4 chroma_moments[]; };

const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;

void main() {
    const uint slot = thread_index();
    if (slot >= push.splats) {
        return;
    }
    const uint begin = run_of(slot).x, end = run_of(slot).y;
    // A list that lost Gaussians shows holes, which are nothing to learn from.
    if (begin >= end || counts[0].needed > push.capacity) {
        return;
    }
    vec2 g = vec2(0.0);
    float worth = 0.0;
    for (uint i = begin, n; i < end; i += n) {
        n = slots_at(i, end);
        g += isect_gradient(3 * i + 2).xy;
        worth += n == 1 ? abs(isect_gradient(3 * i + 1)[WORTH - 4]) : isect_gradient(3 * (i + 1)).x;
    }
    const uint step = min(steps_of(step_state(slot)) + 1, STEPS_MAX);
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
