// Counts the tiles each visible Gaussian touches, front to back: one thread a rank, zero past the last.
// in   visible_count, slots (by depth), projected
// out  tile_counts[rank], for the whole pool and one more, so that its prefix sum ends with the total
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/tiles.glsl"
#include "../common/index.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint splats;
    float coarseness;
} push;

READ_UINTS(0, VisibleCount, visible_count)
READ_UINTS(1, Slots, slot_of)
READ_PROJECTED(2, ProjectedIn, projected)
layout(set = 0, binding = 3, std430) writeonly buffer TileCounts { uint tile_counts[]; };

void main() {
    const uint rank = thread_index();
    if (rank > push.splats) {
        return;
    }
    uint count = 0;
    if (rank < visible_count(0)) {
        const Ellipse e = ellipse_of(projected(slot_of(rank)), push.size, push.coarseness);
        for (int row = e.rows.x; row <= e.rows.y; ++row) {
            const ivec2 columns = columns_of(e, row, push.size);
            count += uint(max(0, columns.y - columns.x + 1));
        }
    }
    tile_counts[rank] = count;
}
