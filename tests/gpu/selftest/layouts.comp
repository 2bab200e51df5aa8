#version 450
// Every type that crosses from host to shader, moved through: push and specialisation constants to a buffer.
layout(local_size_x = 8, local_size_x_id = 0, local_size_y = 2) in;
layout(constant_id = 0) const uint WIDTH = 8;
layout(constant_id = 1) const float SCALE = 0.5;
layout(constant_id = 3) const int OFFSET = -3;
layout(constant_id = 4) const bool FLIP = true;

struct Inner { vec4 v; ivec2 i; uvec2 u; };
struct Wide { mat4 m; vec4 a; vec2 b; float c; uint d; int e[3]; uint group_width; Inner inner; ivec4 f; uvec4 g; };

layout(push_constant) uniform Push { mat4 m; Inner inner; float c[3]; int d; uvec2 b; } push;
layout(set = 0, binding = 2, std430) writeonly buffer Out { Wide wides[]; } wide_out;
layout(set = 0, binding = 5, std430) readonly buffer Totals { vec2 half_sum; uint count; float spare[5]; } totals;

void main() {
    Wide w;
    w.m = push.m;
    w.a = push.inner.v * SCALE;
    w.b = totals.half_sum;
    w.c = push.c[2] + totals.spare[4];
    w.d = totals.count;
    w.e = int[3](push.d, OFFSET, FLIP ? 1 : 0);
    w.group_width = gl_WorkGroupSize.x;
    w.inner = Inner(push.inner.v.wzyx, push.inner.i.yx, push.inner.u.yx);
    w.f = ivec4(push.inner.i, -1, -2);
    w.g = uvec4(push.b, 1, 2);
    wide_out.wides[gl_GlobalInvocationID.y * WIDTH + gl_GlobalInvocationID.x] = w;
}
