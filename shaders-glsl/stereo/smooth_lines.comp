// One pass of the fast global smoother (Min et al. 2014) along rows or columns: solves (I + lambda A) u = data for both
// right-hand sides, A the Laplacian of a line whose links are exp(-|difference of grey levels| / sigma). The elimination
// keeps 1 - c in place of Thomas's c, which does not cancel where lambda is large. One thread a line.
// in   images (left)
// out  data, in place; ratios
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 32) in;

#include "bytes.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint columns;        // 0: along rows, 1: along columns
    float lambda;
    float inverse_sigma;  // 1 / grey level
} push;

layout(set = 0, binding = 0, std430) readonly buffer Images { uint images[]; };
layout(set = 0, binding = 1, std430) buffer Data { vec2 data[]; };
layout(set = 0, binding = 2, std430) buffer Ratios { float ratios[]; };

float level(uint line, uint k) {
    const uvec2 at = push.columns != 0 ? uvec2(line, k) : uvec2(k, line);
    return float(byte_of(images[word_of(push.size, 0, at.x, at.y)], at.x));
}

void main() {
    const uint line = gl_GlobalInvocationID.x;
    const uint lines = push.columns != 0 ? push.size.x : push.size.y, n = push.columns != 0 ? push.size.y : push.size.x;
    if (line >= lines) {
        return;
    }
    const uint stride = push.columns != 0 ? push.size.x : 1, first = push.columns != 0 ? line : line * push.size.x;
    float before = 0.0, rest = 1.0;  // link to the pixel before; 1 - its ratio
    vec2 carried = vec2(0.0);
    float here = level(line, 0);
    vec2 next = data[first];
    for (uint k = 0; k < n; ++k) {
        const uint i = first + k * stride;
        const vec2 d = next;
        float link = 0.0;
        if (k + 1 < n) {
            const float there = level(line, k + 1);
            next = data[i + stride];
            link = push.lambda * exp(-abs(there - here) * push.inverse_sigma);
            here = there;
        }
        const float own = 1.0 + before * rest, pivot = own + link;
        carried = (d + before * carried) / pivot;
        rest = own / pivot;
        data[i] = carried;
        ratios[i] = link / pivot;
        before = link;
    }
    vec2 solved = vec2(0.0);
    for (uint k = n; k-- > 0;) {
        const uint i = first + k * stride;
        solved = data[i] + ratios[i] * solved;
        data[i] = solved;
    }
}
