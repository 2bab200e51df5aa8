// Replays the blend front to back and writes, for every intersection, the sum over its tile's pixels of
// the loss gradient: one slot has one writer, so there are no atomics and every run sums in the same order.
// in   ranges, intersections, owners, projected; grey (as rendered), grey_gradient
// out  isect_gradients[8 e + ..]: centre x, y; conic a, b, c; α dL/dα; grey; 0
//      α dL/dα = o dL/do where the cap does not bind: project_backward needs it as it is
// What lies behind Gaussian j is the rendered grey minus everything up to j.
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// variants: subgroup
#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#endif
layout(local_size_x = 32) in;

#include "../common/types.glsl"
#include "../common/index.glsl"
#include "../common/tiles.glsl"
#include "../common/lanes.glsl"
#include "../common/shade.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Ranges { uvec2 ranges[]; };
layout(set = 0, binding = 1, std430) readonly buffer Intersections { uint intersections[]; };
layout(set = 0, binding = 2, std430) readonly buffer Owners { uint owners[]; };
layout(set = 0, binding = 3, std430) readonly buffer ProjectedIn { Projected projected[]; };
layout(set = 0, binding = 4, std430) readonly buffer Grey { float grey[]; };
layout(set = 0, binding = 5, std430) readonly buffer GreyGradient { float grey_gradient[]; };
layout(set = 0, binding = 6, std430) writeonly buffer IsectGradients { float isect_gradients[]; };

void main() {
    const uint tile = tile_index();
    const uvec2 grid = tile_grid(push.size);
    if (tile >= grid.x * grid.y) {
        return;
    }
    const uvec2 pixel = column_of(tile, push.size);
    const vec2 top = vec2(pixel) + 0.5;
    float t[COLUMN], behind[COLUMN], v[COLUMN];
    [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
        const bool inside = pixel.x < push.size.x && pixel.y + k < push.size.y;
        const uint at = inside ? (pixel.y + k) * push.size.x + pixel.x : 0;
        t[k] = inside ? 1.0 : 0.0;
        behind[k] = grey[at];
        v[k] = grey_gradient[at];
    }
    const uvec2 range = ranges[tile];
    uint base = range.x;
    for (; base < range.y; base += LANES) {
        const uint isect = intersections[min(base + lane(), range.y - 1)];
        const Projected g = projected[owners[isect]];
        batch_put(g.centre_conic, vec4(g.conic_shade.x, log2(g.conic_shade.y), g.conic_shade.zw), isect);
        const uint n = min(LANES, range.y - base);
        for (uint j = 0; j < n; ++j) {
            const Batch b = batch_get(j);
            const Column s = column_terms(b, top);
            // Moments of v_σ = -α dL/dα over the column, and the grey gradient.
            float s0 = 0.0, s1 = 0.0, s2 = 0.0, shade = 0.0;
            [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
                const float dy = s.d.y - float(k);
                const float raw = alpha_at(s, dy);
                const float alpha = effective(raw, t[k]);
                const float w = alpha * t[k];
                const float after = t[k] - w;
                const float seen = w * s.grey;
                behind[k] -= seen;
                shade += w * v[k];
                // (1 - α) is at least 0.01 and T > TRANSMITTANCE_MIN before, so w / after is bounded.
                const float ratio = w > 0.0 ? alpha / (1.0 - alpha) : 0.0;
                const float v_sigma = raw > ALPHA_MAX ? 0.0 : v[k] * (behind[k] * ratio - seen);
                s0 += v_sigma;
                s1 += v_sigma * dy;
                s2 += v_sigma * dy * dy;
                t[k] = after;
            }
            const float xs = s.d.x * s0;
            const float sum = sum_of_eight(float[8](s.conic.x * xs + s.conic.y * s1, s.conic.y * xs + s.conic.z * s1,
                                                    0.5 * s.d.x * xs, s.d.x * s1, 0.5 * s2, -s0, shade, 0.0));
            if (lane() < 8) {
                isect_gradients[b.slot * 8 + lane()] = sum;
            }
        }
        float clearest = t[0];
        [[unroll]] for (uint k = 1; k < COLUMN; ++k) {
            clearest = max(clearest, t[k]);
        }
        if (all_lanes(clearest <= TRANSMITTANCE_MIN)) {
            base += LANES;
            break;
        }
    }
    // Those behind an opaque tile got nothing.
    for (uint i = base * 8 + lane(); i < range.y * 8; i += LANES) {
        isect_gradients[intersections[i / 8] * 8 + i % 8] = 0.0;
    }
}
