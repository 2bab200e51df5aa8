// What the filter found, with its standard deviation. A disparity is the less sure, the further the window is from a plane,
// the less the picture shows in it, and the less there was matched. One thread a pixel.
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
    float bent;     // by the squared distance from a plane
    float bent_far; // by the same over the disparity, px: far off a border is a small step, as wrong as a large one near by
    float faint;    // by 1 / (1 + squared slope of grey levels)
    float missing;  // by what there is less than whole weight
} push;

layout(set = 0, binding = 0, std430) readonly buffer Images { uint images[]; };
layout(set = 0, binding = 1, std430) readonly buffer Data { vec2 data[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 3, std430) writeonly buffer Deviation { float deviation[]; };

const int AROUND = 2;
const float WINDOW = float((2 * AROUND + 1) * (2 * AROUND + 1));
const float BENT_MAX = 25.0;

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
    float weights = 0.0, slopes = 0.0;
    // Of places u, v and distances from what was found: how many, and the sums of a plane's least squares.
    float n = 0.0;
    vec3 sums = vec3(0.0), squares = vec3(0.0);
    vec2 products = vec2(0.0);
    for (int v = -AROUND; v <= AROUND; ++v) {
        for (int u = -AROUND; u <= AROUND; ++u) {
            const ivec2 p = clamp(at + ivec2(u, v), ivec2(0), ivec2(push.size) - 1);
            const vec2 other = data[p.y * int(push.size.x) + p.x];
            weights += min(other.y, 1.0);
            const float slope = 0.5 * (level(p + ivec2(1, 0)) - level(p - ivec2(1, 0)));
            slopes += slope * slope;
            if (other.y >= push.weight_min) {
                const vec3 here = vec3(u, v, other.x / other.y - found);
                n += 1.0;
                sums += here;
                squares += here * here;
                products += here.xy * here.z;
            }
        }
    }
    const vec3 mean = sums / n, variance = max(squares / n - mean * mean, vec3(0.0));
    const vec2 slope = products / n - mean.xy * mean.z;
    const vec2 explained = slope * slope / max(variance.xy, vec2(1e-3));
    const float bent = clamp(variance.z - explained.x - explained.y, 0.0, BENT_MAX);
    disparity[i] = found;
    deviation[i] = sqrt(push.least + (push.bent + push.bent_far / max(found, 1.0)) * bent
        + push.faint / (1.0 + slopes / WINDOW) + push.missing * max(1.0 - weights / WINDOW, 0.0) * max(push.fill / d.y, 1.0));
}
