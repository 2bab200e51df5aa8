//! Pictures of a sensor whose pixels each lie behind a filter of one colour, in a pattern of two by two (Bayer): the other two
//! colours of a pixel are the means of its nearest neighbours that have them. Neighbours beyond the edge are mirrored at the
//! pixel on the edge, which keeps the pattern; those of another camera's half are beyond it.

use super::pixels::Part;
use crate::types::{luma, Colour, Image};

/// The column and the row, 0 or 1, of the red pixel in the pattern.
pub(super) type Red = (usize, usize);

/// Pixels that are made together: what has a known size becomes vector instructions.
const BLOCK: usize = 16;

/// A row of pixels with those above and below it, all of one length.
#[derive(Clone, Copy)]
struct Rows<'a> {
    above: &'a [u8],
    row: &'a [u8],
    below: &'a [u8],
}

impl Rows<'_> {
    /// The colours of pixel `i`, whose neighbours are `left` and `right`: that of the row's own filter beside green, green, and
    /// that of the rows above and below. `own`: the pixel has the first.
    #[inline]
    fn colours(&self, own: bool, [left, i, right]: [usize; 3]) -> [u8; 3] {
        let sum = |row: &[u8]| u16::from(row[left]) + u16::from(row[right]);
        let (beside, upright) = (sum(self.row), u16::from(self.above[i]) + u16::from(self.below[i]));
        let corners = sum(self.above) + sum(self.below);
        if own {
            [self.row[i], ((beside + upright + 2) >> 2) as u8, ((corners + 2) >> 2) as u8]
        } else {
            [((beside + 1) >> 1) as u8, self.row[i], ((upright + 1) >> 1) as u8]
        }
    }

    /// Writes the colours of every pixel. `OWN`: the first one has the row's own colour.
    fn write<const OWN: bool>(&self, [first, green, other]: [&mut [u8]; 3]) {
        let n = self.row.len();
        let mut put = |i: usize, [left, right]: [usize; 2]| {
            [first[i], green[i], other[i]] = self.colours(OWN == (i % 2 == 0), [left, i, right]);
        };
        (0..n.min(1)).for_each(|i| put(i, [1.min(n - 1); 2]));
        let whole = n.saturating_sub(2) / BLOCK * BLOCK;
        (whole + 1..n).for_each(|i| put(i, [i - 1, if i + 1 == n { i - 1 } else { i + 1 }]));
        for at in (0..whole).step_by(BLOCK) {
            // From the pixel before the block to the one after it.
            let of = |row: &[u8]| -> [u8; BLOCK + 2] { row[at..at + BLOCK + 2].try_into().expect("a whole block") };
            let [f, g, o] = block::<OWN>(&of(self.above), &of(self.row), &of(self.below));
            first[at + 1..][..BLOCK].copy_from_slice(&f);
            green[at + 1..][..BLOCK].copy_from_slice(&g);
            other[at + 1..][..BLOCK].copy_from_slice(&o);
        }
    }
}

/// The colours of the pixels between the first, which is at an even column, and the last.
fn block<const OWN: bool>(above: &[u8; BLOCK + 2], row: &[u8; BLOCK + 2], below: &[u8; BLOCK + 2]) -> [[u8; BLOCK]; 3] {
    use std::array::from_fn;
    let sum = |row: &[u8; BLOCK + 2]| -> [u16; BLOCK] { from_fn(|i| u16::from(row[i]) + u16::from(row[i + 2])) };
    let upright: [u16; BLOCK] = from_fn(|i| u16::from(above[i + 1]) + u16::from(below[i + 1]));
    let (beside, high, low) = (sum(row), sum(above), sum(below));
    // All ones where the pixel has the row's own colour.
    let own: [u8; BLOCK] = from_fn(|i| if OWN == (i % 2 == 1) { 255 } else { 0 });
    let choose = |a: [u8; BLOCK], b: [u8; BLOCK]| from_fn(|i| a[i] & own[i] | b[i] & !own[i]);
    let row: [u8; BLOCK] = from_fn(|i| row[i + 1]);
    [
        choose(row, beside.map(|sum| ((sum + 1) >> 1) as u8)),
        choose(from_fn(|i| ((beside[i] + upright[i] + 2) >> 2) as u8), row),
        choose(from_fn(|i| ((high[i] + low[i] + 2) >> 2) as u8), upright.map(|sum| ((sum + 1) >> 1) as u8)),
    ]
}

/// Writes the grey of a part of a picture, and its colours where they are asked for, from as many bytes as `least_bytes` says.
/// `scratch` is used for a row of colours.
pub(super) fn read(
    red: Red,
    bytes: &[u8],
    part: Part,
    scratch: &mut Vec<u8>,
    out: &mut Image,
    mut colour: Option<&mut Colour>,
) {
    let (width, height) = (out.width, out.height);
    let at = |y: usize| &bytes[y * part.stride + part.x..][..width];
    // The pattern begins in the picture's first column, not the part's.
    let red = ((red.0 + part.x) % 2, red.1);
    scratch.resize(3 * width, 0);
    for (y, grey) in out.pixels.chunks_exact_mut(width.max(1)).enumerate() {
        let above = y.checked_sub(1).unwrap_or(1.min(height - 1));
        let below = if y + 1 == height { y.saturating_sub(1) } else { y + 1 };
        let rows = Rows { above: at(above), row: at(y), below: at(below) };
        let [r, g, b] = match &mut colour {
            Some(planes) => planes.each_mut().map(|plane| &mut plane.pixels[y * width..][..width]),
            None => thirds(scratch, width),
        };
        match ((y + red.1) % 2, red.0) {
            (0, 0) => rows.write::<true>([&mut *r, &mut *g, &mut *b]),
            (0, _) => rows.write::<false>([&mut *r, &mut *g, &mut *b]),
            (_, 0) => rows.write::<false>([&mut *b, &mut *g, &mut *r]),
            _ => rows.write::<true>([&mut *b, &mut *g, &mut *r]),
        }
        let colours = r.iter().zip(g.iter()).zip(b.iter());
        grey.iter_mut().zip(colours).for_each(|(to, ((r, g), b))| *to = luma(*r, *g, *b));
    }
}

/// Three rows of `width`.
fn thirds(rows: &mut [u8], width: usize) -> [&mut [u8]; 3] {
    let (first, rest) = rows.split_at_mut(width);
    let (second, third) = rest.split_at_mut(width);
    [first, second, third]
}
