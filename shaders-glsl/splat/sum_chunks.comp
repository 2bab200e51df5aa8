// Sums whole chunks of a Gaussian's slots in place: 16 lanes a chunk, one a word; the workgroups walk the slots. A near
// Gaussian may cover a thousand tiles, and the one thread that project_backward has for it holds all others up: on an
// NVIDIA H200, with V1_01's map trained, that kernel took 33 µs and this one 6 in place of 57, a step 0.384 ms in place
// of 0.400, before other kernels were made faster. Only GPUs run it: a CPU adds as many numbers either way.
// in   counts.listed, owners (slot of the pool, by intersection)
// out  isect_gradients: of each chunk the first slot becomes the sum, the next word the sum of |α dL/dα|
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(constant_id = 2) const uint CHANNELS = 1;

#include "../common/types.glsl"
#include "../common/index.glsl"
#include "../common/chunks.glsl"

layout(set = 0, binding = 0, std430) readonly buffer CountsIn { Counts counts[]; };
layout(set = 0, binding = 1, std430) readonly buffer Owners { uint owners[]; };
layout(set = 0, binding = 2, std430) buffer IsectGradients { float isect_gradients[]; };

const uint SLOT = CHANNELS == 3 ? 12 : 8;

void main() {
    const uint n = counts[0].listed, i = gl_LocalInvocationID.x;
    for (uint at = group_index() * 64; at < n; at += gl_NumWorkGroups.x * 64) {
        const uint first = at + i / CHUNK * CHUNK, word = i % CHUNK;
        const bool whole = first + CHUNK <= n && owners[first] == owners[first + CHUNK - 1];
        float sum = 0.0;
        if (whole && word <= SLOT) {
            const uint from = first * SLOT + (word < SLOT ? word : WORTH);
            [[unroll]] for (uint k = 0; k < CHUNK; ++k) {
                const float g = isect_gradients[from + k * SLOT];
                sum += word < SLOT ? g : abs(g);
            }
        }
        barrier();  // all of a chunk is read
        if (whole && word <= SLOT) {
            isect_gradients[first * SLOT + word] = sum;
        }
    }
}
