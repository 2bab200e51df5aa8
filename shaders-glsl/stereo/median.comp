// Median of the disparities in 3 x 3 pixels, of those that have a weight; the weight stays. One thread a pixel.
// in   data
// out  medians
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Data { vec2 data[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Medians { vec2 medians[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.size.x * push.size.y) {
        return;
    }
    const ivec2 at = ivec2(i % push.size.x, i / push.size.x), last = ivec2(push.size) - 1;
    float found[9];
    uint n = 0;
    for (int v = max(at.y - 1, 0); v <= min(at.y + 1, last.y); ++v) {
        for (int u = max(at.x - 1, 0); u <= min(at.x + 1, last.x); ++u) {
            const vec2 d = data[v * int(push.size.x) + u];
            if (d.y > 0.0) {
                // Sorted by insertion.
                uint k = n++;
                const float value = d.x / d.y;
                for (; k > 0 && found[k - 1] > value; --k) {
                    found[k] = found[k - 1];
                }
                found[k] = value;
            }
        }
    }
    const float weight = data[i].y;
    medians[i] = weight > 0.0 ? weight * vec2(found[n / 2], 1.0) : vec2(0.0);
}
