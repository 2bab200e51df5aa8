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

/// Steps after which a Gaussian's importance is known, and the part of it below which a view hardly shows the Gaussian.
const uint STEPS_KNOWN = 16;
const float SHOWN_MIN = 1.0 / 32.0;

/// Whether a view in which a Gaussian has such a worth shows it. What is behind others gets a gradient of noise, which Adam
/// makes as long a step of as of any other: trained from the next room alone, a wall would be worn away.
bool shown(uint state, float worth) {
    return steps_of(state) < STEPS_KNOWN || worth >= SHOWN_MIN * importance_of(state);
}
