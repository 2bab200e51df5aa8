// How a workgroup of 128 filters PLANES planes over a tile: each invocation filters a run of a column, of the tile and of
// its margins left and right, from registers; then rows are filtered from shared memory.

const uint COLUMNS = 64;                      // with margins
const uint ROWS = 4;                          // of a run
const uint SPAN = ROWS + 2 * RADIUS;
const uint WIDTH = COLUMNS - 2 * RADIUS;      // of a tile, px
const uint HEIGHT = gl_WorkGroupSize.x / COLUMNS * ROWS;
const uint TILE_PIXELS = WIDTH * HEIGHT;

const uint STRIP = COLUMNS * HEIGHT;          // a tile with its margins left and right
shared float strip[PLANES * STRIP];

uvec2 tile_corner(uint tile, uvec2 size) {
    const uint across = (size.x + WIDTH - 1) / WIDTH;
    return uvec2(tile % across * WIDTH, tile / across * HEIGHT);
}

bool inside(ivec2 p, uvec2 size) {
    return all(greaterThanEqual(p, ivec2(0))) && all(lessThan(p, ivec2(size)));
}

/// The pixel to read for `p`: reads that wait for no test are under way together.
uvec2 readable(ivec2 p, uvec2 size) {
    return uvec2(clamp(p, ivec2(0), ivec2(size) - 1));
}

/// Filters this invocation's run of plane `q` into the strip.
void filter_run(uint q, float v[SPAN]) {
    const uint lane = gl_LocalInvocationID.x;
    const uint at = lane / COLUMNS * ROWS * COLUMNS + lane % COLUMNS;
    [[unroll]] for (uint k = 0; k < ROWS; ++k) {
        strip[q * STRIP + at + k * COLUMNS] = FILTERED(v, k);
    }
}

/// Value of plane `q` at a pixel of the tile, filtered in both directions.
float filtered_at(uint q, uvec2 pixel) {
    const uint at = q * STRIP + pixel.y * COLUMNS + pixel.x;
    return FILTERED(strip, at);
}
