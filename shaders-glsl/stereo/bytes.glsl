// Images of 8 bit, four pixels to a word, rows of whole words; the right image follows the left.

uint row_words(uint width) {
    return (width + 3) / 4;
}

/// Word of pixel (x, y) of side 0 or 1.
uint word_of(uvec2 size, uint side, uint x, uint y) {
    return (side * size.y + y) * row_words(size.x) + x / 4;
}

uint byte_of(uint word, uint x) {
    return (word >> (8 * (x & 3u))) & 255u;
}
