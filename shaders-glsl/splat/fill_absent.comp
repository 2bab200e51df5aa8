// Prepares the comparison of a view some of whose Gaussians are absent: one thread for four pixels. In the cells that show some of
// them the image stands in for them: what the picture lets through of it is added to the picture, so that the Gaussians that
// are here learn the colour of their part of a pixel and do not grow into the rest. Cells that show many of them, and pixels
// that the picture leaves open, are masked.
// The light that is added is taken as given: the gradient by exposure does not follow it. A Gaussian that agrees with the image
// is worth little before it, so its importance falls in such steps.
// in   mask (8 bit, four to a word, zero = ignore), targets (8 bit, four to a word), picture (colours, transmittance)
// out  masked, picture
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
    uvec2 grid;         // columns and rows of cells
    uint hidden[6];     // a bit for each cell that is masked, row by row
    uint filled[6];     // a bit for each cell in which the image stands in
    uint target;        // word offset of the keyframe's planes
    uint channels;
    float open;         // the transmittance above which a pixel is masked
    float exposure[2];  // gain, offset of the keyframe
} push;

READ_UINTS(0, Mask, mask)
READ_UINTS(1, Targets, targets)
layout(set = 0, binding = 2, std430) buffer Picture { float picture[]; };
layout(set = 0, binding = 3, std430) writeonly buffer Masked { uint masked[]; };

/// The cell along one axis whose part of the picture has the middle of pixel v.
uint nth(uint v, uint size, uint cells) {
    return min((2 * v + 1) * cells / (2 * size), cells - 1);
}

void main() {
    const uint words = byte_stride(push.size.x) / 4, at = thread_index();
    if (at >= words * push.size.y) {
        return;
    }
    const uint y = at / words, row = nth(y, push.size.y, push.grid.y) * push.grid.x;
    const uint plane = push.size.x * push.size.y;
    uint keep = 0;
    for (uint byte = 0; byte < 4; ++byte) {
        const uint x = at % words * 4 + byte;
        if (x >= push.size.x) {
            break;
        }
        const uint cell = row + nth(x, push.size.x, push.grid.x), pixel = y * push.size.x + x;
        const bool hidden = ((push.hidden[cell / 32] >> (cell % 32)) & 1u) != 0;
        const bool filled = ((push.filled[cell / 32] >> (cell % 32)) & 1u) != 0;
        const float through = picture[push.channels * plane + pixel];
        keep |= hidden || through > push.open ? 0u : 255u << (8 * byte);
        for (uint c = 0; c < push.channels && filled; ++c) {
            const uint levels = targets(push.target + c * words * push.size.y + at);
            const float level = float((levels >> (8 * byte)) & 255u) / 255.0;
            picture[c * plane + pixel] += through * (level - push.exposure[1]) / push.exposure[0];
        }
    }
    masked[at] = mask(at) & keep;
}
