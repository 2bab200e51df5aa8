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

Gradient pull_back(Camera c, Local l, vec3 log_scale, vec2 v_centre, vec3 v_conic) {
    const vec2 focal = c.focal_centre.xy;
    // v_C' = -A v_A A with the off-diagonal shared by both its entries.
    const mat2 a = mat2(l.conic.x, l.conic.y, l.conic.y, l.conic.z);
    const mat2 v_cov = -(a * mat2(v_conic.x, 0.5 * v_conic.y, 0.5 * v_conic.y, v_conic.z) * a);
    const mat3x2 v_v = 2.0 * (v_cov * l.jacobian_axes);

    // V_k = (focal / z) (axis_k.xy - slope axis_k.z)
    const vec2 j = focal * l.inv_z;
    Gradient g;
    mat3 v_axes;
    vec2 v_j = vec2(0.0), v_slope = vec2(0.0);
    g.turn = vec3(0.0);
    for (int k = 0; k < 3; ++k) {
        const vec2 scaled = j * v_v[k];
        v_axes[k] = vec3(scaled, -dot(scaled, l.slope));
        v_j += v_v[k] * (l.axes[k].xy - l.slope * l.axes[k].z);
        v_slope -= scaled * l.axes[k].z;
        g.turn += cross(l.axes[k], v_axes[k]);
    }
    // The centre uses the slope as it is, the Jacobian the clamped one.
    const vec2 v_true = focal * v_centre + vec2(l.clamped.x ? 0.0 : v_slope.x, l.clamped.y ? 0.0 : v_slope.y);
    const float v_inv_z = dot(v_true, l.p.xy) + dot(v_j, focal);
    g.cam = vec3(v_true * l.inv_z, -v_inv_z * l.inv_z * l.inv_z);

    const mat3 world_from_cam = transpose(cam_from_world(c));
    mat3 v_rotation;
    for (int k = 0; k < 3; ++k) {
        const vec3 v = world_from_cam * v_axes[k] * l.scale[k];
        v_rotation[k] = v;
        const bool held = log_scale[k] < LOG_SCALE_MIN || log_scale[k] > LOG_SCALE_MAX;
        g.scale[k] = held ? 0.0 : dot(v, l.rotation[k]);
    }
    const vec4 v_quat = quat_gradient(l.quat, v_rotation);
    g.quat = (v_quat - l.quat * dot(l.quat, v_quat)) / l.quat_norm;
    return g;
}
