// Marks the Gaussians that stay: one thread a slot. Faint, huge and not finite ones go, and of those trained long enough
// to be judged the ones below an importance.
// in   splats, steps (see importance.glsl)
// out  kept[slot] (0 or 1) and a zero past the last, so that its prefix sum ends with the total
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/finite.glsl"
#include "../common/index.glsl"
#include "../common/importance.glsl"

layout(push_constant) uniform Push {
    uint splats;
    float opacity_logit_min;
    float log_scale_max;  // ln m
    float importance_min;
    uint steps_min;       // fewer: not judged by importance
} push;

layout(set = 0, binding = 0, std430) readonly buffer Splats { Splat splats[]; };
layout(set = 0, binding = 1, std430) readonly buffer Steps { uint steps[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Kept { uint kept[]; };

void main() {
    const uint slot = thread_index();
    if (slot >= push.splats) {
        if (slot == push.splats) {
            kept[slot] = 0;
        }
        return;
    }
    const Splat s = splats[slot];
    const float longest = max(s.scale_colour.x, max(s.scale_colour.y, s.scale_colour.z));
    const bool sound = finite(s.mean_opacity) && finite(s.scale_colour) && finite(s.quat) &&
                       finite(dot(s.quat, s.quat)) && dot(s.quat, s.quat) >= 1e-6;
    const bool seen = s.mean_opacity.w >= push.opacity_logit_min && longest <= push.log_scale_max;
    const bool judged = steps_of(steps[slot]) >= push.steps_min;
    const bool worth = !judged || importance_of(steps[slot]) >= push.importance_min;
    kept[slot] = sound && seen && worth ? 1 : 0;
}
