// The mask of a camera less the cells of a view that do not count, and less the pixels that its picture leaves open: one thread
// for four pixels.
// in   mask (8 bit, four to a word, zero = ignore), transmittance of the picture
// out  masked
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
    uvec2 grid;     // columns and rows of cells
    uint cells[6];  // a bit for each cell that does not count, row by row
    uint plane;     // where the transmittance begins in the picture
    float open;     // the transmittance above which a pixel does not count
} push;

READ_UINTS(0, Mask, mask)
READ_FLOATS(1, Picture, picture)
layout(set = 0, binding = 2, std430) writeonly buffer Masked { uint masked[]; };

/// The cell along one axis whose part of the picture has the middle of pixel v.
uint nth(uint v, uint size, uint cells) {
    return min((2 * v + 1) * cells / (2 * size), cells - 1);
}

void main() {
    const uint words = byte_stride(push.size.x) / 4;
    const uint at = thread_index();
    if (at >= words * push.size.y) {
        return;
    }
    const uint row = nth(at / words, push.size.y, push.grid.y) * push.grid.x;
    uint keep = 0;
    for (uint byte = 0; byte < 4; ++byte) {
        const uint x = min(at % words * 4 + byte, push.size.x - 1);
        const uint cell = row + nth(x, push.size.x, push.grid.x);
        const bool hidden = ((push.cells[cell / 32] >> (cell % 32)) & 1u) != 0;
        const bool open = picture(push.plane + at / words * push.size.x + x) > push.open;
        keep |= hidden || open ? 0u : 255u << (8 * byte);
    }
    masked[at] = mask(at) & keep;
}
