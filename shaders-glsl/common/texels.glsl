// How a kernel reads a buffer: as it is, or in the variant of a CPU as texels. Mesa's CPU driver loads from a storage buffer lane by lane
// and component by component, each through the stack; texels it gathers at once.
// READ_X(binding, name of the block, name of the function that reads an element)

#ifdef CPU

#define READ_FLOATS(at, Block, read)                                                                                            \
    layout(set = 0, binding = at) uniform samplerBuffer Block;                                                                  \
    float read(uint i) { return texelFetch(Block, int(i)).x; }
#define READ_UINTS(at, Block, read)                                                                                             \
    layout(set = 0, binding = at) uniform usamplerBuffer Block;                                                                 \
    uint read(uint i) { return texelFetch(Block, int(i)).x; }
#define READ_VEC2S(at, Block, read)                                                                                             \
    layout(set = 0, binding = at) uniform samplerBuffer Block;                                                                  \
    vec2 read(uint i) { return texelFetch(Block, int(i)).xy; }
#define READ_UVEC2S(at, Block, read)                                                                                            \
    layout(set = 0, binding = at) uniform usamplerBuffer Block;                                                                 \
    uvec2 read(uint i) { return texelFetch(Block, int(i)).xy; }
#define READ_VEC4S(at, Block, read)                                                                                             \
    layout(set = 0, binding = at) uniform samplerBuffer Block;                                                                  \
    vec4 read(uint i) { return texelFetch(Block, int(i)); }
#define READ_PROJECTED(at, Block, read)                                                                                         \
    layout(set = 0, binding = at) uniform samplerBuffer Block;                                                                  \
    Projected read(uint i) { return Projected(texelFetch(Block, int(2 * i)), texelFetch(Block, int(2 * i + 1))); }
#define READ_SPLATS(at, Block, read)                                                                                            \
    layout(set = 0, binding = at) uniform samplerBuffer Block;                                                                  \
    Splat read(uint i) {                                                                                                        \
        return Splat(texelFetch(Block, int(3 * i)), texelFetch(Block, int(3 * i + 1)), texelFetch(Block, int(3 * i + 2)));      \
    }

#else

#define READ_ELEMENTS(at, Block, read, Element)                                                                                 \
    layout(set = 0, binding = at, std430) readonly buffer Block { Element Block##_elements[]; };                                \
    Element read(uint i) { return Block##_elements[i]; }
#define READ_FLOATS(at, Block, read) READ_ELEMENTS(at, Block, read, float)
#define READ_UINTS(at, Block, read) READ_ELEMENTS(at, Block, read, uint)
#define READ_VEC2S(at, Block, read) READ_ELEMENTS(at, Block, read, vec2)
#define READ_UVEC2S(at, Block, read) READ_ELEMENTS(at, Block, read, uvec2)
#define READ_VEC4S(at, Block, read) READ_ELEMENTS(at, Block, read, vec4)
#define READ_PROJECTED(at, Block, read) READ_ELEMENTS(at, Block, read, Projected)
#define READ_SPLATS(at, Block, read) READ_ELEMENTS(at, Block, read, Splat)

#endif
