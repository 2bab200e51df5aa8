// How many Gaussians have which importance, in bins of a quarter octave: one thread a slot. A threshold is read off the
// sums; nothing is sorted. Counting commutes: deterministic.
// in   steps (see importance.glsl)
// out  bins[256], zeroed before: those trained long enough to be judged
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 256) in;

#include "../common/index.glsl"
#include "../common/importance.glsl"

// The bits of an importance of 2^-63, less which a quarter octave is bit 21: 256 bins reach to 2.
const uint LOWEST = 0x20000000u;
const uint QUARTER_OCTAVE = 21;

layout(push_constant) uniform Push {
    uint splats;
    uint steps_min;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Steps { uint steps[]; };
layout(set = 0, binding = 1, std430) buffer Bins { uint bins[]; };

shared uint counts[256];

void main() {
    const uint slot = thread_index(), i = gl_LocalInvocationID.x;
    counts[i] = 0;
    barrier();
    if (slot < push.splats && steps_of(steps[slot]) >= push.steps_min) {
        const uint bits = steps[slot] & 0xffff0000u;
        atomicAdd(counts[bits < LOWEST ? 0 : min((bits - LOWEST) >> QUARTER_OCTAVE, 255u)], 1);
    }
    barrier();
    if (counts[i] != 0) {
        atomicAdd(bins[i], counts[i]);
    }
}
