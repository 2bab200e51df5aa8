// The linear index of an invocation or workgroup; the host wraps long dispatches into y.

uint group_index() {
    return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
}

uint thread_index() {
    return group_index() * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
}
