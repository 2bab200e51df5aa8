// The window of SSIM (Wang et al. 2004): 11 taps, Gaussian of 1.5 px, separable. Pixels outside the image
// or the mask are zero in both images. Every thread filters a run of RUN pixels from registers.

const uint RUN = 8;
const uint RADIUS = 5;
const uint REACH = RUN + 2 * RADIUS;
const float WINDOW[11] = float[11](0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300553, 0.26601172, 0.21300553,
                                   0.10936069, 0.03600077, 0.00759876, 0.00102838);
const float C1 = 1e-4;  // (0.01)², for a range of 1
const float C2 = 9e-4;  // (0.03)²

/// Filtered value of pixel k of the run.
float filtered(float v[REACH], uint k) {
    float sum = WINDOW[5] * v[k + 5];
    [[unroll]] for (uint i = 0; i < 5; ++i) {
        sum += WINDOW[i] * (v[k + i] + v[k + 10 - i]);
    }
    return sum;
}

/// What is compared with the observed level b: an image that is white or black tells no more than that a is beyond.
/// The slope is by a.
float censored(float a, float b, out float slope) {
    const float shown = b >= 1.0 ? min(a, 1.0) : b <= 0.0 ? max(a, 0.0) : a;
    slope = shown == a ? 1.0 : 0.0;
    return shown;
}

/// Bytes a row of a stored 8-bit image takes: whole words, so that a run of 8 is two of them.
uint byte_stride(uint width) {
    return (width + 3) & ~3u;
}
