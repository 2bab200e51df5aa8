// What the forward and the backward raster must do alike: where a lane's pixels are, how a batch of
// Gaussians is fetched, and how much of it a pixel sees.

// Beyond the last visible contribution: (1 - ALPHA_MAX)².
const float TRANSMITTANCE_MIN = 1e-4;
const float ALPHA_MAX = 0.99;
const float LOG2_E = 1.4426950408889634;

/// Top pixel of this lane's column.
uvec2 column_of(uint tile, uvec2 size) {
    const uint across = tile_grid(size).x;
    const uvec2 corner = uvec2(tile % across, tile / across) * uvec2(TILE_W, TILE_H);
    return corner + uvec2(lane() % TILE_W, lane() / TILE_W * COLUMN);
}

/// What every lane needs of a Gaussian: its record and, in colour, its green and blue; past the end of a list one that no
/// pixel sees.
Batch batch_of(Projected g, vec2 chroma, uint slot, bool listed) {
    const float opacity = listed ? log2(g.conic_shade.y) : LOG2_UNSEEN;
    return Batch(g.centre_conic, vec4(g.conic_shade.x, opacity, g.conic_shade.zw), chroma, slot);
}

/// A Gaussian as seen by one column: log2 α of its k-th pixel from the top is peak + k (slope + k curve).
struct Column {
    vec2 d;       // centre - top pixel, px
    vec3 conic;
    float peak, slope, curve;
    vec3 colour;  // grey, or red, green, blue
    float depth;
};

Column column_terms(Batch g, vec2 top) {
    Column c;
    c.d = g.a.xy - top;
    c.conic = vec3(g.a.zw, g.b.x);
    c.curve = -0.5 * LOG2_E * c.conic.z;
    const float across = LOG2_E * c.conic.y * c.d.x;
    // b.y holds log2 opacity
    c.peak = g.b.y - 0.5 * LOG2_E * c.conic.x * c.d.x * c.d.x - c.d.y * (across - c.curve * c.d.y);
    c.slope = across - 2.0 * c.curve * c.d.y;
    c.colour = vec3(g.b.z, g.chroma);
    c.depth = g.b.w;
    return c;
}

/// Opacity of the Gaussian at pixel k of the column before the cap.
float alpha_at(Column c, float k) {
    return exp2(c.peak + k * (c.slope + k * c.curve));
}

/// What is blended: nothing where it is invisible or the pixel is already opaque.
float effective(float raw, float transmittance) {
    const bool seen = raw >= ALPHA_MIN && transmittance > TRANSMITTANCE_MIN;
    return seen ? min(raw, ALPHA_MAX) : 0.0;
}
