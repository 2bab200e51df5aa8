//! YCbCr to RGB: one luma and two chroma values of 8 bits to red, green and blue of 8 bits, by integers.

/// Bits of a coefficient behind the point. Products with a chroma value then fit the 16-bit multipliers of vector units, and
/// all roundings together move a result by 0.02 of a level at most.
const SHIFT: u32 = 13;

/// The coefficients of one encoding, in units of 2^-13.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matrix {
    luma: i16,
    /// What is added to the luma's product: half a level, less that of black.
    bias: i32,
    red_of_cr: i16,
    green_of_cb: i16,
    green_of_cr: i16,
    blue_of_cb: i16,
}

/// Pixels that are converted together: what has a known size becomes vector instructions.
const BLOCK: usize = 16;

impl Matrix {
    /// That of JPEG files (JFIF): BT.601 over the full range.
    pub const JFIF: Matrix = Matrix::new(0.299, 0.114, true);

    /// The encoding whose luma takes the parts `red` and `blue` of 1 of these colours. Levels are 0 to 255 where it has the
    /// `full` range; else 16 to 235, and chroma 16 to 240.
    pub const fn new(red: f64, blue: f64, full: bool) -> Matrix {
        let (black, luma, chroma) = if full { (0, 1.0, 1.0) } else { (16, 255.0 / 219.0, 255.0 / 224.0) };
        let (of_cr, of_cb, green) = (2.0 * (1.0 - red) * chroma, 2.0 * (1.0 - blue) * chroma, 1.0 - red - blue);
        let luma = fixed(luma);
        Matrix {
            luma,
            bias: (1 << (SHIFT - 1)) - black * luma as i32,
            red_of_cr: fixed(of_cr),
            green_of_cb: fixed(of_cb * blue / green),
            green_of_cr: fixed(of_cr * red / green),
            blue_of_cb: fixed(of_cb),
        }
    }

    /// Red, green and blue of a pixel, rounded, and clamped where the encoding has more than RGB.
    #[inline]
    pub fn rgb(&self, y: u8, cb: u8, cr: u8) -> [u8; 3] {
        let level = times(self.luma, y.into()) + self.bias;
        let (cb, cr) = (i16::from(cb) - 128, i16::from(cr) - 128);
        let put = |v: i32| (v >> SHIFT).clamp(0, 255) as u8;
        [
            put(level + times(self.red_of_cr, cr)),
            put(level - times(self.green_of_cb, cb) - times(self.green_of_cr, cr)),
            put(level + times(self.blue_of_cb, cb)),
        ]
    }

    /// Red, green and blue of a row of pixels; all slices have its length.
    pub fn row(&self, y: &[u8], cb: &[u8], cr: &[u8], [red, green, blue]: [&mut [u8]; 3]) {
        let whole = y.len() / BLOCK * BLOCK;
        for at in (0..whole).step_by(BLOCK) {
            let of = |plane: &[u8]| -> [u8; BLOCK] { plane[at..at + BLOCK].try_into().expect("a whole block") };
            let [r, g, b] = self.block(of(y), of(cb), of(cr));
            red[at..at + BLOCK].copy_from_slice(&r);
            green[at..at + BLOCK].copy_from_slice(&g);
            blue[at..at + BLOCK].copy_from_slice(&b);
        }
        for i in whole..y.len() {
            [red[i], green[i], blue[i]] = self.rgb(y[i], cb[i], cr[i]);
        }
    }

    fn block(&self, y: [u8; BLOCK], cb: [u8; BLOCK], cr: [u8; BLOCK]) -> [[u8; BLOCK]; 3] {
        use std::array::from_fn;
        let level: [i32; BLOCK] = from_fn(|i| times(self.luma, y[i].into()) + self.bias);
        let (cb, cr) = (cb.map(|c| i16::from(c) - 128), cr.map(|c| i16::from(c) - 128));
        [
            from_fn(|i| level_of(level[i] + times(self.red_of_cr, cr[i]))),
            from_fn(|i| level_of(level[i] - times(self.green_of_cb, cb[i]) - times(self.green_of_cr, cr[i]))),
            from_fn(|i| level_of(level[i] + times(self.blue_of_cb, cb[i]))),
        ]
    }
}

/// The level of a sum in units of 2^-13.
#[inline]
fn level_of(sum: i32) -> u8 {
    (sum >> SHIFT).clamp(0, 255) as u8
}

/// The product of 16-bit numbers, which vector units have.
#[inline]
fn times(a: i16, b: i16) -> i32 {
    i32::from(a) * i32::from(b)
}

/// A positive number, rounded to units of 2^-13.
const fn fixed(x: f64) -> i16 {
    (x * (1 << SHIFT) as f64 + 0.5) as i16
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition of ITU-R BT.601 and BT.709, of every value: a level is at most half a level and the coefficients'
    /// rounding off.
    #[test]
    fn every_value_is_the_definitions_rounded() {
        for (red, blue, full) in [(0.299, 0.114, true), (0.299, 0.114, false), (0.2126, 0.0722, false)] {
            let matrix = Matrix::new(red, blue, full);
            let (black, of_luma, of_chroma) = if full { (0.0, 255.0, 255.0) } else { (16.0, 219.0, 224.0) };
            let mut worst: f64 = 0.0;
            for cb in (0..=255).step_by(3) {
                for cr in (0..=255).step_by(3) {
                    for y in (0..=255).step_by(5) {
                        let level = (f64::from(y) - black) / of_luma;
                        let (b, r) = ((f64::from(cb) - 128.0) / of_chroma, (f64::from(cr) - 128.0) / of_chroma);
                        let (r, b) = (level + 2.0 * (1.0 - red) * r, level + 2.0 * (1.0 - blue) * b);
                        let g = (level - red * r - blue * b) / (1.0 - red - blue);
                        for (got, exact) in matrix.rgb(y, cb, cr).iter().zip([r, g, b]) {
                            worst = worst.max((f64::from(*got) - (255.0 * exact).clamp(0.0, 255.0)).abs());
                        }
                    }
                }
            }
            assert!(worst < 0.53, "{worst}");
        }
    }
}
