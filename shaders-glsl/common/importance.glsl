// A Gaussian's training state in one word: below, how many Adam steps it has had; above, its importance as the upper
// half of a float (8 bits of mantissa), so that it costs no memory and no binding of its own, and orders as its bits.

const uint STEPS_MAX = 65535;
/// Weight of the newest view: the mean reaches back about as far as a keyframe is drawn anew.
const float NEWEST = 1.0 / 16.0;

uint steps_of(uint state) {
    return state & 0xffffu;
}

/// Not negative.
float importance_of(uint state) {
    return uintBitsToFloat(state & 0xffff0000u);
}

/// After one more step, in which removing the Gaussian would have changed the loss by about `worth`.
uint after_step(uint state, float worth) {
    const uint count = min(steps_of(state) + 1, STEPS_MAX);
    const float before = importance_of(state);
    const float importance = count == 1 ? worth : before + NEWEST * (worth - before);
    return ((floatBitsToUint(min(importance, 1e30)) + 0x8000u) & 0xffff0000u) | count;
}
