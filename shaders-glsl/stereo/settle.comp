// What the matching or the filter found, with its standard deviation. One thread a pixel.
// in   data: (weight * disparity, weight), filtered
// out  disparity, px, negative where the weight of matches nearby is too little; deviation, px
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint pixels;
    float weight_min;
    float matched;  // variance where every pixel around was matched, px²
    float filled;   // more where none was
    float fill;     // weight of one that was filled in from near by; with less the variance grows
} push;

layout(set = 0, binding = 0, std430) readonly buffer Data { vec2 data[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Deviation { float deviation[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.pixels) {
        return;
    }
    const vec2 d = data[i];
    disparity[i] = d.y >= push.weight_min ? d.x / d.y : -1.0;
    deviation[i] = sqrt(push.matched + push.filled * max(1.0 - d.y, 0.0) * max(push.fill / max(d.y, push.weight_min), 1.0));
}
