// What the filter found, with its standard deviation. A disparity is the less sure, the further its neighbours are from it,
// the less the picture shows around it, and the less there was matched. One thread a pixel.
// in   images (left), data: (weight * disparity, weight), filtered
// out  disparity, px, negative where there is no weight; deviation, px
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"
#include "bytes.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    float weight_min;
    float fill;     // weight of what is filled in from near by; with less the variance grows
    // Parts of the variance, px²:
    float least;
    float spread;   // by (distance of the neighbours, at most 3 px)²
    float faint;    // by 1 / (1 + squared slope of grey levels)
    float missing;  // by what there is less than whole weight
} push;

layout(set = 0, binding = 0, std430) readonly buffer Images { uint images[]; };
layout(set = 0, binding = 1, std430) readonly buffer Data { vec2 data[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 3, std430) writeonly buffer Deviation { float deviation[]; };

const int AROUND = 2;
const float WINDOW = float((2 * AROUND + 1) * (2 * AROUND + 1));
const float SPREAD_MAX = 3.0;

float level(ivec2 at) {
    const uvec2 p = uvec2(clamp(at, ivec2(0), ivec2(push.size) - 1));
    return float(byte_of(images[word_of(push.size, 0, p.x, p.y)], p.x));
}

void main() {
    const uint i = thread_index();
    if (i >= push.size.x * push.size.y) {
        return;
    }
    const vec2 d = data[i];
    if (d.y < push.weight_min) {
        disparity[i] = -1.0;
        deviation[i] = 0.0;
        return;
    }
    const ivec2 at = ivec2(i % push.size.x, i / push.size.x);
    const float found = d.x / d.y;
    float weights = 0.0, slopes = 0.0, spread = 0.0;
    for (int v = -AROUND; v <= AROUND; ++v) {
        for (int u = -AROUND; u <= AROUND; ++u) {
            const ivec2 p = clamp(at + ivec2(u, v), ivec2(0), ivec2(push.size) - 1);
            const vec2 other = data[p.y * int(push.size.x) + p.x];
            weights += min(other.y, 1.0);
            const float slope = 0.5 * (level(p + ivec2(1, 0)) - level(p - ivec2(1, 0)));
            slopes += slope * slope;
            if (abs(u) <= 1 && abs(v) <= 1 && other.y >= push.weight_min) {
                spread = max(spread, min(abs(other.x / other.y - found), SPREAD_MAX));
            }
        }
    }
    disparity[i] = found;
    deviation[i] = sqrt(push.least + push.spread * spread * spread + push.faint / (1.0 + slopes / WINDOW)
        + push.missing * max(1.0 - weights / WINDOW, 0.0) * max(push.fill / d.y, 1.0));
}
