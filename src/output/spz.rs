//! The map as `.spz`, version 3: Niantic's packed form of Gaussians, 20 bytes each before compression (a PLY: 68).
//!
//! A gzip stream of a header of 16 bytes and one array after another: positions (3 x 24 bits, fixed point), opacities (8 bits),
//! colours (3 x 8), logarithms of scales (3 x 8), rotations (the three smallest components in 32 bits). Spherical harmonics
//! beyond the constant one are none. As a map is not held in memory, its Gaussians are asked for once for each array.
//!
//! The format's axes are right, up, back; the map's z is up. So the file's x, y, z are the world's x, z, -y, and a viewer shows
//! the map upright.

use super::ply::SH0;
use crate::map::Gaussian;
use flate2::write::GzEncoder;
use flate2::Compression;
use glam::Quat;
use std::f32::consts::FRAC_1_SQRT_2;
use std::io::{self, BufWriter, Write};

/// Readers of the reference implementation refuse more.
pub const COUNT_MAX: u64 = 10_000_000;

/// "NGSP"
const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
/// Bits after the point of a position of 24 bits: a quarter of a millimetre, as far as 2 km. A wider map has fewer, down to
/// 1/16 m; what is beyond is put to the border.
const FRACTION_BITS: u8 = 12;
const FRACTION_BITS_MIN: u8 = 4;
const POSITION_MAX: f64 = ((1 << 23) - 1) as f64;
/// Steps of ln m, and the least of them.
const SCALE_STEPS: f32 = 16.0;
const SCALE_LEAST: f32 = -10.0;
/// Colours are coefficients of the constant harmonic times this, about the middle.
const COLOUR_SCALE: f32 = 0.15;
/// Largest magnitude of a component of a rotation that is not its largest: 1/√2, in 9 bits.
const ROTATION_MAX: f32 = 511.0;
/// The world's z up as the format's y up: a quarter turn about x.
const UPRIGHT: Quat = Quat::from_xyzw(-FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2);
/// Bytes of an element of the longest array.
const ELEMENT_MAX: usize = 9;
/// Bytes that are compressed at once.
const CHUNK: usize = 1 << 16;

/// Writes `count` Gaussians, none of whose coordinates is beyond `extent_m`. `all` gives every one to what it is given, in the
/// same order each time it is called.
pub fn write_spz(
    out: &mut impl Write,
    count: u32,
    extent_m: f32,
    mut all: impl FnMut(&mut dyn FnMut(&Gaussian) -> io::Result<()>) -> io::Result<()>,
) -> io::Result<()> {
    let mut gzip = BufWriter::with_capacity(CHUNK, GzEncoder::new(out, Compression::default()));
    let bits = fraction_bits(extent_m);
    for word in [MAGIC, VERSION, count] {
        gzip.write_all(&word.to_le_bytes())?;
    }
    // Degree of the harmonics, bits, flags, reserved.
    gzip.write_all(&[0, bits, 0, 0])?;
    let arrays: [Pack; 5] = [&|g, to| position(g, bits, to), &opacity, &colour, &scale, &rotation];
    for array in arrays {
        let mut left = count;
        all(&mut |g| {
            left = left.checked_sub(1).ok_or_else(super::ply::other_count)?;
            let mut element = Element::default();
            array(g, &mut element);
            gzip.write_all(&element)
        })?;
        if left > 0 {
            return Err(super::ply::other_count());
        }
    }
    gzip.into_inner().map_err(io::IntoInnerError::into_error)?.finish()?;
    Ok(())
}

/// Packs what an array has of a Gaussian.
type Pack<'a> = &'a dyn Fn(&Gaussian, &mut Element);
type Element = crate::mem::List<u8, ELEMENT_MAX>;

fn push(to: &mut Element, bytes: impl IntoIterator<Item = u8>) {
    for byte in bytes {
        // There is room for the longest.
        let _ = to.push(byte);
    }
}

