// Blends the Gaussians of each tile front to back: one column of pixels a lane.
// in   ranges, intersections (by tile, then depth), owners, projected; chroma (green, blue) with three CHANNELS
// out  rendered, in planes: the colour's CHANNELS; transmittance; with DEPTH the expected depth Σ w z / Σ w, m
// A pixel ends after the contribution that makes it opaque, so that transmittance alone tells, here
// and in the backward pass, who contributed.
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
layout(constant_id = 1) const bool DEPTH = false;
layout(constant_id = 2) const uint CHANNELS = 1;

#include "../common/types.glsl"
#include "../common/index.glsl"
#include "../common/tiles.glsl"
#include "../common/lanes.glsl"
#include "../common/shade.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
} push;

READ_UVEC2S(0, Ranges, range_of)
READ_UINTS(1, Intersections, intersection)
READ_UINTS(2, Owners, owner)
READ_PROJECTED(3, ProjectedIn, projected)
READ_VEC2S(4, Chroma, chroma)
layout(set = 0, binding = 5, std430) writeonly buffer Rendered { float rendered[]; };

Batch fetch(uint at, uint end) {
    const uint slot = owner(intersection(min(at, max(end, 1) - 1)));
    return batch_of(projected(slot), CHANNELS == 3 ? chroma(slot) : vec2(0.0), 0, at < end);
}

void main() {
    const uint tile = tile_index();
    const uvec2 grid = tile_grid(push.size);
    if (tile >= grid.x * grid.y) {
        return;
    }
    const uvec2 pixel = column_of(tile, push.size);
    const vec2 top = vec2(pixel) + 0.5;
    vec3 c[COLUMN];
    float t[COLUMN], z[COLUMN];
    [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
        // Pixels outside the image are opaque from the start and never hold the tile up.
        t[k] = pixel.x < push.size.x && pixel.y + k < push.size.y ? 1.0 : 0.0;
        c[k] = vec3(0.0);
        z[k] = 0.0;
    }
    const uvec2 range = range_of(tile);
    // The next batch is on its way while this one is drawn.
    Batch coming = fetch(range.x + lane(), range.y);
    for (uint base = range.x; base < range.y; base += LANES) {
        batch_put(coming);
        if (base + LANES < range.y) {
            coming = fetch(base + LANES + lane(), range.y);
        }
        const uint n = min(LANES, range.y - base);
        for (uint j = 0; j < n; j += TOGETHER) {
            [[unroll]] for (uint g = 0; g < TOGETHER; ++g) {
                const Column s = column_terms(batch_get(j + g), top);
                [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
                    const float w = effective(alpha_at(s, float(k)), t[k]) * t[k];
                    c[k].x += w * s.colour.x;
                    if (CHANNELS == 3) {
                        c[k].yz += w * s.colour.yz;
                    }
                    if (DEPTH) {
                        z[k] += w * s.depth;
                    }
                    t[k] -= w;
                }
            }
        }
        float clearest = t[0];
        [[unroll]] for (uint k = 1; k < COLUMN; ++k) {
            clearest = max(clearest, t[k]);
        }
        if (all_lanes(clearest <= TRANSMITTANCE_MIN)) {
            break;
        }
    }
    const uint plane = push.size.x * push.size.y;
    [[unroll]] for (uint k = 0; k < COLUMN; ++k) {
        if (pixel.x < push.size.x && pixel.y + k < push.size.y) {
            const uint at = (pixel.y + k) * push.size.x + pixel.x;
            rendered[at] = c[k].x;
            if (CHANNELS == 3) {
                rendered[plane + at] = c[k].y;
                rendered[2 * plane + at] = c[k].z;
            }
            rendered[CHANNELS * plane + at] = t[k];
            if (DEPTH) {
                rendered[(CHANNELS + 1) * plane + at] = z[k] * (1.0 / max(1.0 - t[k], 1e-6));
            }
        }
    }
}
