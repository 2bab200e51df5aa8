// Kannala and Brandt's lens (IEEE TPAMI 2006) and its local affine map. With u = x² + y², θ the angle off the
// axis and D = θ (1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸), three scalars of u and z hold centre and Jacobian:
//   m = f (a x, a y)    J = f [a + g x², g x y, -h x; g x y, a + g y², -h y]
//   a = D / √u,  h = D'(θ) / (u + z²) = -∂a/∂z,  g = (z h - a) / u = 2 ∂a/∂u
// Near the axis these cancel; there they are series of s = u / z²: a = F(s) / z.

struct Distortion {
    float a, g, h;
    float g_u, g_z, h_u, h_z;  // their slopes, for the backward pass
};

const float NEAR_AXIS = 0.01;  // of s; the first term left out of F'' is 2e-5 of it there
const float HALF_PI = 1.5707963267948966;

/// atan2(r, z) for r >= 0 to f32 (Cephes); the built-in one may be off by 4096 ulp.
float angle_off_axis(float r, float z) {
    const float d = abs(z);
    const bool steep = r > 2.414213562 * d, middle = r > 0.414213562 * d;
    const float t = steep ? -d / r : middle ? (r - d) / (r + d) : r / d;
    const float t2 = t * t;
    const float p = (((8.05374449538e-2 * t2 - 1.38776856032e-1) * t2 + 1.99777106478e-1) * t2 - 3.33329491539e-1) * t2;
    const float angle = (steep ? HALF_PI : middle ? 0.5 * HALF_PI : 0.0) + (p * t + t);
    return z < 0.0 ? 2.0 * HALF_PI - angle : angle;
}

Distortion distort_near_axis(vec4 k, float s, float z) {
    const float c1 = k.x - 1.0 / 3.0, c2 = 0.2 - k.x + k.y;
    const float c3 = -1.0 / 7.0 + 14.0 / 15.0 * k.x - 5.0 / 3.0 * k.y + k.z;
    const float c4 = 1.0 / 9.0 - 818.0 / 945.0 * k.x + 19.0 / 9.0 * k.y - 7.0 / 3.0 * k.z + k.w;
    const float f0 = 1.0 + s * (c1 + s * (c2 + s * (c3 + s * c4)));
    const float f1 = c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * 4.0 * c4));
    const float f2 = 2.0 * c2 + s * (6.0 * c3 + s * 12.0 * c4);
    const float w = 1.0 / z, w2 = w * w;
    const float e = f0 + 2.0 * s * f1, e_s = 3.0 * f1 + 2.0 * s * f2;
    return Distortion(f0 * w, 2.0 * f1 * w2 * w, e * w2, 2.0 * f2 * w2 * w2 * w, -(6.0 * f1 + 4.0 * s * f2) * w2 * w2,
                e_s * w2 * w2, -2.0 * (e + s * e_s) * w2 * w);
}

Distortion distort(vec4 k, vec3 p) {
    const float u = dot(p.xy, p.xy), z = p.z;
    if (z > 0.0 && u < NEAR_AXIS * z * z) {
        return distort_near_axis(k, u / (z * z), z);
    }
    const float r = sqrt(u), theta = angle_off_axis(r, z), t2 = theta * theta;
    const float d = theta * (1.0 + t2 * (k.x + t2 * (k.y + t2 * (k.z + t2 * k.w))));
    const float d1 = 1.0 + t2 * (3.0 * k.x + t2 * (5.0 * k.y + t2 * (7.0 * k.z + t2 * 9.0 * k.w)));
    const float d2 = theta * (6.0 * k.x + t2 * (20.0 * k.y + t2 * (42.0 * k.z + t2 * 72.0 * k.w)));
    const float inv = 1.0 / (u + z * z);
    Distortion b;
    b.a = d / r;
    b.h = d1 * inv;
    b.g = (z * b.h - b.a) / u;
    b.h_u = (0.5 * d2 * z / r - d1) * inv * inv;
    b.h_z = -(d2 * r + 2.0 * z * d1) * inv * inv;
    b.g_u = (z * b.h_u - 1.5 * b.g) / u;
    b.g_z = (2.0 * b.h + z * b.h_z) / u;
    return b;
}

/// J without the focal length: columns by x, y, z.
mat3x2 distortion_jacobian(Distortion b, vec3 p) {
    const float cross_term = b.g * p.x * p.y;
    return mat3x2(b.a + b.g * p.x * p.x, cross_term, cross_term, b.a + b.g * p.y * p.y, -b.h * p.x, -b.h * p.y);
}

/// By p, from the gradients by the centre and by J, both times the focal length.
vec3 distortion_gradient(Distortion b, vec3 p, vec2 v_centre, mat3x2 v_jacobian) {
    const float x = p.x, y = p.y;
    const float shear = v_jacobian[1].x + v_jacobian[0].y;
    const float v_a = v_jacobian[0].x + v_jacobian[1].y + dot(v_centre, p.xy);
    const float v_g = x * x * v_jacobian[0].x + x * y * shear + y * y * v_jacobian[1].y;
    const float v_h = -dot(v_jacobian[2], p.xy);
    const float v_u = 0.5 * v_a * b.g + v_g * b.g_u + v_h * b.h_u;
    return vec3(b.g * (2.0 * x * v_jacobian[0].x + y * shear) - b.h * v_jacobian[2].x + b.a * v_centre.x + 2.0 * x * v_u,
                b.g * (x * shear + 2.0 * y * v_jacobian[1].y) - b.h * v_jacobian[2].y + b.a * v_centre.y + 2.0 * y * v_u,
                -v_a * b.h + v_g * b.g_z + v_h * b.h_z);
}
