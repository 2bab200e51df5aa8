// What the two kernels of a radix pass on a CPU must agree on: which invocation has which keys.

const uint LANES = 8;  // of a workgroup: the width of AVX

layout(push_constant) uniform Push {
    uint capacity;
    uint shares;   // invocations
    uint shift;
    uint digits;   // 1 << bits of this pass
    uint first;    // 1: keys that are NONE are left out, and a key's payload is its index
};

const uint NONE = 0xffffffffu;

// First key of a share and one past its last.
uvec2 range_of(uint n, uint share) {
    uint each = (n + shares - 1u) / shares;
    uint begin = min(share * each, n);
    return uvec2(begin, min(begin + each, n));
}

bool sorted(uint key) {
    return first == 0u || key != NONE;
}
