// Puts the cell of every Gaussian of an epoch into an empty table: one thread a slot. A place keeps the least tag put
// there, so the table is the same in whatever order the threads come. A cell that loses both its places is forgotten.
// in   splats
// out  cells: tags
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/cells.glsl"
#include "../common/finite.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint first;       // slots of the epoch
    uint splats;      // and their end
    float per_metre;  // cells
    uint mask;        // places - 1
} push;

layout(set = 0, binding = 0, std430) readonly buffer Splats { Splat splats[]; };
layout(set = 0, binding = 1, std430) buffer Cells { uint cells[]; };

void main() {
    const uint slot = thread_index();
    if (slot < push.first || slot >= push.splats || !finite(splats[slot].mean_opacity)) {
        return;
    }
    const Cell c = cell_of(splats[slot].mean_opacity.xyz, push.per_metre, push.mask);
    atomicMin(cells[c.places.x], c.tag);
    atomicMin(cells[c.places.y], c.tag);
}
