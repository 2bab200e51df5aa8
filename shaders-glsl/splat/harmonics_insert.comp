// The coefficients beyond the record of new Gaussians: green and blue as they came, nothing that depends on the direction.
// in   arrival_tints, arrival_slots
// out  coefficients, coefficient_moments
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/harmonics.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint arrivals;
} push;

layout(set = 0, binding = 0, std430) readonly buffer ArrivalTints { vec2 arrival_tints[]; };
layout(set = 0, binding = 1, std430) readonly buffer ArrivalSlots { uint arrival_slots[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Coefficients { float coefficients[]; };
layout(set = 0, binding = 3, std430) writeonly buffer CoefficientMoments { vec2 coefficient_moments[]; };

void main() {
    const uint i = thread_index();
    if (i >= push.arrivals) {
        return;
    }
    const uint base = arrival_slots[i] * EXTRA;
    for (uint k = 0; k < EXTRA; ++k) {
        coefficients[base + k] = k + 1 < CHANNELS ? arrival_tints[i][k] : 0.0;
        coefficient_moments[base + k] = vec2(0.0);
    }
}
