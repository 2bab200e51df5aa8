// Puts every Gaussian of an epoch on the image, and makes its intersections with the tiles it touches: one thread a slot, those of earlier
// epochs included. A workgroup takes places for its intersections in a row, from a multiple of CHUNK on, so that which chunks a Gaussian has
// does not depend on which workgroup comes first.
// in   splats; tile_lengths, counts: zero
// out  projected[slot]; runs[slot]: where its intersections begin and end; tile_depths, owners (tile and depth, and slot, of each
//      intersection; both NOWHERE in gaps); tile_lengths[tile]: its intersections; counts.visible, .not_finite, .needed
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
#ifdef CPU
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#endif
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/camera.glsl"
#include "../common/tiles.glsl"
#include "../common/tile_depth.glsl"
#include "../common/chunks.glsl"
#include "../common/index.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    Camera camera;
    uvec2 size;
    uint first;         // slots of the epoch
    uint splats;        // and their end
    uint capacity;      // intersections
    float coarseness;
} push;

READ_SPLATS(0, Splats, splat)
layout(set = 0, binding = 1, std430) writeonly buffer ProjectedOut { Projected projected[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Runs { uvec2 runs[]; };
layout(set = 0, binding = 3, std430) writeonly buffer TileDepths { uint tile_depths[]; };
layout(set = 0, binding = 4, std430) writeonly buffer Owners { uint owners[]; };
layout(set = 0, binding = 5, std430) buffer TileLengths { uint tile_lengths[]; };
layout(set = 0, binding = 6, std430) buffer CountsOut { Counts counts[]; };

const uint WIDTH = gl_WorkGroupSize.x;
/// A word holds how many Gaussians are visible, from this bit on, and below how many tiles they touch: WIDTH of them fewer than 2^24, as
/// there are fewer than 2^16 tiles.
const uint ONE_VISIBLE = 1u << 24;
/// More places than any list has. No more are taken, so that their number does not begin anew.
const uint TOO_MANY = 1u << 31;

shared uint sums[2 * WIDTH];
shared uint place_of_first;

/// Whether it may be seen, and where.
bool project(Splat s, out Projected g) {
    Local l;
    if (!place(push.camera, s, l)) {
        return false;
    }
    flatten(push.camera, vec2(push.size), l);
    const float opacity = sigmoid(s.mean_opacity.w);
    if (!(opacity > ALPHA_MIN && finite(l.centre.x) && finite(l.centre.y) && finite(vec4(l.conic, opacity)))) {
        return false;
    }
    const float t = level_of(opacity, push.coarseness);
    if (!(t >= 0.0)) {
        return false;
    }
    g = Projected(vec4(l.centre, l.conic.xy), vec4(l.conic.z, opacity, s.scale_colour.w, l.depth));
    const vec2 extent = sqrt(t * l.cov.xz);
    return all(greaterThan(l.centre + extent, vec2(0.0))) && all(lessThan(l.centre - extent, vec2(push.size)));
}

/// Sum over the lanes up to this one, and over all.
uvec2 sum_to(uint value) {
#ifdef CPU
    const uint inclusive = subgroupInclusiveAdd(value);
    if (gl_SubgroupInvocationID == gl_SubgroupSize - 1) {
        sums[gl_SubgroupID] = inclusive;
    }
    barrier();
    uvec2 sum = uvec2(inclusive, 0);
    for (uint group = 0; group < gl_NumSubgroups; ++group) {
        sum += uvec2(group < gl_SubgroupID ? sums[group] : 0, sums[group]);
    }
    return sum;
#else
    const uint lane = gl_LocalInvocationID.x;
    uint at = 0;
    sums[lane] = value;
    barrier();
    for (uint step = 1; step < WIDTH; step *= 2) {
        value += lane >= step ? sums[at + lane - step] : 0;
        at ^= WIDTH;
        sums[at + lane] = value;
        barrier();
    }
    return uvec2(value, sums[at + WIDTH - 1]);
#endif
}

void main() {
    const uint slot = thread_index(), lane = gl_LocalInvocationID.x;
    const uvec2 grid = tile_grid(push.size);
    Projected g;
    Ellipse e;
    e.rows = ivec2(0, -1);
    uint count = 0;
    if (slot < push.splats) {
        const Splat s = splat(slot);
        if (slot >= push.first && project(s, g)) {
            e = ellipse_of(g, push.size, push.coarseness);
            for (int row = e.rows.x; row <= e.rows.y; ++row) {
                const ivec2 columns = columns_of(e, row, push.size);
                count += uint(max(0, columns.y - columns.x + 1));
            }
        }
        if (count > 0) {
            projected[slot] = g;
        }
        if (!(finite(s.mean_opacity) && finite(s.scale_colour) && finite(s.quat))) {
            atomicAdd(counts[0].not_finite, 1);
        }
    }
    const uvec2 sum = sum_to(count > 0 ? ONE_VISIBLE + count : 0);
    const uint all = sum.y;
    const uint places = all % ONE_VISIBLE, taken = (places + CHUNK - 1) / CHUNK * CHUNK;
    if (lane == 0 && all > 0) {
        place_of_first = atomicAdd(counts[0].needed, taken);
        if (place_of_first > TOO_MANY) {
            atomicAdd(counts[0].needed, -taken);
        }
        atomicAdd(counts[0].visible, all / ONE_VISIBLE);
    }
    barrier();
    const uint begin = place_of_first + sum.x % ONE_VISIBLE - count;
    const uint end = min(begin + count, push.capacity);
    uint at = begin;
    if (at < end) {
        const uint depth = depth_key(g.conic_shade.w);
        // Should this walk round as the first did not, what is listed is what it finds.
        for (int row = e.rows.x; row <= e.rows.y && at < end; ++row) {
            const ivec2 columns = columns_of(e, row, push.size);
            for (int column = columns.x; column <= columns.y && at < end; ++column) {
                const uint tile = uint(row) * grid.x + uint(column);
                tile_depths[at] = tile_and_depth(tile, depth);
                owners[at] = slot;
                atomicAdd(tile_lengths[tile], 1);
                ++at;
            }
        }
    }
    if (slot < push.splats) {
        runs[slot] = uvec2(begin, at);
    }
    for (; at < end; ++at) {
        tile_depths[at] = NOWHERE;
        owners[at] = NOWHERE;
    }
    const uint gap = place_of_first + places + lane;
    if (all > 0 && gap < min(place_of_first + taken, push.capacity)) {
        tile_depths[gap] = NOWHERE;
        owners[gap] = NOWHERE;
    }
}
