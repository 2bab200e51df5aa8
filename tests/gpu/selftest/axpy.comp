#version 450
// y <- a x + y. Used by the documentation and the tests of the Vulkan core.
layout(local_size_x = 64) in;
layout(push_constant) uniform Push { uint n; float a; };
layout(set = 0, binding = 0, std430) readonly buffer X { float x[]; };
layout(set = 0, binding = 1, std430) buffer Y { float y[]; };

void main() {
    uint i = (gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    if (i < n) y[i] = a * x[i] + y[i];
}
