// Adjoint of camera.glsl: from the gradient by centre and conic to that by position, scale and rotation.

struct Gradient {
    vec3 cam;    // by the position in the camera frame
    vec3 turn;   // by a small rotation of the camera frame, from the shape alone
    vec3 scale;  // by log scale
    vec4 quat;   // by the stored quaternion
};

vec4 quat_gradient(vec4 q, mat3 v) {
    const float x = q.x, y = q.y, z = q.z, w = q.w;
    // v[column][row]
    return 2.0 * vec4(-2.0 * x * (v[1][1] + v[2][2]) + y * (v[0][1] + v[1][0]) + z * (v[0][2] + v[2][0]) + w * (v[1][2] - v[2][1]),
                      x * (v[0][1] + v[1][0]) - 2.0 * y * (v[0][0] + v[2][2]) + z * (v[1][2] + v[2][1]) + w * (v[2][0] - v[0][2]),
                      x * (v[0][2] + v[2][0]) + y * (v[1][2] + v[2][1]) - 2.0 * z * (v[0][0] + v[1][1]) + w * (v[0][1] - v[1][0]),
                      x * (v[1][2] - v[2][1]) + y * (v[2][0] - v[0][2]) + z * (v[0][1] - v[1][0]));
}

/// By the position, and by each axis, from the gradients by the centre and by the axes on the image.
vec3 pull_back_pinhole(vec2 focal, Local l, vec2 v_centre, mat3x2 v_v, out mat3 v_axes) {
    // V_k = (focal / z) (axis_k.xy - slope axis_k.z)
    const vec2 j = focal * l.inv_z;
    vec2 v_j = vec2(0.0), v_slope = vec2(0.0);
    for (int k = 0; k < 3; ++k) {
        const vec2 scaled = j * v_v[k];
        v_axes[k] = vec3(scaled, -dot(scaled, l.slope));
        v_j += v_v[k] * (l.axes[k].xy - l.slope * l.axes[k].z);
        v_slope -= scaled * l.axes[k].z;
    }
    // The centre uses the slope as it is, the Jacobian the clamped one.
    const vec2 v_true = focal * v_centre + vec2(l.clamped.x ? 0.0 : v_slope.x, l.clamped.y ? 0.0 : v_slope.y);
    const float v_inv_z = dot(v_true, l.p.xy) + dot(v_j, focal);
    return vec3(v_true * l.inv_z, -v_inv_z * l.inv_z * l.inv_z);
}

vec3 pull_back_fisheye(vec2 focal, vec4 k, Local l, vec2 v_centre, mat3x2 v_v, out mat3 v_axes) {
    const Distortion b = distort(k, l.p);
    const mat3x2 j = distortion_jacobian(b, l.p);
    mat3x2 v_j = mat3x2(0.0);
    for (int i = 0; i < 3; ++i) {
        const vec2 scaled = focal * v_v[i];
        v_axes[i] = scaled * j;
        v_j += outerProduct(scaled, l.axes[i]);
    }
    return distortion_gradient(b, l.p, focal * v_centre, v_j);
}

/// A V_k = adj(C') V_k / det without the cancellation of the product: a needle's own terms are zero exactly.
mat3x2 whitened(Local l) {
    const mat3x2 v = l.jacobian_axes;
    mat3x2 w;
    for (int k = 0; k < 3; ++k) {
        const vec2 a = v[(k + 1) % 3], b = v[(k + 2) % 3];
        const float ak = a.x * v[k].y - a.y * v[k].x, bk = b.x * v[k].y - b.y * v[k].x;
        w[k] = (vec2(-a.y, a.x) * ak + vec2(-b.y, b.x) * bk + LOW_PASS * v[k]) / l.det;
    }
    return w;
}

Gradient pull_back(Camera c, Local l, vec3 log_scale, vec2 v_centre, vec3 v_conic) {
    // v_C' = -A v_A A with the off-diagonal shared by both its entries; v_V = 2 v_C' V.
    const mat2 a = mat2(l.conic.x, l.conic.y, l.conic.y, l.conic.z);
    const mat3x2 w = whitened(l);
    const mat3x2 v_aw = -2.0 * (mat2(v_conic.x, 0.5 * v_conic.y, 0.5 * v_conic.y, v_conic.z) * w);
    const mat3x2 v_v = a * v_aw;

    Gradient g;
    mat3 v_axes;
    if (FISHEYE) {
        g.cam = pull_back_fisheye(c.focal_centre.xy, c.distortion, l, v_centre, v_v, v_axes);
    } else {
        g.cam = pull_back_pinhole(c.focal_centre.xy, l, v_centre, v_v, v_axes);
    }
    g.turn = vec3(0.0);
    for (int k = 0; k < 3; ++k) {
        g.turn += cross(l.axes[k], v_axes[k]);
    }

    const mat3 world_from_cam = transpose(cam_from_world(c));
    mat3 v_rotation;
    for (int k = 0; k < 3; ++k) {
        v_rotation[k] = world_from_cam * v_axes[k] * l.scale[k];
        const bool held = log_scale[k] < LOG_SCALE_MIN || log_scale[k] > LOG_SCALE_MAX;
        // V_k grows with its scale: V_kᵀ v_V_k.
        g.scale[k] = held ? 0.0 : dot(w[k], v_aw[k]);
    }
    const vec4 v_quat = quat_gradient(l.quat, v_rotation);
    g.quat = (v_quat - l.quat * dot(l.quat, v_quat)) / l.quat_norm;
    return g;
}
