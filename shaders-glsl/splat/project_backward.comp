// Sums each visible Gaussian's intersection gradients in fixed order, carries them back to its parameters
// and to the camera pose, adds the regularisers, and takes one Adam step: one thread a slot.
// in   counts, runs, isect_gradients (slots of raster_backward, chunks summed by sum_chunks)
// out  splats, moments, steps (count and importance of this Gaussian, see importance.glsl); sums[8 group + ..]: gradient by a small
//      translation (3) and rotation (3) of the camera frame applied to points, count of refused gradients, 0
// A step whose gradient is not finite is not taken, and counted. What a view hardly shows takes none. Without LEARN, or where the list overflowed, no step is
// taken and the map stays as it is to the bit: only the sums are written.
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(constant_id = 2) const uint CHANNELS = 1;
layout(constant_id = 7) const bool LEARN = true;

#include "../common/types.glsl"
#include "../common/camera.glsl"
#include "../common/backward.glsl"
#include "../common/index.glsl"
#include "../common/importance.glsl"
#include "../common/chunks.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    Camera camera;
    uvec2 size;
    uint splats;              // end of the slots
    uint capacity;            // intersections
    float rate_position;      // Adam step sizes: m, ln m, 1, logit, grey
    float rate_scale;
    float rate_rotation;
    float rate_opacity;
    float rate_colour;
    float weight_needle;      // regularisers, mean over the visible: see regularise()
    float weight_scale;
    float log_scale_soft;     // ln m
    float weight_opacity;
} push;

layout(set = 0, binding = 0, std430) readonly buffer CountsIn { Counts counts[]; };
READ_UVEC2S(1, Runs, run_of)
READ_VEC4S(2, IsectGradients, isect_gradient)
layout(set = 0, binding = 3, std430) buffer Splats { Splat splats[]; };
layout(set = 0, binding = 4, std430) buffer MomentsInOut { Moments moments[]; };
layout(set = 0, binding = 5, std430) buffer Steps { uint steps[]; };
layout(set = 0, binding = 6, std430) writeonly buffer Sums { float sums[]; };

const uint SLOT_QUADS = CHANNELS == 3 ? 3 : 2;
const float BETA1 = 0.9;
const float BETA2 = 0.999;
const float EPSILON = 1e-15;
const float NEEDLE_LOG_RATIO = 1.0986123;  // ln 3: discs are free, needles are not

/// Gradient by log scale of: how far the longest axis exceeds three times the second, and a soft bound.
vec3 regularise(vec3 log_scale, float per_splat) {
    const vec3 l = log_scale;
    const int longest = l.x >= l.y ? (l.x >= l.z ? 0 : 2) : (l.y >= l.z ? 1 : 2);
    const int next = (longest + 1) % 3, last = (longest + 2) % 3;
    const int second = l[next] >= l[last] ? next : last;
    vec3 g = vec3(0.0);
    if (l[longest] - l[second] > NEEDLE_LOG_RATIO) {
        g[longest] += push.weight_needle * per_splat;
        g[second] -= push.weight_needle * per_splat;
    }
    if (l[longest] > push.log_scale_soft) {
        g[longest] += push.weight_scale * per_splat;
    }
    return g;
}

vec4 adam(inout vec4 m, inout vec4 v, vec4 g, vec4 rate, vec2 debias) {
    m = BETA1 * m + (1.0 - BETA1) * g;
    v = BETA2 * v + (1.0 - BETA2) * g * g;
    return rate * (m * debias.x) / (sqrt(v * debias.y) + EPSILON);
}