/// The most bits with which positions as far as that fit.
fn fraction_bits(extent_m: f32) -> u8 {
    let fits = |bits: &u8| f64::from(extent_m) * f64::from(1u32 << bits) <= POSITION_MAX;
    (FRACTION_BITS_MIN..=FRACTION_BITS).rev().find(fits).unwrap_or(FRACTION_BITS_MIN)
}

fn byte(v: f32) -> u8 {
    v.round().clamp(0.0, 255.0) as u8
}

fn position(g: &Gaussian, bits: u8, to: &mut Element) {
    let [x, y, z] = g.mean;
    for v in [x, z, -y] {
        let fixed = (f64::from(v) * f64::from(1u32 << bits)).round().clamp(-POSITION_MAX - 1.0, POSITION_MAX) as i32;
        push(to, fixed.to_le_bytes().into_iter().take(3));
    }
}

/// Never 0 nor 1: readers take the logit of it.
fn opacity(g: &Gaussian, to: &mut Element) {
    push(to, [byte(255.0 * g.opacity()).clamp(1, 254)]);
}

fn colour(g: &Gaussian, to: &mut Element) {
    push(to, g.colour.map(|c| byte(255.0 * (COLOUR_SCALE * (c - 0.5) / SH0 + 0.5))));
}

fn scale(g: &Gaussian, to: &mut Element) {
    push(to, g.log_scale.map(|s| byte(SCALE_STEPS * (s - SCALE_LEAST))));
}

/// The index of the largest component, which is made positive and left out, then sign and magnitude of the others.
fn rotation(g: &Gaussian, to: &mut Element) {
    let q = (UPRIGHT * Quat::from_array(g.quat_xyzw)).normalize().to_array();
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let mut word = largest as u32;
    for i in (0..4).filter(|i| *i != largest) {
        let magnitude = (ROTATION_MAX * q[i].abs() / FRAC_1_SQRT_2).round().min(ROTATION_MAX) as u32;
        let negative = (q[i] < 0.0) != (q[largest] < 0.0);
        word = word << 10 | u32::from(negative) << 9 | magnitude;
    }
    push(to, word.to_le_bytes());
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_wider_map_has_coarser_positions_and_its_ends_fit() {
        assert_eq!([0.0, 2047.0, 2049.0, 30_000.0, 1e9].map(fraction_bits), [12, 12, 11, 8, 4]);
        for (extent, bits) in [(2047.9, 12), (1e30, 4)] {
            let mut to = Element::default();
            position(&Gaussian { mean: [extent, 0.0, -extent], ..Gaussian::default() }, bits, &mut to);
            let fixed = |at: usize| i32::from_le_bytes([0, to[at], to[at + 1], to[at + 2]]) >> 8;
            assert!(fixed(0) > 0x7f_0000 && fixed(3) < -0x7f_0000 && fixed(6) == 0, "{to:?}");
        }
    }

    #[test]
    fn what_is_up_in_the_world_is_up_in_the_file() {
        let up = UPRIGHT * Vec3::Z;
        assert!((up - Vec3::Y).length() < 1e-6 && (UPRIGHT * Vec3::Y + Vec3::Z).length() < 1e-6);
    }

    #[test]
    fn another_number_than_stated_is_an_error() {
        let all = |n: usize| {
            move |sink: &mut dyn FnMut(&Gaussian) -> io::Result<()>| {
                let one = Gaussian { quat_xyzw: [0.0, 0.0, 0.0, 1.0], ..Gaussian::default() };
                (0..n).try_for_each(|_| sink(&one))
            }
        };
        assert!(write_spz(&mut Vec::new(), 2, 1.0, all(2)).is_ok());
        assert!(write_spz(&mut Vec::new(), 2, 1.0, all(1)).is_err());
        assert!(write_spz(&mut Vec::new(), 2, 1.0, all(3)).is_err());
    }
}
