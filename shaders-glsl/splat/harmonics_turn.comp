// Turns the colours of one anchor's Gaussians with it: what was seen along d is then seen along R d. Each new coefficient
// is the projection of the turned colour on its function, Σ w c(Rᵀ d) Y_k(d) over directions on which it is exact: four
// Gauss-Legendre heights by seven azimuths integrate every product of two functions of degree 3. Second moments stay;
// first moments, which forget within ten steps, start anew. One thread a slot of the block.
// in, out  coefficients, coefficient_moments
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/harmonics.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    vec4 turn;   // R as xyzw
    uint first;  // slot
    uint count;
} push;

layout(set = 0, binding = 0, std430) buffer Coefficients { float coefficients[]; };
layout(set = 0, binding = 1, std430) buffer CoefficientMoments { vec2 coefficient_moments[]; };

const uint AZIMUTHS = 7;
const float STEP = 6.283185307179586 / float(AZIMUTHS);
const vec2 HEIGHT = vec2(0.3399810435848563, 0.8611363115940526);
const vec2 WEIGHT = vec2(0.6521451548625461, 0.3478548451374538);

/// Rᵀ v.
vec3 unturned(vec3 v) {
    return v + 2.0 * cross(-push.turn.xyz, cross(-push.turn.xyz, v) + push.turn.w * v);
}

void main() {
    const uint i = thread_index();
    if (i >= push.count) {
        return;
    }
    const uint base = (push.first + i) * EXTRA;
    for (uint channel = 0; channel < CHANNELS; ++channel) {
        float turned[BASIS_MAX];
        for (uint k = 0; k < BASIS; ++k) {
            turned[k] = 0.0;
        }
        for (uint q = 0; q < 4 * AZIMUTHS; ++q) {
            const float height = HEIGHT[q & 1], z = (q & 2u) != 0 ? height : -height, across = sqrt(1.0 - z * z);
            const vec3 d = vec3(across * cos(STEP * float(q / 4)), across * sin(STEP * float(q / 4)), z);
            const float before[BASIS_MAX] = basis_of(unturned(d)), b[BASIS_MAX] = basis_of(d);
            float seen = 0.0;
            for (uint k = 0; k < BASIS; ++k) {
                seen += before[k] * coefficients[base + coefficient(k, channel)];
            }
            for (uint k = 0; k < BASIS; ++k) {
                turned[k] += WEIGHT[q & 1] * STEP * seen * b[k];
            }
        }
        for (uint k = 0; k < BASIS; ++k) {
            const uint at = base + coefficient(k, channel);
            coefficients[at] = turned[k];
            coefficient_moments[at].x = 0.0;
        }
    }
}
