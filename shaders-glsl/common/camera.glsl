// The camera of a view, pinhole or fisheye, and the local affine projection of a Gaussian through it (EWA;
// Zwicker et al. 2001). Everything the backward pass needs is kept in `Local`.

#include "finite.glsl"
#include "fisheye.glsl"

layout(constant_id = 10) const bool FISHEYE = false;

struct Camera {
    vec4 rotation;      // cam_from_world, xyzw
    vec4 translation;   // cam_from_world, m; fisheye: the widest angle off the axis, rad
    vec4 focal_centre;  // fx, fy, cx, cy of the host: integer = pixel centre, px
    vec4 distortion;    // fisheye: k1..k4
};

struct Local {
    vec3 p;         // position in the camera frame, m
    float depth;    // along the axis, m; fisheye: distance, which grows behind the camera too
    float inv_z;
    vec2 slope;     // x/z, y/z clamped to just outside the image
    bvec2 clamped;
    vec4 quat;      // unit
    float quat_norm;
    vec3 scale;     // m
    mat3 rotation;  // world_from_splat
    mat3 axes;      // camera-frame columns scale_k · axis_k
    mat3x2 jacobian_axes;  // V = J · axes, px
    vec3 cov;       // C' = V Vᵀ + LOW_PASS I: xx, xy, yy, px²
    float det;      // of C', px⁴
    vec3 conic;     // C'⁻¹
    vec2 centre;    // px, half-integer pixel centres
};

const float LOW_PASS = 0.3;         // px², keeps every Gaussian about a pixel wide
const float LOG_SCALE_MIN = -11.5;  // 1e-5 m
const float LOG_SCALE_MAX = 4.6;    // 100 m
const float MARGIN = 0.15;          // of the image; outside it the affine approximation is frozen

/// The only place where pixel centres move from integers (host) to half-integers (kernels).
vec2 principal_point(Camera c) {
    return c.focal_centre.zw + 0.5;
}

mat3 rotation_of(vec4 q) {
    const float x = q.x, y = q.y, z = q.z, w = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

mat3 cam_from_world(Camera c) {
    return rotation_of(c.rotation);
}

bool in_view(Camera c, Local l) {
    if (FISHEYE) {
        return l.depth >= NEAR && angle_off_axis(length(l.p.xy), l.p.z) <= c.translation.w;
    }
    return l.depth >= NEAR;
}

/// The Gaussian in the camera frame; false when it is not in front of the camera or not finite.
bool place(Camera c, Splat s, out Local l) {
    l.p = cam_from_world(c) * s.mean_opacity.xyz + c.translation.xyz;
    l.depth = FISHEYE ? length(l.p) : l.p.z;
    const float norm2 = dot(s.quat, s.quat);
    if (!(finite(vec4(l.p, l.depth)) && in_view(c, l) && finite(s.mean_opacity) && finite(s.scale_colour) &&
          finite(norm2) && norm2 >= 1e-6)) {
        return false;
    }
    l.inv_z = 1.0 / l.p.z;
    l.quat_norm = sqrt(norm2);
    l.quat = s.quat / l.quat_norm;
    l.scale = exp(clamp(s.scale_colour.xyz, LOG_SCALE_MIN, LOG_SCALE_MAX));
    return true;
}

/// Centre and the Gaussian's axes on the image.
void flatten_pinhole(Camera c, vec2 size, inout Local l) {
    const vec2 focal = c.focal_centre.xy, pp = principal_point(c);
    const vec2 slope = l.p.xy * l.inv_z;
    l.slope = clamp(slope, (-MARGIN * size - pp) / focal, ((1.0 + MARGIN) * size - pp) / focal);
    l.clamped = notEqual(l.slope, slope);
    l.centre = focal * slope + pp;
    const vec2 j = focal * l.inv_z;
    for (int k = 0; k < 3; ++k) {
        l.jacobian_axes[k] = j * (l.axes[k].xy - l.slope * l.axes[k].z);
    }
}

void flatten_fisheye(Camera c, inout Local l) {
    const vec2 focal = c.focal_centre.xy;
    const Distortion b = distort(c.distortion, l.p);
    l.centre = focal * b.a * l.p.xy + principal_point(c);
    const mat3x2 j = distortion_jacobian(b, l.p);
    for (int k = 0; k < 3; ++k) {
        l.jacobian_axes[k] = focal * (j * l.axes[k]);
    }
}

void flatten(Camera c, vec2 size, inout Local l) {
    l.rotation = rotation_of(l.quat);
    const mat3 r = cam_from_world(c) * l.rotation;
    l.axes = mat3(r[0] * l.scale.x, r[1] * l.scale.y, r[2] * l.scale.z);
    if (FISHEYE) {
        flatten_fisheye(c, l);
    } else {
        flatten_pinhole(c, size, l);
    }
    const mat3x2 v = l.jacobian_axes;
    const vec3 vx = vec3(v[0].x, v[1].x, v[2].x), vy = vec3(v[0].y, v[1].y, v[2].y);
    l.cov = vec3(dot(vx, vx) + LOW_PASS, dot(vx, vy), dot(vy, vy) + LOW_PASS);
    // det(V Vᵀ) by cross product: never negative, no cancellation for needles.
    const vec3 n = cross(vx, vy);
    l.det = max(dot(n, n) + LOW_PASS * (l.cov.x + l.cov.z) - LOW_PASS * LOW_PASS, 1e-12);
    l.conic = vec3(l.cov.z, -l.cov.y, l.cov.x) / l.det;
}

float sigmoid(float x) {
    return 1.0 / (1.0 + exp(-x));
}
