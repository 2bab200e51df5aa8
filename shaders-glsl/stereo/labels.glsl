// Regions of pixels as trees of labels: a label is a pixel of the same region that is not after it, a root its own. The
// root is the region's first pixel in whatever order regions are joined, so the result is the same in every run.
// Labels only ever decrease, which bounds every walk.

uint root_of(uint i) {
    uint up = labels[i];
    while (up != i) {
        i = up;
        up = labels[i];
    }
    return i;
}

/// Makes one region of two, whoever else is at it.
void join(uint a, uint b) {
    a = root_of(a);
    b = root_of(b);
    while (a != b) {
        const uint later = max(a, b), earlier = min(a, b);
        const uint was = atomicMin(labels[later], earlier);
        // A root still: joined. Else what it meanwhile hung from must be joined too.
        if (was == later) {
            return;
        }
        a = root_of(was);
        b = root_of(earlier);
    }
}
