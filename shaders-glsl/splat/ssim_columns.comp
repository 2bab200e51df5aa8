// Second pass of SSIM on a CPU: filters along columns, evaluates SSIM, and writes its derivatives by E[x], E[x²], E[xy].
// in   filtered_planes (moments filtered along rows), mask
// out  slopes: planes of dS/dE[x], dS/dE[x²], dS/dE[xy], zero where masked; ssim_sums[group] of S over valid pixels;
//      with MAP one plane of S itself instead, one where masked
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(constant_id = 0) const uint MAP = 0;

#include "../common/index.glsl"
#include "../common/ssim.glsl"
#include "../common/group_sum.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint group;  // where this plane's sums begin
} push;

READ_FLOATS(0, Filtered, filtered_at)
READ_UINTS(1, Mask, mask)
layout(set = 0, binding = 2, std430) writeonly buffer Slopes { float slopes[]; };
layout(set = 0, binding = 3, std430) writeonly buffer SsimSums { float ssim_sums[]; };

float column_run(uint x, uint y0) {
    const uint plane = push.size.x * push.size.y;
    float e[MOMENTS][RUN];
    [[unroll]] for (uint q = 0; q < MOMENTS; ++q) {
        float v[REACH];
        [[unroll]] for (uint k = 0; k < REACH; ++k) {
            const int y = int(y0 + k) - int(RADIUS);
            const bool inside = y >= 0 && y < int(push.size.y);
            const float m = filtered_at(q * plane + uint(clamp(y, 0, int(push.size.y) - 1)) * push.size.x + x);
            v[k] = inside ? m : 0.0;
        }
        [[unroll]] for (uint k = 0; k < RUN; ++k) {
            e[q][k] = FILTERED(v, k);
        }
    }
    const uint stride = byte_stride(push.size.x);
    float sum = 0.0;
    [[unroll]] for (uint k = 0; k < RUN; ++k) {
        const uint y = y0 + k;
        const uint byte = min(y, push.size.y - 1) * stride + x;
        const bool valid = y < push.size.y && ((mask(byte / 4) >> (8 * (byte % 4))) & 255u) != 0;
        const Similarity s = similarity(float[MOMENTS](e[0][k], e[1][k], e[2][k], e[3][k]));
        if (MAP != 0) {
            if (y < push.size.y) {
                slopes[y * push.size.x + x] = valid ? s.value : 1.0;
            }
        } else if (y < push.size.y) {
            const uint at = y * push.size.x + x;
            [[unroll]] for (uint q = 0; q < 3; ++q) {
                slopes[q * plane + at] = valid ? s.slope[q] : 0.0;
            }
        }
        sum += valid ? s.value : 0.0;
    }
    return sum;
}

void main() {
    const uint at = thread_index();
    const uint runs = (push.size.y + RUN - 1) / RUN;
    // All threads stay for the sum.
    const float s = at < push.size.x * runs ? column_run(at % push.size.x, at / push.size.x * RUN) : 0.0;
    const float total = group_sum(s);
    if (gl_LocalInvocationID.x == 0) {
        ssim_sums[push.group + group_index()] = total;
    }
}
