// Aggregates matching costs along one of the eight directions and adds them to the sums (semi-global matching, Hirschmüller
// 2008): L(p, d) = C(p, d) + min(L(q, d), L(q, d ± 1) + P1, min L(q) + P2) - min L(q), q the pixel before p. The costs C,
// Hamming distances of census strings, are counted anew in every direction: that is cheaper than the memory of their volume.
// Every path is walked by LANES invocations of RUN disparities each, which hold L in registers and pass each other their
// outermost values and their least through shared memory, with one barrier a pixel. Columns and diagonals start in the
// first row; a diagonal that leaves the image comes in again at the other side as a new path.
// in   images, strings
// out  sums: of eight disparities (16 bit), LANES a pixel; each word is touched by one invocation
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 32, local_size_x_id = 0) in;

#include "../common/index.glsl"
#include "bytes.glsl"

layout(constant_id = 0) const uint WIDTH = 32;
layout(constant_id = 1) const uint LANES = 8;

const uint RUN = 8;
const uint FAR = 1u << 20;

layout(push_constant) uniform Push {
    uvec2 size;
    ivec2 step;
    uint outside;   // cost of a match beyond the right image's border
    uint p1;        // penalty of a disparity that differs by one from the pixel before
    uint p2;        // of one that differs by more: p2 - p2_slope * |difference of grey levels|, at least p2_min
    uint p2_slope;
    uint p2_min;
    uint add;       // zero: the sums begin here
} push;

layout(set = 0, binding = 0, std430) readonly buffer Images { uint images[]; };
layout(set = 0, binding = 1, std430) readonly buffer Strings { uint strings[]; };
layout(set = 0, binding = 2, std430) buffer Sums { uvec4 sums[]; };

// Of each lane: its least value, its first and its last, in 10 bits each; of this pixel and of the one before.
shared uint ends[2][256];

struct Pixel {
    uint left;
    uint right[RUN];
    uvec4 sum;
    uint level;
};

Pixel fetch(uvec2 at, uint lane) {
    Pixel p;
    const uint row = at.y * push.size.x;
    p.left = strings[row + at.x];
    const uint right = (push.size.y + at.y) * push.size.x;
    for (uint k = 0; k < RUN; ++k) {
        p.right[k] = strings[right + at.x - min(lane * RUN + k, at.x)];
    }
    p.sum = push.add != 0 ? sums[(row + at.x) * LANES + lane] : uvec4(0);
    p.level = byte_of(images[word_of(push.size, 0, at.x, at.y)], at.x);
    return p;
}

void main() {
    const uint paths = push.step.y == 0 ? push.size.y : push.size.x;
    const uint steps = push.step.y == 0 ? push.size.x : push.size.y;
    const uint me = gl_LocalInvocationID.x, lane = me % LANES;
    // Lanes past the last path walk it again and write nothing: all must meet at the barriers.
    const uint asked = group_index() * (WIDTH / LANES) + me / LANES;
    const uint path = min(asked, paths - 1);
    const bool writes = asked == path;
    const uvec2 last = push.size - 1;
    uvec2 at = push.step.y == 0 ? uvec2(push.step.x > 0 ? 0 : last.x, path) : uvec2(path, push.step.y > 0 ? 0 : last.y);
    uint l[RUN];
    for (uint k = 0; k < RUN; ++k) {
        l[k] = 0;
    }
    uint level_before = 0;
    bool begins = true;
    Pixel next = fetch(at, lane);
    for (uint t = 0; t < steps; ++t) {
        const uvec2 here = at;
        const bool fresh = begins;
        const Pixel p = next;
        if (t + 1 < steps) {
            at.y += uint(push.step.y);
            begins = push.step.y != 0 && at.x == (push.step.x > 0 ? last.x : 0) && push.step.x != 0;
            at.x = begins ? (push.step.x > 0 ? 0 : last.x) : at.x + uint(push.step.x);
            next = fetch(at, lane);
        }
        uint least = FAR, below = FAR, above = FAR;
        const uint first = me - lane, page = t & 1u;
        for (uint k = 0; k < LANES; ++k) {
            least = min(least, ends[page][first + k] & 1023u);
        }
        below = lane > 0 ? ends[page][me - 1] >> 20 : FAR;
        above = lane + 1 < LANES ? (ends[page][me + 1] >> 10) & 1023u : FAR;
        const uint change = uint(abs(int(p.level) - int(level_before)));
        const uint jump = least + max(push.p2_min, push.p2 - min(push.p2, push.p2_slope * change));
        level_before = p.level;
        uint lowest = FAR, before = below;
        for (uint k = 0; k < RUN; ++k) {
            const uint mine = l[k], after = k + 1 < RUN ? l[k + 1] : above;
            const uint cost = lane * RUN + k <= here.x ? uint(bitCount(p.left ^ p.right[k])) : push.outside;
            l[k] = cost + (fresh ? 0 : min(min(mine, min(before, after) + push.p1), jump) - least);
            lowest = min(lowest, l[k]);
            before = mine;
        }
        ends[page ^ 1u][me] = lowest | (l[0] << 10) | (l[RUN - 1] << 20);
        if (writes) {
            const uvec4 low = uvec4(l[0], l[2], l[4], l[6]), high = uvec4(l[1], l[3], l[5], l[7]);
            sums[(here.y * push.size.x + here.x) * LANES + lane] = p.sum + (low | (high << 16));
        }
        barrier();
    }
}
