// Last pass, on a CPU, of the loss (1 - λ)|x - y| + λ(1 - SSIM), mean over valid pixels, of x = gain · rendered + offset: its
// gradient by the rendered image, by gain and by offset.
// in   filtered_planes (slopes filtered along rows), grey (rendered), targets, mask
// out  grey_gradient, zero where masked; loss_sums[group]: |x - y|, gradient by gain, by offset, 0
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"
#include "../common/ssim.glsl"
#include "../common/group_sum.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint target;       // word offset of the keyframe's plane
    uint plane;        // where the rendered one and its gradient begin, px
    uint group;        // where its sums begin
    float exposure[2]; // gain, offset of the keyframe
    float l1_weight;   // (1 - λ) / valid pixels
    float ssim_weight; // λ / valid pixels
} push;

READ_FLOATS(0, Filtered, filtered_at)
READ_FLOATS(1, Grey, grey)
READ_UINTS(2, Targets, targets)
READ_UINTS(3, Mask, mask)
layout(set = 0, binding = 4, std430) writeonly buffer GreyGradient { float grey_gradient[]; };
layout(set = 0, binding = 5, std430) writeonly buffer LossSums { vec4 loss_sums[]; };

vec3 column_run(uint x, uint y0) {
    const uint plane = push.size.x * push.size.y;
    float slope[3][RUN];
    [[unroll]] for (uint q = 0; q < 3; ++q) {
        float v[REACH];
        [[unroll]] for (uint k = 0; k < REACH; ++k) {
            const int y = int(y0 + k) - int(RADIUS);
            const float m = filtered_at(q * plane + uint(clamp(y, 0, int(push.size.y) - 1)) * push.size.x + x);
            v[k] = y >= 0 && y < int(push.size.y) ? m : 0.0;
        }
        [[unroll]] for (uint k = 0; k < RUN; ++k) {
            slope[q][k] = FILTERED(v, k);
        }
    }
    const uint stride = byte_stride(push.size.x);
    vec3 sum = vec3(0.0);
    [[unroll]] for (uint k = 0; k < RUN; ++k) {
        const uint y = y0 + k;
        if (y < push.size.y) {
            const uint at = y * push.size.x + x, byte = y * stride + x;
            const bool valid = ((mask(byte / 4) >> (8 * (byte % 4))) & 255u) != 0;
            const float rendered = grey(push.plane + at);
            const float b = float((targets(push.target + byte / 4) >> (8 * (byte % 4))) & 255u) / 255.0;
            const Difference d = difference(rendered, push.exposure, b, vec3(slope[0][k], slope[1][k], slope[2][k]),
                                            vec2(push.l1_weight, push.ssim_weight));
            grey_gradient[push.plane + at] = valid ? push.exposure[0] * d.gradient : 0.0;
            sum += valid ? vec3(d.l1, d.gradient * rendered, d.gradient) : vec3(0.0);
        }
    }
    return sum;
}

void main() {
    const uint at = thread_index();
    const uint runs = (push.size.y + RUN - 1) / RUN;
    // All threads stay for the sum.
    const vec3 s = at < push.size.x * runs ? column_run(at % push.size.x, at / push.size.x * RUN) : vec3(0.0);
    const vec4 total = vec4(group_sum(s.x), group_sum(s.y), group_sum(s.z), 0.0);
    if (gl_LocalInvocationID.x == 0) {
        loss_sums[push.group + group_index()] = total;
    }
}
