// First pass of SSIM on a CPU: filters both images, the sum of their squares and their product along rows.
// in   grey (rendered, put into the keyframe's exposure here), targets (8 bit, four to a word),
//      mask (8 bit, zero = ignore)
// out  filtered_planes: of E[x], E[y], E[x² + y²], E[xy]
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"
#include "../common/ssim.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint target;        // word offset of the keyframe's plane
    uint plane;         // where the rendered one begins, px
    float exposure[2];  // gain, offset of the keyframe
} push;

READ_FLOATS(0, Grey, grey)
READ_UINTS(1, Targets, targets)
READ_UINTS(2, Mask, mask)
layout(set = 0, binding = 3, std430) writeonly buffer Filtered { float filtered_planes[]; };

void main() {
    const uint runs = (push.size.x + RUN - 1) / RUN;
    const uint at = thread_index();
    if (at >= runs * push.size.y) {
        return;
    }
    const uint y = at / runs, x0 = at % runs * RUN;
    const uint words = byte_stride(push.size.x) / 4;
    float a[REACH], b[REACH], product[REACH];
    // The run with its margins, in whole words from x0 - 8.
    [[unroll]] for (uint w = 0; w < (RUN + 16) / 4; ++w) {
        const int word = int(x0 / 4 + w) - 2;
        const bool inside = word >= 0 && word < int(words);
        const uint i = y * words + uint(clamp(word, 0, int(words) - 1));
        const uint m = inside ? mask(i) : 0;
        const uint t = targets(push.target + i);
        [[unroll]] for (uint byte = 0; byte < 4; ++byte) {
            const int k = int(w * 4 + byte) - 3;
            if (k >= 0 && k < int(REACH)) {
                const bool valid = ((m >> (8 * byte)) & 255u) != 0;
                const uint x = min(uint(max(word, 0)) * 4 + byte, push.size.x - 1);
                const float level = push.exposure[0] * grey(push.plane + y * push.size.x + x) + push.exposure[1];
                b[k] = valid ? float((t >> (8 * byte)) & 255u) / 255.0 : 0.0;
                float slope;
                a[k] = valid ? censored(level, b[k], slope) : 0.0;
            }
        }
    }
    const uint plane = push.size.x * push.size.y;
    const uint out0 = y * push.size.x + x0;
    const uint n = min(RUN, push.size.x - x0);
    [[unroll]] for (uint q = 0; q < MOMENTS; ++q) {
        [[unroll]] for (uint k = 0; k < REACH; ++k) {
            product[k] = MOMENT(q, a[k], b[k]);
        }
        [[unroll]] for (uint k = 0; k < RUN; ++k) {
            if (k < n) {
                filtered_planes[q * plane + out0 + k] = FILTERED(product, k);
            }
        }
    }
}
