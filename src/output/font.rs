//! A 5x8 bitmap font for labels in pictures: lower case, digits and what units need. Capitals
//! other than B (of dB) are drawn as lower case; unknown characters are blank.

/// Pixels from one character to the next, and the height of a line.
pub const ADVANCE: usize = 6;
pub const HEIGHT: usize = 8;

/// The glyphs as they look: a line with the character, then `HEIGHT` rows of five pixels, `#` where it is drawn.
const GLYPHS: &str = include_str!("font.txt");

/// Rows of a character from the top; the last one is for descenders.
fn glyph(c: char) -> impl Iterator<Item = &'static str> {
    let c = if c == 'B' { c } else { c.to_ascii_lowercase() };
    let named = move |line: &str| line.len() == 1 && line.starts_with(c);
    GLYPHS.lines().skip_while(move |line| !named(line)).skip(1).take(HEIGHT)
}

/// Calls `dot(x, y)` for every pixel of the text at the given magnification.
pub fn draw(text: &str, magnify: usize, mut dot: impl FnMut(usize, usize)) {
    for (index, c) in text.chars().enumerate() {
        for (row, pixels) in glyph(c).enumerate() {
            for (column, _) in pixels.match_indices('#') {
                let (x0, y0) = ((index * ADVANCE + column) * magnify, row * magnify);
                for y in y0..y0 + magnify {
                    (x0..x0 + magnify).for_each(|x| dot(x, y));
                }
            }
        }
    }
}
