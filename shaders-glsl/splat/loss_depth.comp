// Inverse-depth L1 on an anchor's view: one thread a pixel.
//   L = weight Σ c |D / A - d|,   D = Σ α T / z and A = Σ α T of the raster
// z is along the axis; of a fisheye it is the distance along the ray, and so is d (see eyes.rs).
// D / A, the expected inverse depth of what was hit, is compared, not D: a pixel that is half covered at the right depth
// is right, and filling it in is the picture's business; against D alone the cheapest way to a farther depth would be a
// fainter Gaussian. In inverse depth an error is one of disparity, which is what stereo measures, at any range. Where
// less than ALPHA_MIN_SEEN was hit there is no surface yet to pull at. Both D and A get their gradients.
// in   rendered (planes of raster_forward), anchor_depths (half resolution, 16 bits a cell, two to a word: inverse depth
//      in 12, confidence c in 4)
// out  pixel_gradient: the planes by accumulated inverse depth and by transmittance 1 - A
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;
layout(constant_id = 2) const uint CHANNELS = 1;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint anchor;        // word offset of its depths
    float inverse_max;  // 1/m, of 12 bits
    float weight;       // over the pixels of a view
} push;

layout(set = 0, binding = 0, std430) readonly buffer Rendered { float rendered[]; };
layout(set = 0, binding = 1, std430) readonly buffer AnchorDepths { uint anchor_depths[]; };
layout(set = 0, binding = 2, std430) writeonly buffer PixelGradient { float pixel_gradient[]; };

const float ALPHA_MIN_SEEN = 0.5;

void main() {
    const uint at = thread_index(), plane = push.size.x * push.size.y;
    if (at >= plane) {
        return;
    }
    const uvec2 cell = uvec2(at % push.size.x, at / push.size.x) / 2;
    const uint words = (push.size.x + 3) / 4;  // a row of cells
    const uint pair = anchor_depths[push.anchor + cell.y * words + cell.x / 2];
    const uint stored = (pair >> (16 * (cell.x % 2))) & 0xffffu;
    const float goal = float(stored >> 4) * (push.inverse_max / 4095.0);
    const float trust = float(stored & 15u) / 15.0;
    const float alpha = 1.0 - rendered[CHANNELS * plane + at];
    vec2 v = vec2(0.0);
    if (alpha >= ALPHA_MIN_SEEN) {
        const float expected = rendered[(CHANNELS + 1) * plane + at] / alpha;
        const float slope = push.weight * trust * sign(expected - goal) / alpha;
        v = vec2(slope, slope * expected);
    }
    pixel_gradient[CHANNELS * plane + at] = v.x;
    pixel_gradient[(CHANNELS + 1) * plane + at] = v.y;
}
