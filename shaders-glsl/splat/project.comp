// Puts every Gaussian of an epoch on the image: one thread a slot, those of earlier epochs included.
// in   splats
// out  projected[slot]; keys[slot], by depth, NONE where not visible and past the last; failed[0] counts those
//      not finite
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/camera.glsl"
#include "../common/depth_key.glsl"
#include "../common/tiles.glsl"
#include "../common/index.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    Camera camera;
    uvec2 size;
    uint first;         // slots of the epoch
    uint splats;        // and their end
    float coarseness;
} push;

READ_SPLATS(0, Splats, splat)
layout(set = 0, binding = 1, std430) writeonly buffer ProjectedOut { Projected projected[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 3, std430) buffer Failed { uint failed[]; };

/// Its depth key.
uint project(Splat s, uint slot) {
    Local l;
    if (!place(push.camera, s, l)) {
        return NONE;
    }
    flatten(push.camera, vec2(push.size), l);
    const float opacity = sigmoid(s.mean_opacity.w);
    if (!(opacity > ALPHA_MIN && finite(l.centre.x) && finite(l.centre.y) && finite(vec4(l.conic, opacity)))) {
        return NONE;
    }
    const float t = level_of(opacity, push.coarseness);
    if (!(t >= 0.0)) {
        return NONE;
    }
    const vec2 extent = sqrt(t * l.cov.xz);
    if (!(all(greaterThan(l.centre + extent, vec2(0.0))) && all(lessThan(l.centre - extent, vec2(push.size))))) {
        return NONE;
    }
    projected[slot].centre_conic = vec4(l.centre, l.conic.xy);
    projected[slot].conic_shade = vec4(l.conic.z, opacity, s.scale_colour.w, l.depth);
    return depth_key(l.depth);
}

void main() {
    const uint slot = thread_index();
    if (slot >= push.splats) {
        if (slot == push.splats) {
            keys[slot] = NONE;
        }
        return;
    }
    const Splat s = splat(slot);
    keys[slot] = slot < push.first ? NONE : project(s, slot);
    if (!(finite(s.mean_opacity) && finite(s.scale_colour) && finite(s.quat))) {
        atomicAdd(failed[0], 1);
    }
}
