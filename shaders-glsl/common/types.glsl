// Structs shared by kernels and host.

// A Gaussian. A slot whose quaternion is all zero is free.
struct Splat {
    vec4 mean_opacity;  // world position, m; opacity logit
    vec4 scale_colour;  // log scale, ln m; grey level, linear 0..1
    vec4 quat;          // world_from_splat, xyzw, not necessarily unit
};

// Adam's moments, laid out as Splat.
struct Moments {
    vec4 m[3];
    vec4 v[3];
};

// A Gaussian on the image. Pixel centres are at half-integers.
struct Projected {
    vec4 centre_conic;  // x, y, px; conic a, b of σ = ½(a dx² + c dy²) + b dx dy
    vec4 conic_shade;   // conic c; opacity; grey level or red; depth, m
};

// What a picture counts; all zero before it.
struct Counts {
    uint visible;     // Gaussians that touch a tile
    uint not_finite;  // Gaussians
    uint needed;      // places for intersections, gaps between those of workgroups included,
    uint listed;      // and those there are
    uint shared_out;  // places that tiles have taken for their lists
    uint long_lists;  // tiles whose lists are sorted apart
};

// Nothing nearer is drawn, m.
const float NEAR = 0.05;

// Colours are trained within 0 and this: the map is in one keyframe's exposure, and what another shows as white may be
// brighter than white there.
const float COLOUR_MAX = 8.0;
