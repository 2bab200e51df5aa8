// Gathers what a step reports into the one thing the host reads: one workgroup, fixed order of sums.
// in   counts, ssim_sums, loss_sums, sums (of project_backward)
// out  status
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 128) in;

#include "../common/types.glsl"

struct Status {
    uint visible;
    uint intersections;
    uint intersections_needed;
    uint not_finite;         // Gaussians
    float l1_sum;
    float ssim_sum;
    float gradients_refused;
    float unused0;
    float pose[6];
    float exposure[2];       // gradient by gain, offset
};

layout(push_constant) uniform Push {
    uint image_groups;
    uint splat_groups;
} push;

layout(set = 0, binding = 0, std430) readonly buffer CountsIn { Counts counts[]; };
layout(set = 0, binding = 1, std430) readonly buffer SsimSums { float ssim_sums[]; };
layout(set = 0, binding = 2, std430) readonly buffer LossSums { vec4 loss_sums[]; };
layout(set = 0, binding = 3, std430) readonly buffer Sums { float sums[]; };
layout(set = 0, binding = 4, std430) writeonly buffer StatusOut { Status status[]; };

// Sums of SSIM; of |x - y| and the gradients by gain and offset; of the seven terms of project_backward.
const uint TERMS = 11;
shared float sums_of[TERMS * gl_WorkGroupSize.x];

void main() {
    const uint i = gl_LocalInvocationID.x, lanes = gl_WorkGroupSize.x;
    float sum[TERMS];
    [[unroll]] for (uint term = 0; term < TERMS; ++term) {
        sum[term] = 0.0;
    }
    for (uint k = i; k < push.image_groups; k += lanes) {
        const vec3 loss = loss_sums[k].xyz;
        sum[0] += ssim_sums[k];
        sum[1] += loss.x;
        sum[2] += loss.y;
        sum[3] += loss.z;
    }
    for (uint k = i; k < push.splat_groups; k += lanes) {
        [[unroll]] for (uint term = 4; term < TERMS; ++term) {
            sum[term] += sums[k * 8 + term - 4];
        }
    }
    [[unroll]] for (uint term = 0; term < TERMS; ++term) {
        sums_of[term * lanes + i] = sum[term];
    }
    for (uint half_width = lanes / 2; half_width > 0; half_width /= 2) {
        barrier();
        if (i < half_width) {
            [[unroll]] for (uint term = 0; term < TERMS; ++term) {
                sums_of[term * lanes + i] += sums_of[term * lanes + i + half_width];
            }
        }
    }
    if (i == 0) {
        status[0].visible = counts[0].visible;
        status[0].intersections = counts[0].listed;
        status[0].intersections_needed = counts[0].needed;
        status[0].not_finite = counts[0].not_finite;
        status[0].ssim_sum = sums_of[0];
        status[0].l1_sum = sums_of[lanes];
        status[0].exposure = float[2](sums_of[2 * lanes], sums_of[3 * lanes]);
        [[unroll]] for (uint term = 0; term < 6; ++term) {
            status[0].pose[term] = sums_of[(4 + term) * lanes];
        }
        status[0].gradients_refused = sums_of[10 * lanes];
    }
}
