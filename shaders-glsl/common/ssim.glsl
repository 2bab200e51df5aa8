// The window of SSIM (Wang et al. 2004): 11 taps, Gaussian of 1.5 px, separable. Pixels outside the image
// or the mask are zero in both images. On a CPU every thread filters a run of RUN pixels from registers (`FILTERED`);
// GPUs filter tiles (ssim_tile.glsl).

const uint RUN = 8;
const uint RADIUS = 5;
const uint REACH = RUN + 2 * RADIUS;
const float WINDOW[11] = float[11](0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300553, 0.26601172, 0.21300553,
                                   0.10936069, 0.03600077, 0.00759876, 0.00102838);
const float C1 = 1e-4;  // (0.01)², for a range of 1
const float C2 = 9e-4;  // (0.03)²

/// The value of array `v` filtered by the window whose first tap is at `k`. A macro, since arrays have several sizes, and one
/// lies in shared memory.
#define FILTERED(v, k)                                                                             \
    (WINDOW[5] * v[(k) + 5]                                                                        \
     + WINDOW[0] * (v[k] + v[(k) + 10]) + WINDOW[1] * (v[(k) + 1] + v[(k) + 9])                    \
     + WINDOW[2] * (v[(k) + 2] + v[(k) + 8]) + WINDOW[3] * (v[(k) + 3] + v[(k) + 7])               \
     + WINDOW[4] * (v[(k) + 4] + v[(k) + 6]))

/// What is compared with the observed level b: an image that is white or black tells no more than that a is beyond.
/// The slope is by a.
float censored(float a, float b, out float slope) {
    const float shown = b >= 1.0 ? min(a, 1.0) : b <= 0.0 ? max(a, 0.0) : a;
    slope = shown == a ? 1.0 : 0.0;
    return shown;
}

struct Similarity {
    float value;     // SSIM
    float slope[3];  // by E[x], E[x²], E[xy]
};

/// What is filtered for SSIM, plane by plane: x, y, x² + y², xy. The squares are only needed together.
const uint MOMENTS = 4;
#define MOMENT(q, x, y) (q == 0 ? x : q == 1 ? y : q == 2 ? x * x + y * y : x * y)

/// SSIM from E[x], E[y], E[x² + y²], E[xy].
Similarity similarity(float e[MOMENTS]) {
    const float mx = e[0], my = e[1];
    const float a1 = 2.0 * mx * my + C1, b1 = mx * mx + my * my + C1;
    const float a2 = 2.0 * (e[3] - mx * my) + C2;
    const float b2 = max(e[2] - mx * mx - my * my, 0.0) + C2;
    const float inv = 1.0 / (b1 * b2);
    const float s = a1 * a2 * inv;
    return Similarity(s, float[3](2.0 * (my * (a2 - a1) * inv - mx * s / b1 + mx * s / b2), -s / b2, 2.0 * a1 * inv));
}

struct Difference {
    float l1;
    float gradient;  // of the loss, by the rendering in the keyframe's exposure
};

/// What a pixel adds to the loss: rendered level, exposure (gain, offset), observed level b, the derivatives of SSIM
/// filtered once more, and the weights of L1 and SSIM.
Difference difference(float rendered, float exposure[2], float b, vec3 slope, vec2 weight) {
    float gate;
    const float a = censored(exposure[0] * rendered + exposure[1], b, gate);
    const float d_ssim = slope.x + 2.0 * a * slope.y + b * slope.z;
    return Difference(abs(a - b), gate * (weight.x * sign(a - b) - weight.y * d_ssim));
}

/// Bytes a row of a stored 8-bit image takes: whole words, so that a run of 8 is two of them.
uint byte_stride(uint width) {
    return (width + 3) & ~3u;
}
