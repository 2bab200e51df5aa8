// Puts every Gaussian of the pool on the image: one thread a slot.
// in   splats
// out  projected[slot]; visible[slot] (0 or 1) and a zero past the last, so that its prefix sum ends with
//      the total; failed[0] counts those not finite
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/camera.glsl"
#include "../common/tiles.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    Camera camera;
    uvec2 size;
    uint splats;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Splats { Splat splats[]; };
layout(set = 0, binding = 1, std430) writeonly buffer ProjectedOut { Projected projected[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Visible { uint visible[]; };
layout(set = 0, binding = 3, std430) buffer Failed { uint failed[]; };

bool project(Splat s, uint slot) {
    Local l;
    if (!place(push.camera, s, l)) {
        return false;
    }
    flatten(push.camera, vec2(push.size), l);
    const float opacity = sigmoid(s.mean_opacity.w);
    if (!(opacity > ALPHA_MIN && finite(l.centre.x) && finite(l.centre.y) && finite(vec4(l.conic, opacity)))) {
        return false;
    }
    const float t = 2.0 * log(opacity / ALPHA_MIN);
    const vec2 extent = sqrt(t * l.cov.xz);
    if (!(all(greaterThan(l.centre + extent, vec2(0.0))) && all(lessThan(l.centre - extent, vec2(push.size))))) {
        return false;
    }
    projected[slot].centre_conic = vec4(l.centre, l.conic.xy);
    projected[slot].conic_shade = vec4(l.conic.z, opacity, s.scale_colour.w, l.depth);
    return true;
}

void main() {
    const uint slot = thread_index();
    if (slot >= push.splats) {
        if (slot == push.splats) {
            visible[slot] = 0;
        }
        return;
    }
    const Splat s = splats[slot];
    visible[slot] = project(s, slot) ? 1 : 0;
    if (!(finite(s.mean_opacity) && finite(s.scale_colour) && finite(s.quat))) {
        atomicAdd(failed[0], 1);
    }
}
