// Replays the blend front to back and writes, for every intersection, the sum over its tile's pixels of
// the loss gradient: one slot has one writer, so there are no atomics and every run sums in the same order.
// in   ranges, intersections, owners, projected, chroma; rendered (planes of raster_forward, filled by fill_absent where
//      something is absent); pixel_gradient, by
//      the colour's CHANNELS
// out  isect_gradients[SLOT e + ..]: centre x, y; conic a, b, c; α dL/dα; grey or red; 0;
//      with three CHANNELS green, blue, 0, 0
//      α dL/dα = o dL/do where the cap does not bind: project_backward needs it as it is
// All that is blended enters the loss linearly, so what lies behind Gaussian j matters by one number a pixel:
// the gradient-weighted sum of what was rendered minus everything up to j. Transmittance is never used up.
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// variants: subgroup, cpu
#ifdef CPU
#define SUBGROUP
#endif
#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#extension GL_KHR_shader_subgroup_shuffle : require
#endif
layout(local_size_x = 32) in;
layout(constant_id = 2) const uint CHANNELS = 1;

#include "../common/types.glsl"
#include "../common/index.glsl"
#include "../common/tiles.glsl"
#include "../common/lanes.glsl"
#include "../common/shade.glsl"
#include "../common/texels.glsl"

const uint SLOT = CHANNELS == 3 ? 12 : 8;

layout(push_constant) uniform Push {
    uvec2 size;
} push;

READ_UVEC2S(0, Ranges, range_of)
READ_UINTS(1, Intersections, intersection)
READ_UINTS(2, Owners, owner)
READ_PROJECTED(3, ProjectedIn, projected)
READ_VEC2S(4, Chroma, chroma)
READ_FLOATS(5, Rendered, rendered)
READ_FLOATS(6, PixelGradient, pixel_gradient)
layout(set = 0, binding = 7, std430) writeonly buffer IsectGradients { float isect_gradients[]; };

Batch fetch(uint at, uint end) {
    const uint isect = intersection(min(at, max(end, 1) - 1));
    const uint slot = owner(isect);
    return batch_of(projected(slot), CHANNELS == 3 ? chroma(slot) : vec2(0.0), isect, at < end);
}

void main() {
    const uint tile = tile_index();
    const uvec2 grid = tile_grid(push.size);
    if (tile >= grid.x * grid.y) {
        return;
    }
    const uvec2 pixel = column_of(tile, push.size);
    const vec2 top = vec2(pixel) + 0.5;
    const uint plane = push.size.x * push.size.y;
    vec3 v[COLUMN];  // gradient by colour
    float t[COLUMN], behind[COLUMN];
    [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
        const bool inside = pixel.x < push.size.x && pixel.y + k < push.size.y;
        const uint at = inside ? (pixel.y + k) * push.size.x + pixel.x : 0;
        t[k] = inside ? 1.0 : 0.0;
        v[k].x = pixel_gradient(at);
        behind[k] = v[k].x * rendered(at);
        if (CHANNELS == 3) {
            v[k].yz = vec2(pixel_gradient(plane + at), pixel_gradient(2 * plane + at));
            behind[k] += v[k].y * rendered(plane + at) + v[k].z * rendered(2 * plane + at);
        }
    }
    const uvec2 range = range_of(tile);
    uint base = range.x;
    Batch coming = fetch(base + lane(), range.y);
    for (; base < range.y; base += LANES) {
        batch_put(coming);
        if (base + LANES < range.y) {
            coming = fetch(base + LANES + lane(), range.y);
        }
        const uint n = min(LANES, range.y - base);
        for (uint j = 0; j < n; j += TOGETHER) {
            float terms[32];
            [[unroll]] for (uint g = 0; g < TOGETHER; ++g) {
                const Batch b = batch_get(j + g);
                const Column s = column_terms(b, top);
                // Over the column: moments of v_σ = -α dL/dα, and the gradient by colour.
                float s0 = 0.0, s1 = 0.0, s2 = 0.0;
                vec3 by_colour = vec3(0.0);
                [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
                    const float raw = alpha_at(s, float(k));
                    const float alpha = effective(raw, t[k]);
                    const float w = alpha * t[k];
                    const float after = t[k] - w;
                    const float wx = w * v[k].x;
                    float seen = wx * s.colour.x;
                    by_colour.x += wx;
                    if (CHANNELS == 3) {
                        const vec2 wyz = w * v[k].yz;
                        seen += dot(wyz, s.colour.yz);
                        by_colour.yz += wyz;
                    }
                    behind[k] -= seen;
                    // (1 - α) is at least 0.01.
                    const float v_sigma = raw > ALPHA_MAX ? 0.0 : behind[k] * (alpha / (1.0 - alpha)) - seen;
                    s0 += v_sigma;
                    s1 += v_sigma * float(k);
                    s2 += v_sigma * float(k * k);
                    t[k] = after;
                }
                // By the distance from the centre in place of that from the top.
                s2 = s.d.y * (s.d.y * s0 - 2.0 * s1) + s2;
                s1 = s.d.y * s0 - s1;
                const float xs = s.d.x * s0;
                const float of_one[8] = float[8](s.conic.x * xs + s.conic.y * s1, s.conic.y * xs + s.conic.z * s1,
                                                 0.5 * s.d.x * xs, s.d.x * s1, 0.5 * s2, -s0, by_colour.x, 0.0);
                [[unroll]] for (uint i = 0; i < 8; ++i) {
                    terms[8 * g + i] = of_one[i];
                }
                if (CHANNELS == 3) {
                    const float sum2 = sum_of_two(by_colour.y, by_colour.z);
                    if (lane() < 4 && j + g < n) {
                        isect_gradients[b.slot * SLOT + 8 + lane()] = lane() < 2 ? sum2 : 0.0;
                    }
                }
            }
            const float sum = sums(terms);
            const uint slot = slot_of_lane(j);
            if (lane() < 8 * TOGETHER && j + lane() / 8 < n) {
                isect_gradients[slot * SLOT + lane() % 8] = sum;
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
    for (uint i = base * SLOT + lane(); i < range.y * SLOT; i += LANES) {
        isect_gradients[intersection(i / SLOT) * SLOT + i % SLOT] = 0.0;
    }
}
