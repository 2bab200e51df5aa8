// Whether the cells of points hold Gaussians: one thread a point.
// in   points; cells: tags, see occupy
// out  found[i]: 0 free; 1 held; 2 not known: both places are other cells'
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/cells.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint points;
    float per_metre;
    uint mask;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Points { vec4 points[]; };
layout(set = 0, binding = 1, std430) readonly buffer Cells { uint cells[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Found { uint found[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.points) {
        return;
    }
    const Cell c = cell_of(points[i].xyz, push.per_metre, push.mask);
    const uint a = cells[c.places.x], b = cells[c.places.y];
    found[i] = a == c.tag || b == c.tag ? 1 : (a == FREE || b == FREE ? 0 : 2);
}
