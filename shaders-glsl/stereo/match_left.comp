// Disparity of each pixel of the left image: the one of least sum, refined between its neighbours by the equiangular fit
// (Shimizu and Okutomi 2001), which suits Hamming distances: they grow like |d|, not like d². Unknown is what the right
// image does not confirm (occluded, or matched wrongly) and what another disparity fits almost as well. One thread a pixel.
// in   sums, right
// out  disparity, px, negative where unknown
//      labels: each pixel its own, for speckles
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

const uint FAR = 0xffffffu;

layout(push_constant) uniform Push {
    uvec2 size;
    uint disparities;
    uint unique;    // the least sum, in percent of the next least that is not beside it, is at most this
    uint disagree;  // from the right image's disparity, px, at most
} push;

layout(set = 0, binding = 0, std430) readonly buffer Sums { uvec4 sums[]; };
layout(set = 0, binding = 1, std430) readonly buffer Right { uint right[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 3, std430) writeonly buffer Labels { uint labels[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.size.x * push.size.y) {
        return;
    }
    const uint x = i % push.size.x, words = push.disparities / 8;
    uint least = FAR, best = 0;
    for (uint w = 0; w < words; ++w) {
        const uvec4 four = sums[i * words + w];
        for (uint k = 0; k < 8; ++k) {
            const uint sum = (four[k / 2] >> (16 * (k & 1u))) & 0xffffu;
            if (sum < least) {
                least = sum;
                best = w * 8 + k;
            }
        }
    }
    uint rival = FAR, before = FAR, after = FAR;
    for (uint w = 0; w < words; ++w) {
        const uvec4 four = sums[i * words + w];
        for (uint k = 0; k < 8; ++k) {
            const uint d = w * 8 + k, sum = (four[k / 2] >> (16 * (k & 1u))) & 0xffffu;
            before = d + 1 == best ? sum : before;
            after = d == best + 1 ? sum : after;
            rival = d + 1 < best || d > best + 1 ? min(rival, sum) : rival;
        }
    }
    float fine = float(best);
    if (best > 0 && best + 1 < push.disparities) {
        const uint slope = max(before, after) - least;
        fine += slope > 0 ? 0.5 * (float(before) - float(after)) / float(slope) : 0.0;
    }
    const bool inside = best <= x;
    const int differ = int(right[i - min(best, x)]) - int(best);
    const bool unique = 100 * least <= push.unique * rival;
    disparity[i] = inside && unique && abs(differ) <= int(push.disagree) ? fine : -1.0;
    labels[i] = i;
}
