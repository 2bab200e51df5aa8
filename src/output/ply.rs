//! The map as a binary little-endian PLY in the layout of the 3DGS reference implementation
//! (Kerbl et al., SIGGRAPH 2023), which SuperSplat, gsplat and Brush open.
//!
//! Scales are logarithms, opacity is a logit, the quaternion is wxyz, colour is the coefficient of
//! the constant spherical harmonic. Normals are written as zeros because readers expect the columns.

use crate::map::Gaussian;
use std::io::{self, Write};

/// Y₀₀, the constant spherical harmonic: colour = 0.5 + Y₀₀ f_dc.
pub const SH0: f32 = 0.282_094_79;

const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

fn row(s: &Gaussian) -> [f32; PROPERTIES.len()] {
    let ([x, y, z], [sx, sy, sz], [qx, qy, qz, qw]) = (s.mean, s.log_scale, s.quat_xyzw);
    let [r, g, b] = s.colour.map(|c| (c - 0.5) / SH0);
    [x, y, z, 0.0, 0.0, 0.0, r, g, b, s.opacity_logit, sx, sy, sz, qw, qx, qy, qz]
}

/// A file being written. Its header states the number of splats, so that is asked for first and kept to.
pub struct PlyWriter<'a, W> {
    out: &'a mut W,
    left: u64,
}

impl<W: Write> PlyWriter<'_, W> {
    pub fn begin(out: &mut W, count: u64) -> io::Result<PlyWriter<'_, W>> {
        writeln!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {count}")?;
        PROPERTIES.iter().try_for_each(|name| writeln!(out, "property float {name}"))?;
        writeln!(out, "end_header")?;
        Ok(PlyWriter { out, left: count })
    }

    pub fn splat(&mut self, splat: &Gaussian) -> io::Result<()> {
        self.left = self.left.checked_sub(1).ok_or_else(other_count)?;
        row(splat).iter().try_for_each(|value| self.out.write_all(&value.to_le_bytes()))
    }

    /// Fails where fewer came than the header states.
    pub fn end(self) -> io::Result<()> {
        if self.left > 0 {
            return Err(other_count());
        }
        Ok(())
    }
}

pub(super) fn other_count() -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, "the number of Gaussians is not the one stated")
}

pub fn write_ply(out: &mut impl Write, splats: impl ExactSizeIterator<Item = Gaussian>) -> io::Result<()> {
    let mut ply = PlyWriter::begin(out, splats.len() as u64)?;
    for splat in splats {
        ply.splat(&splat)?;
    }
    ply.end()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Reads what `write_ply` wrote; any other layout is an error.
    fn read_ply(bytes: &[u8]) -> io::Result<Vec<Gaussian>> {
        let wrong = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what.to_string());
        const END: &[u8] = b"end_header\n";
        let body = bytes.windows(END.len()).position(|w| w == END).ok_or_else(|| wrong("no end_header"))? + END.len();
        let header = std::str::from_utf8(&bytes[..body]).map_err(|_| wrong("the header is not text"))?;
        let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
        if !header.starts_with("ply\nformat binary_little_endian 1.0\n") || names != PROPERTIES {
            return Err(wrong("not a map of this program"));
        }
        let count: Option<usize> = header.lines().find_map(|l| l.strip_prefix("element vertex ")?.parse().ok());
        let row_bytes = 4 * PROPERTIES.len();
        if count.and_then(|n| n.checked_mul(row_bytes)) != Some(bytes.len() - body) {
            return Err(wrong("the size does not agree with the header"));
        }
        let splat = |row: &[u8]| {
            let f = |i: usize| f32::from_le_bytes([row[4 * i], row[4 * i + 1], row[4 * i + 2], row[4 * i + 3]]);
            Gaussian {
                mean: [f(0), f(1), f(2)],
                log_scale: [f(10), f(11), f(12)],
                quat_xyzw: [f(14), f(15), f(16), f(13)],
                opacity_logit: f(9),
                colour: [6, 7, 8].map(|i| 0.5 + SH0 * f(i)),
            }
        };
        Ok(bytes[body..].chunks_exact(row_bytes).map(splat).collect())
    }

    fn splats() -> Vec<Gaussian> {
        let splat = |i: i32| Gaussian {
            mean: [i as f32, -0.5, 2.0],
            log_scale: [-4.0, -3.5, -5.0 + i as f32],
            quat_xyzw: [0.1, 0.2, 0.3, 0.927],
            opacity_logit: 0.5 * i as f32,
            colour: [0.25, 0.5, 0.875],
        };
        (0..3).map(splat).collect()
    }

    #[test]
    fn what_is_written_is_read_back() {
        let mut bytes = Vec::new();
        write_ply(&mut bytes, splats().into_iter()).unwrap();
        let read = read_ply(&bytes).unwrap();
        for (a, b) in read.iter().zip(splats()) {
            let colour = a.colour.iter().zip(b.colour).all(|(x, y)| (x - y).abs() < 1e-6);
            assert!(colour && Gaussian { colour: b.colour, ..*a } == b, "{a:?} {b:?}");
        }
        assert_eq!(read.len(), 3);
    }

    #[test]
    fn columns_follow_the_reference_layout() {
        let mut bytes = Vec::new();
        write_ply(&mut bytes, splats()[1..2].iter().copied()).unwrap();
        let text = String::from_utf8_lossy(&bytes);
        let names: Vec<&str> = text.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
        assert_eq!(
            names.join(" "),
            "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
        );
        assert!(text.starts_with("ply\nformat binary_little_endian 1.0\nelement vertex 1\n"));
        let row = &bytes[bytes.len() - 17 * 4..];
        let column = |i: usize| f32::from_le_bytes(row[4 * i..4 * i + 4].try_into().unwrap());
        assert_eq!(column(13), 0.927, "the scalar part of the quaternion comes first");
        assert_eq!(column(7), 0.0, "mid grey is coefficient zero");
    }

    #[test]
    fn truncated_files_are_refused() {
        let mut bytes = Vec::new();
        write_ply(&mut bytes, splats().into_iter()).unwrap();
        assert!(read_ply(&bytes[..bytes.len() - 1]).is_err());
        assert!(read_ply(&bytes[..20]).is_err());
    }

    #[test]
    fn another_number_than_stated_is_an_error() {
        let [one, two, _] = splats()[..] else { panic!("three") };
        let mut bytes = Vec::new();
        let mut ply = PlyWriter::begin(&mut bytes, 1).unwrap();
        ply.splat(&one).unwrap();
        assert!(ply.splat(&two).is_err());
        assert!(PlyWriter::begin(&mut bytes, 1).unwrap().end().is_err());
    }
}