/// Takes the step; the six pose terms, or a one in the seventh place.
float[7] update(uint slot) {
    float pose[7] = float[7](0, 0, 0, 0, 0, 0, 0);
    const uint begin = run_of(slot).x, end = run_of(slot).y;
    vec4 v0 = vec4(0.0), v1 = vec4(0.0);
    // Visibility x opacity x gradient, tile by tile: to first order, what the loss would change without it.
    float worth = 0.0;
    for (uint i = begin, n; i < end; i += n) {
        n = slots_at(i, end);
        const vec4 second = isect_gradient(SLOT_QUADS * i + 1);
        v0 += isect_gradient(SLOT_QUADS * i);
        v1 += second;
        worth += n == 1 ? abs(second[WORTH - 4]) : isect_gradient(SLOT_QUADS * (i + 1)).x;
    }
    // Where nothing is compared there is nothing to learn.
    if (begin >= end || worth == 0.0) {
        return pose;
    }
    Splat s = splats[slot];
    Local l;
    if (!place(push.camera, s, l)) {  // project rounded it in
        return pose;
    }
    flatten(push.camera, vec2(push.size), l);
    Gradient g = pull_back(push.camera, l, s.scale_colour.xyz, v0.xy, vec3(v0.zw, v1.x));
    const float per_splat = 1.0 / float(counts[0].visible);
    const float opacity = sigmoid(s.mean_opacity.w);
    const float v_logit = (1.0 - opacity) * (v1.y + push.weight_opacity * per_splat * opacity);
    const vec4 d0 = vec4(transpose(cam_from_world(push.camera)) * g.cam, v_logit);
    const vec4 d1 = vec4(g.scale + regularise(s.scale_colour.xyz, per_splat), v1.z);
    if (!(finite(d0) && finite(d1) && finite(g.quat) && finite(vec4(g.turn, 0.0)))) {
        pose[6] = 1.0;
        return pose;
    }
    const vec3 turn = cross(l.p, g.cam) + g.turn;
    pose = float[7](g.cam.x, g.cam.y, g.cam.z, turn.x, turn.y, turn.z, 0.0);

    // A list that lost Gaussians shows holes, which are nothing to learn from.
    const bool whole = counts[0].needed <= push.capacity;
    if (!(LEARN && whole) || !shown(steps[slot], worth)) {
        return pose;
    }
    const uint state = after_step(steps[slot], worth);
    const vec2 debias = 1.0 / (1.0 - exp2(float(steps_of(state)) * log2(vec2(BETA1, BETA2))));
    Moments a = moments[slot];
    s.mean_opacity -= adam(a.m[0], a.v[0], d0, vec4(vec3(push.rate_position), push.rate_opacity), debias);
    s.scale_colour -= adam(a.m[1], a.v[1], d1, vec4(vec3(push.rate_scale), push.rate_colour), debias);
    s.quat -= adam(a.m[2], a.v[2], g.quat, vec4(push.rate_rotation), debias);
    s.scale_colour.w = clamp(s.scale_colour.w, 0.0, COLOUR_MAX);
    s.scale_colour.xyz = clamp(s.scale_colour.xyz, LOG_SCALE_MIN, LOG_SCALE_MAX);
    s.quat /= max(length(s.quat), 1e-3);
    // A square beyond f32 would leave a moment that never comes down.
    const bool settled = finite(a.v[0]) && finite(a.v[1]) && finite(a.v[2]);
    if (!(settled && finite(s.mean_opacity) && finite(s.scale_colour) && finite(s.quat))) {
        pose[6] = 1.0;
        return pose;
    }
    splats[slot] = s;
    moments[slot] = a;
    steps[slot] = state;
    return pose;
}

shared float terms[7 * 65];

void main() {
    const uint slot = thread_index(), i = gl_LocalInvocationID.x;
    float pose[7] = float[7](0, 0, 0, 0, 0, 0, 0);
    if (slot < push.splats) {
        pose = update(slot);
    }
    [[unroll]] for (uint q = 0; q < 7; ++q) {
        terms[q * 65 + i] = pose[q];
    }
    barrier();
    if (i < 8) {
        float sum = 0.0;
        for (uint k = 0; k < 64 && i < 7; ++k) {
            sum += terms[i * 65 + k];
        }
        sums[group_index() * 8 + i] = sum;
    }
}
