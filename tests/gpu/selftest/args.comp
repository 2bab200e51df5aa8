#version 450
// Workgroups of 64 that cover count[0] threads, for an indirect dispatch.
layout(local_size_x = 1) in;
layout(set = 0, binding = 0, std430) readonly buffer Count { uint count[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Args { uint args[]; };

void main() {
    args[0] = (count[0] + 63) / 64;
    args[1] = 1;
    args[2] = 1;
}
