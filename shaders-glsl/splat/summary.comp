// Gathers what a step reports into the one thing the host reads: one workgroup, fixed order of sums.
// in   visible_count, isect_count, failed, ssim_sums, loss_sums, sums (of project_backward)
// out  status
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/sum64.glsl"

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

layout(set = 0, binding = 0, std430) readonly buffer VisibleCount { uint visible_count[]; };
layout(set = 0, binding = 1, std430) readonly buffer IsectCount { uint isect_count[]; };
layout(set = 0, binding = 2, std430) readonly buffer Failed { uint failed[]; };
layout(set = 0, binding = 3, std430) readonly buffer SsimSums { float ssim_sums[]; };
layout(set = 0, binding = 4, std430) readonly buffer LossSums { vec4 loss_sums[]; };
layout(set = 0, binding = 5, std430) readonly buffer Sums { float sums[]; };
layout(set = 0, binding = 6, std430) writeonly buffer StatusOut { Status status[]; };

void main() {
    const uint i = gl_LocalInvocationID.x;
    float s = 0.0, q = 0.0;
    vec3 l = vec3(0.0);
    for (uint k = i; k < push.image_groups; k += 64) {
        s += ssim_sums[k];
        l += loss_sums[k].xyz;
    }
    s = sum64(s);
    l = vec3(sum64(l.x), sum64(l.y), sum64(l.z));
    if (i == 0) {
        status[0].visible = visible_count[0];
        status[0].intersections = isect_count[0];
        status[0].intersections_needed = isect_count[1];
        status[0].not_finite = failed[0];
        status[0].l1_sum = l.x;
        status[0].ssim_sum = s;
        status[0].exposure = float[2](l.y, l.z);
    }
    for (uint term = 0; term < 7; ++term) {
        q = 0.0;
        for (uint k = i; k < push.splat_groups; k += 64) {
            q += sums[k * 8 + term];
        }
        q = sum64(q);
        if (i == 0) {
            if (term < 6) {
                status[0].pose[term] = q;
            } else {
                status[0].gradients_refused = q;
            }
        }
    }
}
