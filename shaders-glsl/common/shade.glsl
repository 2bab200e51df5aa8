// What the forward and the backward raster must do alike: where a lane's pixels are, how a batch of
// Gaussians is fetched, and how much of it a pixel sees.

// Beyond the last visible contribution: (1 - ALPHA_MAX)².
const float TRANSMITTANCE_MIN = 1e-4;
const float ALPHA_MAX = 0.99;
const float LOG2_E = 1.4426950408889634;

/// Top pixel of this lane's column of COLUMN pixels.
uvec2 column_of(uint tile, uvec2 size) {
    const uint across = tile_grid(size).x;
    const uvec2 corner = uvec2(tile % across, tile / across) * uvec2(TILE_W, TILE_H);
    return corner + uvec2(lane() % TILE_W, lane() / TILE_W * COLUMN);
}

/// A Gaussian as seen by one column: log2 α(y) = peak - y' (slope + curve y'), y' = centre - pixel.
struct Column {
    vec2 d;       // centre - top pixel, px
    vec3 conic;
    float peak, slope, curve;
    float grey, depth;
};

Column column_terms(Batch g, vec2 top) {
    Column c;
    c.d = g.a.xy - top;
    c.conic = vec3(g.a.zw, g.b.x);
    c.peak = g.b.y - 0.5 * LOG2_E * c.conic.x * c.d.x * c.d.x;  // b.y holds log2 opacity
    c.slope = LOG2_E * c.conic.y * c.d.x;
    c.curve = 0.5 * LOG2_E * c.conic.z;
    c.grey = g.b.z;
    c.depth = g.b.w;
    return c;
}

/// Opacity of the Gaussian at a pixel before the cap.
float alpha_at(Column c, float dy) {
    return exp2(c.peak - dy * (c.slope + c.curve * dy));
}

/// What is blended: nothing where it is invisible or the pixel is already opaque.
float effective(float raw, float transmittance) {
    const bool seen = raw >= ALPHA_MIN && transmittance > TRANSMITTANCE_MIN;
    return seen ? min(raw, ALPHA_MAX) : 0.0;
}
