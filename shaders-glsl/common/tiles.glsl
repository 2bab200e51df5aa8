// Which tiles hold pixel centres inside {½(a dx² + c dy²) + b dx dy <= τ}. Row by row, the extreme x
// of the ellipse within the row's strip is found in closed form: every tile listed is touched, none
// is missed (SnugBox/AccuTile of Speedy-Splat, 2024).
//
// A tile is as wide as a subgroup (at most 16 px) and every lane shades a column of COLUMN pixels.

layout(constant_id = 0) const uint LANES = 32;
layout(constant_id = 6) const uint COLUMN = 8;
const uint TILE_W = LANES < 16 ? LANES : 16;
const uint TILE_H = LANES * COLUMN / TILE_W;

const float ALPHA_MIN = 1.0 / 255.0;

struct Ellipse {
    vec2 centre;
    vec3 conic;
    float t;         // 2τ
    float per_a;     // 1/a
    float extent;    // half the height, px
    float y_right;   // of the rightmost point, from the centre; the leftmost lies opposite
    ivec2 rows;      // first and last tile row; last < first when nothing is touched
};

uvec2 tile_grid(uvec2 size) {
    return (size + uvec2(TILE_W, TILE_H) - 1) / uvec2(TILE_W, TILE_H);
}

/// Up to where the Gaussian is listed; coarser, up to where it is brighter: the level falls by `coarseness`, and past zero
/// nothing is left of it.
float level_of(float opacity, float coarseness) {
    return 2.0 * log(opacity / ALPHA_MIN) - coarseness;
}

Ellipse ellipse_of(Projected g, uvec2 size, float coarseness) {
    Ellipse e;
    e.centre = g.centre_conic.xy;
    e.conic = vec3(g.centre_conic.zw, g.conic_shade.x);
    // A hair wide: the raster decides about each pixel, this only must not lose one.
    e.t = level_of(g.conic_shade.y, coarseness) * 1.001 + 0.001;
    const float per_det = e.t / max(e.conic.x * e.conic.z - e.conic.y * e.conic.y, 1e-12);
    e.per_a = 1.0 / e.conic.x;
    e.extent = sqrt(e.conic.x * per_det);
    e.y_right = -(e.conic.y / e.conic.z) * sqrt(e.conic.z * per_det);
    const float top = clamp(e.centre.y - e.extent, -1.0, float(size.y + TILE_H));
    const float bottom = clamp(e.centre.y + e.extent, -1.0, float(size.y + TILE_H));
    // pixel centres of row r of tiles: r·H + ½ .. (r+1)·H - ½
    e.rows.x = max(0, int(ceil((top - float(TILE_H) + 0.5) / float(TILE_H))));
    e.rows.y = min(int(tile_grid(size).y) - 1, int(floor((bottom - 0.5) / float(TILE_H))));
    return e;
}

/// First and last tile column touched in tile row `row`.
ivec2 columns_of(Ellipse e, int row, uvec2 size) {
    const float a = e.conic.x, b = e.conic.y, c = e.conic.z;
    const float y0 = max(float(row) * float(TILE_H) + 0.5 - e.centre.y, -e.extent);
    const float y1 = min(float(row + 1) * float(TILE_H) - 0.5 - e.centre.y, e.extent);
    if (y0 > y1) {
        return ivec2(0, -1);
    }
    const float v1 = clamp(e.y_right, y0, y1), v0 = clamp(-e.y_right, y0, y1);
    const float d1 = sqrt(max(0.0, b * b * v1 * v1 - a * (c * v1 * v1 - e.t)));
    const float d0 = sqrt(max(0.0, b * b * v0 * v0 - a * (c * v0 * v0 - e.t)));
    const float right = clamp(e.centre.x + (d1 - b * v1) * e.per_a, -1.0, float(size.x + TILE_W));
    const float left = clamp(e.centre.x - (d0 + b * v0) * e.per_a, -1.0, float(size.x + TILE_W));
    return ivec2(max(0, int(ceil((left - float(TILE_W) + 0.5) / float(TILE_W)))),
                 min(int(tile_grid(size).x) - 1, int(floor((right - 0.5) / float(TILE_W)))));
}
