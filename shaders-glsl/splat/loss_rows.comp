// Third pass of SSIM on a CPU: the window is symmetric, so its adjoint filters the slopes once more, first along rows.
// in   slopes
// out  filtered_planes: the three, filtered along rows
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"
#include "../common/ssim.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
} push;

READ_FLOATS(0, Slopes, slope_at)
layout(set = 0, binding = 1, std430) writeonly buffer Filtered { float filtered_planes[]; };

void main() {
    const uint runs = (push.size.x + RUN - 1) / RUN;
    const uint at = thread_index();
    if (at >= runs * push.size.y) {
        return;
    }
    const uint row = at / runs * push.size.x, x0 = at % runs * RUN;
    const uint plane = push.size.x * push.size.y;
    const uint n = min(RUN, push.size.x - x0);
    [[unroll]] for (uint q = 0; q < 3; ++q) {
        float v[REACH];
        [[unroll]] for (uint k = 0; k < REACH; ++k) {
            const int x = int(x0 + k) - int(RADIUS);
            const float s = slope_at(q * plane + row + uint(clamp(x, 0, int(push.size.x) - 1)));
            v[k] = x >= 0 && x < int(push.size.x) ? s : 0.0;
        }
        [[unroll]] for (uint k = 0; k < RUN; ++k) {
            if (k < n) {
                filtered_planes[q * plane + row + x0 + k] = FILTERED(v, k);
            }
        }
    }
}
