// Moves the Gaussians of one anchor rigidly, x' = R x + t: means and rotations, and with them what Adam remembers of
// their gradients. Second moments have no direction: they turn as variances of independent components do, by the squares.
// One thread a slot of the block.
// in, out  splats, moments
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    vec4 row0, row1, row2;  // R, t
    vec4 quat;              // R as xyzw
    uint first;             // slot
    uint count;
} push;

layout(set = 0, binding = 0, std430) buffer Splats { Splat splats[]; };
layout(set = 0, binding = 1, std430) buffer MomentsInOut { Moments moments[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.count) {
        return;
    }
    const uint slot = push.first + i;
    const vec4 q = push.quat;
    const mat3 turn = transpose(mat3(push.row0.xyz, push.row1.xyz, push.row2.xyz));
    // Columns of the product of quaternions from the left, q ⊗ p = left p.
    const mat4 left = mat4(q.w, q.z, -q.y, -q.x, -q.z, q.w, q.x, -q.y, q.y, -q.x, q.w, -q.z, q.x, q.y, q.z, q.w);
    const vec4 at = vec4(splats[slot].mean_opacity.xyz, 1.0);
    splats[slot].mean_opacity.xyz = vec3(dot(push.row0, at), dot(push.row1, at), dot(push.row2, at));
    splats[slot].quat = left * splats[slot].quat;
    moments[slot].m[0].xyz = turn * moments[slot].m[0].xyz;
    moments[slot].v[0].xyz = matrixCompMult(turn, turn) * moments[slot].v[0].xyz;
    moments[slot].m[2] = left * moments[slot].m[2];
    moments[slot].v[2] = matrixCompMult(left, left) * moments[slot].v[2];
}
