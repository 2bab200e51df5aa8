// Looks every rectified pixel up in the raw image, by the maps made at boot (rectify.rs), bilinearly and in the same
// integers as there. One thread four pixels, which are a word.
// in   raw: both images, four pixels to a word; taps: where a pixel's source is (bytes from the image's beginning, all
//      ones: nowhere) and its weights to the right and down, in 1/128
// out  images
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"
#include "bytes.glsl"

const uint OUTSIDE = 0xffffffffu;
const uint WEIGHT_BITS = 7, ONE = 1u << WEIGHT_BITS;

layout(push_constant) uniform Push {
    uvec2 size;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Raw { uint raw[]; };
layout(set = 0, binding = 1, std430) readonly buffer Taps { uvec2 taps[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Images { uint images[]; };

uint pixel(uint at) {
    return byte_of(raw[at / 4], at);
}

void main() {
    const uint words = row_words(push.size.x), i = thread_index();
    if (i >= 2 * words * push.size.y) {
        return;
    }
    // Row of both images, one below the other.
    const uint row = i / words, x0 = i % words * 4;
    const uint stride = 4 * words, image = row / push.size.y * push.size.y * stride;
    uint word = 0;
    for (uint k = 0; k < min(4u, push.size.x - x0); ++k) {
        const uvec2 tap = taps[row * push.size.x + x0 + k];
        if (tap.x != OUTSIDE) {
            const uint at = image + tap.x, wx = tap.y & 0xffffu, wy = tap.y >> 16;
            const uint top = pixel(at) * (ONE - wx) + pixel(at + 1) * wx;
            const uint bottom = pixel(at + stride) * (ONE - wx) + pixel(at + stride + 1) * wx;
            word |= ((top * (ONE - wy) + bottom * wy + (1u << (2 * WEIGHT_BITS - 1))) >> (2 * WEIGHT_BITS)) << (8 * k);
        }
    }
    images[i] = word;
}
