// Gradient of the loss (1 - λ)|x - y| + λ(1 - SSIM), mean over valid pixels, of x = gain · rendered + offset, by the
// rendered image, by gain and by offset: loss_rows and loss_columns in one, for GPUs.
// in   slopes (of ssim_tiles), grey (rendered), targets, mask
// out  grey_gradient, zero where masked; loss_sums[group]: |x - y|, gradient by gain, by offset, 0
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 128) in;

#define PLANES 3
#include "../common/index.glsl"
#include "../common/ssim.glsl"
#include "../common/ssim_tile.glsl"
#include "../common/group_sum.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint target;       // word offset of the keyframe's plane
    uint plane;        // where the rendered one and its gradient begin, px
    uint group;        // where its sums begin
    float exposure[2]; // gain, offset of the keyframe
    float l1_weight;   // (1 - λ) / valid pixels
    float ssim_weight; // λ / valid pixels
} push;

layout(set = 0, binding = 0, std430) readonly buffer Slopes { float slopes[]; };
layout(set = 0, binding = 1, std430) readonly buffer Grey { float grey[]; };
layout(set = 0, binding = 2, std430) readonly buffer Targets { uint targets[]; };
layout(set = 0, binding = 3, std430) readonly buffer Mask { uint mask[]; };
layout(set = 0, binding = 4, std430) writeonly buffer GreyGradient { float grey_gradient[]; };
layout(set = 0, binding = 5, std430) writeonly buffer LossSums { vec4 loss_sums[]; };

void main() {
    const uvec2 corner = tile_corner(group_index(), push.size);
    // First pixel that this invocation's run needs; it may lie outside the image.
    const uint lane = gl_LocalInvocationID.x;
    const ivec2 top = ivec2(corner) + ivec2(lane % COLUMNS, lane / COLUMNS * ROWS) - int(RADIUS);
    const uint plane = push.size.x * push.size.y;
    [[unroll]] for (uint q = 0; q < 3; ++q) {
        float v[SPAN];
        [[unroll]] for (uint k = 0; k < SPAN; ++k) {
            const ivec2 p = top + ivec2(0, k);
            const uvec2 r = readable(p, push.size);
            const float slope = slopes[q * plane + r.y * push.size.x + r.x];
            v[k] = inside(p, push.size) ? slope : 0.0;
        }
        filter_run(q, v);
    }
    barrier();
    vec3 sum = vec3(0.0);
    for (uint i = lane; i < TILE_PIXELS; i += gl_WorkGroupSize.x) {
        const uvec2 pixel = uvec2(i % WIDTH, i / WIDTH), p = corner + pixel;
        if (!inside(ivec2(p), push.size)) {
            continue;
        }
        const uint at = p.y * push.size.x + p.x, byte = p.y * byte_stride(push.size.x) + p.x;
        const bool valid = ((mask[byte / 4] >> (8 * (byte % 4))) & 255u) != 0;
        const float rendered = grey[push.plane + at];
        const float b = float((targets[push.target + byte / 4] >> (8 * (byte % 4))) & 255u) / 255.0;
        const Difference d = difference(rendered, push.exposure, b,
                                        vec3(filtered_at(0, pixel), filtered_at(1, pixel), filtered_at(2, pixel)),
                                        vec2(push.l1_weight, push.ssim_weight));
        grey_gradient[push.plane + at] = valid ? push.exposure[0] * d.gradient : 0.0;
        sum += valid ? vec3(d.l1, d.gradient * rendered, d.gradient) : vec3(0.0);
    }
    const vec4 total = vec4(group_sum(sum.x), group_sum(sum.y), group_sum(sum.z), 0.0);
    if (lane == 0 && corner.y < push.size.y) {
        loss_sums[push.group + group_index()] = total;
    }
}
