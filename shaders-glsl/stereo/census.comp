// Census transform of both images (Zabih and Woodfill 1994), ternary: which of 16 pixels around, three steps along rows and
// columns and the corners two away, are darker than the middle one, and which are brighter by more than a grey level. What
// is neither is as bright: in a faint wall a step of one level is noise, and a bit that is noise costs as much as one that is
// detail. Whatever keeps the order of grey levels, exposure above all, changes next to nothing. Of cones, teddy and
// simulated flights 9.4, 11.1 and 2.6 % are bad by 1 px after the filter; by a bit each of 32 pixels, a disc 7 wide, 9.8,
// 11.4 and 2.9. Both ways by more than a level: 9.3, 12.0 and 2.3.
// in   images
// out  strings: 32 bits a pixel, left image then right; two bits a place, darker then brighter, in reading order from the
//      lowest. Pixels outside are the nearest inside
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 16, local_size_y = 16) in;

#include "bytes.glsl"

const int REACH = 3;
const uint TILE = 16 + 2 * REACH;
const uint EQUAL = 1;  // brighter by this is not brighter

layout(push_constant) uniform Push {
    uvec2 size;
} push;

layout(set = 0, binding = 0, std430) readonly buffer Images { uint images[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Strings { uint strings[]; };

shared uint level[TILE][TILE];

void main() {
    const uint side = gl_WorkGroupID.z;
    const ivec2 corner = ivec2(gl_WorkGroupID.xy) * 16 - REACH;
    for (uint i = gl_LocalInvocationIndex; i < TILE * TILE; i += 256) {
        const ivec2 at = corner + ivec2(i % TILE, i / TILE);
        const uvec2 p = uvec2(clamp(at, ivec2(0), ivec2(push.size) - 1));
        level[i / TILE][i % TILE] = byte_of(images[word_of(push.size, side, p.x, p.y)], p.x);
    }
    barrier();
    const uvec2 here = gl_GlobalInvocationID.xy;
    if (here.x >= push.size.x || here.y >= push.size.y) {
        return;
    }
    const ivec2 me = ivec2(gl_LocalInvocationID.xy) + REACH;
    const uint middle = level[me.y][me.x];
    uint bits = 0, n = 0;
    for (int y = -REACH; y <= REACH; ++y) {
        for (int x = -REACH; x <= REACH; ++x) {
            const bool ray = (x == 0) != (y == 0), corner = abs(x) == 2 && abs(y) == 2;
            if (ray || corner) {
                const uint other = level[me.y + y][me.x + x];
                bits |= (other < middle ? 1u : 0u) << n;
                bits |= (other > middle + EQUAL ? 2u : 0u) << n;
                n += 2;
            }
        }
    }
    strings[(side * push.size.y + here.y) * push.size.x + here.x] = bits;
}
