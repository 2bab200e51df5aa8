// Forgets disparities that the pixels around do not bear out. Either they fit no better than chance; or the left image
// repeats itself there: some other place in reach looks the same, with places between that do not. Sums of costs do not show
// a repetition, since the border of the picture prefers one and smoothness carries that far. A blank wall is none: it is
// alike everywhere. One thread a pixel.
// in   strings
// out  disparity
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint disparities;
    // Sums of Hamming distances of 3 x 3 pixels:
    uint chance;  // of a match, at most
    uint fit;     // of one worth the question whether it repeats
    uint alike;   // of a repetition, more than that of the match
    uint wall;    // of what lies between, at least, more than that of the match
} push;

layout(set = 0, binding = 0, std430) readonly buffer Strings { uint strings[]; };
layout(set = 0, binding = 1, std430) buffer Disparity { float disparity[]; };

/// Of the pixels around (x, y) of the left image and those `shift` px further, of side 0 or 1; both are inside.
uint cost(uvec2 at, int shift, uint side) {
    const int last = int(push.size.x) - 1;
    uint sum = 0;
    for (int v = -1; v <= 1; ++v) {
        const uint y = uint(clamp(int(at.y) + v, 0, int(push.size.y) - 1));
        const uint row = y * push.size.x, other = row + side * push.size.x * push.size.y;
        for (int u = -1; u <= 1; ++u) {
            const int x = clamp(int(at.x) + u, max(0, -shift), min(last, last - shift));
            sum += uint(bitCount(strings[row + uint(x)] ^ strings[other + uint(x + shift)]));
        }
    }
    return sum;
}

void main() {
    const uint i = thread_index();
    if (i >= push.size.x * push.size.y || disparity[i] < 0.0) {
        return;
    }
    const uvec2 at = uvec2(i % push.size.x, i / push.size.x);
    const int farthest = min(int(push.disparities) - 1, int(at.x)), best = min(int(disparity[i] + 0.5), farthest);
    const uint own =
        min(cost(at, -best, 1), min(cost(at, -max(best - 1, 0), 1), cost(at, -min(best + 1, farthest), 1)));
    bool stands = own <= push.chance;
    for (int side = -1; side <= 1 && stands && own <= push.fit; side += 2) {
        const int room = side < 0 ? int(at.x) : int(push.size.x - 1 - at.x);
        uint worst = 0;
        for (int k = 2; k <= min(room, int(push.disparities) - 1) && stands; ++k) {
            const uint other = cost(at, side * k, 0);
            stands = other > own + push.alike || worst < own + push.wall;
            worst = max(worst, other);
        }
    }
    if (!stands) {
        disparity[i] = -1.0;
    }
}
