// SSIM of a picture and an image, tile by tile, and its derivatives by E[x], E[x²], E[xy]: ssim_rows and ssim_columns in
// one, for GPUs. What both share stays in the workgroup.
// in   grey (rendered, put into the keyframe's exposure here), targets (8 bit, four to a word),
//      mask (8 bit, zero = ignore)
// out  slopes: planes of dS/dE[x], dS/dE[x²], dS/dE[xy], zero where masked; ssim_sums[group] of S over valid pixels;
//      with MAP one plane of S itself instead, one where masked
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 128) in;
layout(constant_id = 0) const uint MAP = 0;

#define PLANES 5  // four of moments, and room for both images as they come
#include "../common/index.glsl"
#include "../common/ssim.glsl"
#include "../common/ssim_tile.glsl"
#include "../common/group_sum.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint target;        // word offset of the keyframe's plane
    uint plane;         // where the rendered one begins, px
    uint group;         // where this plane's sums begin
    float exposure[2];  // gain, offset of the keyframe
} push;

layout(set = 0, binding = 0, std430) readonly buffer Grey { float grey[]; };
layout(set = 0, binding = 1, std430) readonly buffer Targets { uint targets[]; };
layout(set = 0, binding = 2, std430) readonly buffer Mask { uint mask[]; };
layout(set = 0, binding = 3, std430) writeonly buffer Slopes { float slopes[]; };
layout(set = 0, binding = 4, std430) writeonly buffer SsimSums { float ssim_sums[]; };

bool valid(uint byte) {
    return ((mask[byte / 4] >> (8 * (byte % 4))) & 255u) != 0;
}

/// The picture in the keyframe's exposure, and the image, with margins on all sides; later the strip lies there.
const uint STAGED = COLUMNS * (HEIGHT + 2 * RADIUS);

void stage(uvec2 corner) {
    const uint stride = byte_stride(push.size.x);
    [[unroll]] for (uint k = 0; k < STAGED / 128; ++k) {
        const uint i = k * 128 + gl_LocalInvocationID.x;
        const ivec2 p = ivec2(corner) + ivec2(i % COLUMNS, i / COLUMNS) - int(RADIUS);
        const uvec2 r = readable(p, push.size);
        const uint byte = r.y * stride + r.x;
        const uint t = targets[push.target + byte / 4];
        const float level = push.exposure[0] * grey[push.plane + r.y * push.size.x + r.x] + push.exposure[1];
        const bool seen = valid(byte) && inside(p, push.size);
        const float b = seen ? float((t >> (8 * (byte % 4))) & 255u) / 255.0 : 0.0;
        float slope;
        strip[i] = seen ? censored(level, b, slope) : 0.0;
        strip[STAGED + i] = b;
    }
}

void filter_columns() {
    const uint lane = gl_LocalInvocationID.x, top = lane / COLUMNS * ROWS * COLUMNS + lane % COLUMNS;
    float a[SPAN], b[SPAN], product[SPAN];
    [[unroll]] for (uint k = 0; k < SPAN; ++k) {
        a[k] = strip[top + k * COLUMNS];
        b[k] = strip[STAGED + top + k * COLUMNS];
    }
    barrier();
    [[unroll]] for (uint q = 0; q < MOMENTS; ++q) {
        [[unroll]] for (uint k = 0; k < SPAN; ++k) {
            product[k] = MOMENT(q, a[k], b[k]);
        }
        filter_run(q, product);
    }
}

void main() {
    const uvec2 corner = tile_corner(group_index(), push.size);
    stage(corner);
    barrier();
    filter_columns();
    barrier();
    const uint plane = push.size.x * push.size.y;
    float sum = 0.0;
    for (uint i = gl_LocalInvocationID.x; i < TILE_PIXELS; i += gl_WorkGroupSize.x) {
        const uvec2 pixel = uvec2(i % WIDTH, i / WIDTH), p = corner + pixel;
        if (!inside(ivec2(p), push.size)) {
            continue;
        }
        const bool compared = valid(p.y * byte_stride(push.size.x) + p.x);
        const Similarity s = similarity(float[MOMENTS](filtered_at(0, pixel), filtered_at(1, pixel), filtered_at(2, pixel),
                                                       filtered_at(3, pixel)));
        const uint at = p.y * push.size.x + p.x;
        if (MAP != 0) {
            slopes[at] = compared ? s.value : 1.0;
        } else {
            [[unroll]] for (uint q = 0; q < 3; ++q) {
                slopes[q * plane + at] = compared ? s.slope[q] : 0.0;
            }
        }
        sum += compared ? s.value : 0.0;
    }
    const float total = group_sum(sum);
    if (gl_LocalInvocationID.x == 0 && corner.y < push.size.y) {
        ssim_sums[push.group + group_index()] = total;
    }
}
