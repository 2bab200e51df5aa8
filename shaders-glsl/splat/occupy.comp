// Claims cells of space for an anchor, and says which an earlier one holds: one thread a point. A cell has two places in
// the table, by two hashes; a place keeps the least (anchor, tag) ever claimed, so the table is the same in whatever
// order the threads come, and what earlier anchors hold cannot change meanwhile.
// in   points
// out  cells: anchor in 12 bits, tag of the cell in 20; all ones is free
//      held[i]: 0 claimed; 1 an earlier anchor holds the cell; 2 both places are other cells' of earlier anchors
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

const uint TAG_BITS = 20;

layout(push_constant) uniform Push {
    uint points;
    uint anchor;
    float per_metre;  // cells
    uint mask;        // places - 1
} push;

layout(set = 0, binding = 0, std430) readonly buffer Points { vec4 points[]; };
layout(set = 0, binding = 1, std430) buffer Cells { uint cells[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Held { uint held[]; };

/// Finaliser of MurmurHash3.
uint mixed(uint h) {
    h = (h ^ (h >> 16)) * 0x85ebca6bu;
    h = (h ^ (h >> 13)) * 0xc2b2ae35u;
    return h ^ (h >> 16);
}

void main() {
    const uint i = thread_index();
    if (i >= push.points) {
        return;
    }
    const uvec3 c = uvec3(ivec3(floor(points[i].xyz * push.per_metre)));
    const uint key = mixed(c.x ^ mixed(c.y ^ mixed(c.z + 1)));
    const uvec2 place = uvec2(key, mixed(key + 1)) & push.mask;
    const uint tag = mixed(key + 2) >> (32 - TAG_BITS), entry = (push.anchor << TAG_BITS) | tag;
    uint earlier = 0, taken = 0;
    for (uint k = 0; k < 2; ++k) {
        const uint found = cells[place[k]];
        if ((found >> TAG_BITS) < push.anchor) {
            ++earlier;
            taken += (found & ((1u << TAG_BITS) - 1)) == tag ? 1 : 0;
        }
    }
    if (taken == 0) {
        atomicMin(cells[place.x], entry);
        atomicMin(cells[place.y], entry);
    }
    held[i] = taken > 0 ? 1 : (earlier == 2 ? 2 : 0);
}
