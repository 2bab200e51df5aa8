// Frees the slots of Gaussians that are faint, huge or not finite: one thread a slot.
// in   splats
// out  splats (quaternion zeroed), freed[slot] (0 or 1)
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/finite.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint splats;
    float opacity_logit_min;
    float log_scale_max;  // ln m
} push;

layout(set = 0, binding = 0, std430) buffer Splats { Splat splats[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Freed { uint freed[]; };

void main() {
    const uint slot = thread_index();
    if (slot >= push.splats) {
        return;
    }
    const Splat s = splats[slot];
    const bool alive = any(notEqual(floatBitsToUint(s.quat), uvec4(0)));
    const float longest = max(s.scale_colour.x, max(s.scale_colour.y, s.scale_colour.z));
    const bool sound = finite(s.mean_opacity) && finite(s.scale_colour) && finite(s.quat) &&
                       finite(dot(s.quat, s.quat)) && dot(s.quat, s.quat) >= 1e-6;
    const bool keep = sound && s.mean_opacity.w >= push.opacity_logit_min && longest <= push.log_scale_max;
    if (alive && !keep) {
        splats[slot] = Splat(vec4(0.0), vec4(0.0), vec4(0.0));
    }
    freed[slot] = alive && !keep ? 1 : 0;
}
