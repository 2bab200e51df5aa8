// Makes the data of the filter: each pixel's disparity with its weight. What is unknown takes the lesser of the nearest
// disparities to its left and right with a smaller weight: what one eye does not see is behind what hides it, and left of
// the first match nothing but the right is known. Where both are alike, more likely nothing could be matched, and their
// surface goes on. Further away than any hidden strip is wide the weight falls to a trace.
// One thread a row.
// in   disparity
// out  data: (weight * disparity, weight)
#version 450
layout(local_size_x = 32) in;

const float TRACE = 0.01;

layout(push_constant) uniform Push {
    uvec2 size;
    float weight;  // of a pixel filled in between disparities that are alike, against 1
    float hidden;  // of another
    float alike;   // px
    float reach;   // up to here the weight is whole, at twice as far a trace, px
} push;

layout(set = 0, binding = 0, std430) readonly buffer Disparity { float disparity[]; };
layout(set = 0, binding = 1, std430) buffer Data { vec2 data[]; };

void main() {
    const uint y = gl_GlobalInvocationID.x;
    if (y >= push.size.y) {
        return;
    }
    const uint row = y * push.size.x;
    // The nearest disparity, and where it is.
    vec2 nearest = vec2(-1.0, 0.0);
    for (uint x = 0; x < push.size.x; ++x) {
        const float d = disparity[row + x];
        nearest = d >= 0.0 ? vec2(d, x) : nearest;
        data[row + x] = nearest;
    }
    nearest = vec2(-1.0, 0.0);
    for (uint x = push.size.x; x-- > 0;) {
        const vec2 left = data[row + x];
        if (left.x >= 0.0 && left.y == float(x)) {
            nearest = left;
            data[row + x] = vec2(left.x, 1.0);
        } else {
            const bool is_left = left.x >= 0.0 && (nearest.x < 0.0 || left.x <= nearest.x);
            const vec2 from = is_left ? left : nearest;
            const bool between = left.x >= 0.0 && nearest.x >= 0.0 && abs(left.x - nearest.x) <= push.alike;
            const float weight = (between ? push.weight : push.hidden) * clamp(2.0 - abs(from.y - float(x)) / push.reach, TRACE, 1.0);
            data[row + x] = from.x >= 0.0 ? weight * vec2(from.x, 1.0) : vec2(0.0);
        }
    }
}
