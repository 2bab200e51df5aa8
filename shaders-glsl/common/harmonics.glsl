// Real spherical harmonics above the constant, up to degree 3, in the order and with the signs of the 3DGS reference
// implementation (Condon-Shortley phase); d is a unit vector from the eye to the Gaussian, in the world.
// A Gaussian's coefficients beyond its record: the constants of green and blue in colour, then by function and channel.

layout(constant_id = 2) const uint CHANNELS = 1;
layout(constant_id = 3) const uint DEGREE = 0;
const uint BASIS = DEGREE * (DEGREE + 2);
const uint EXTRA = CHANNELS * (BASIS + 1) - 1;
const uint BASIS_MAX = 15;

const float H1 = 0.4886025119029199;
const float H2[5] = float[5](1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
                             0.5462742152960396);
const float H3[7] = float[7](-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
                             -0.4570457994644658, 1.445305721320277, -0.5900435899266435);

/// Where coefficient k of a channel is, among the EXTRA of a Gaussian.
uint coefficient(uint k, uint channel) {
    return CHANNELS - 1 + k * CHANNELS + channel;
}

float[BASIS_MAX] basis_of(vec3 d) {
    const float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    float b[BASIS_MAX];
    b[0] = -H1 * y;
    b[1] = H1 * z;
    b[2] = -H1 * x;
    if (DEGREE > 1) {
        b[3] = H2[0] * x * y;
        b[4] = H2[1] * y * z;
        b[5] = H2[2] * (2.0 * zz - xx - yy);
        b[6] = H2[3] * x * z;
        b[7] = H2[4] * (xx - yy);
    }
    if (DEGREE > 2) {
        b[8] = H3[0] * y * (3.0 * xx - yy);
        b[9] = H3[1] * x * y * z;
        b[10] = H3[2] * y * (4.0 * zz - xx - yy);
        b[11] = H3[3] * z * (2.0 * zz - 3.0 * (xx + yy));
        b[12] = H3[4] * x * (4.0 * zz - xx - yy);
        b[13] = H3[5] * z * (xx - yy);
        b[14] = H3[6] * x * (xx - 3.0 * yy);
    }
    return b;
}

/// Of Σ w_k Y_k by d as a free vector; only its part across d has a meaning.
vec3 slope_of(vec3 d, float w[BASIS_MAX]) {
    const float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    vec3 s = H1 * vec3(-w[2], -w[0], w[1]);
    if (DEGREE > 1) {
        s += H2[0] * w[3] * vec3(y, x, 0.0) + H2[1] * w[4] * vec3(0.0, z, y) +
             H2[2] * w[5] * vec3(-2.0 * x, -2.0 * y, 4.0 * z) + H2[3] * w[6] * vec3(z, 0.0, x) +
             H2[4] * w[7] * vec3(2.0 * x, -2.0 * y, 0.0);
    }
    if (DEGREE > 2) {
        s += H3[0] * w[8] * vec3(6.0 * x * y, 3.0 * (xx - yy), 0.0) + H3[1] * w[9] * vec3(y * z, x * z, x * y) +
             H3[2] * w[10] * vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z) +
             H3[3] * w[11] * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * (xx + yy)) +
             H3[4] * w[12] * vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z) +
             H3[5] * w[13] * vec3(2.0 * x * z, -2.0 * y * z, xx - yy) +
             H3[6] * w[14] * vec3(3.0 * (xx - yy), -6.0 * x * y, 0.0);
    }
    return s;
}
