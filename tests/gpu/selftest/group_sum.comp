#version 450
// Sums of 256 in a row: a tree in shared memory, or one subgroup at a time.
// variants: subgroup
#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_arithmetic : require
#endif
layout(local_size_x = 256) in;
layout(set = 0, binding = 0, std430) readonly buffer Items { uint items[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Sums { uint sums[]; };

shared uint part[gl_WorkGroupSize.x];

void main() {
    const uint lane = gl_LocalInvocationID.x;
    uint sum = items[gl_GlobalInvocationID.x];
    uint parts = gl_WorkGroupSize.x;
#ifdef SUBGROUP
    sum = subgroupAdd(sum);
    if (subgroupElect()) part[gl_SubgroupID] = sum;
    parts = gl_NumSubgroups;
#else
    part[lane] = sum;
#endif
    barrier();
    // Any count of parts: the upper half, rounded down, folds onto the lower.
    for (; parts > 1; parts -= parts / 2) {
        const uint kept = parts - parts / 2;
        if (lane < parts / 2) part[lane] += part[lane + kept];
        barrier();
    }
    if (lane == 0) sums[gl_WorkGroupID.x] = part[0];
}
