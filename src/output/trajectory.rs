//! Trajectories in the TUM format: `t tx ty tz qx qy qz qw`, seconds and metres, one pose a line.
//! Seconds are printed from the integer nanoseconds: a double holds a Unix stamp only to 0.2 µs.

use std::io::{self, Write};
use stipple_drivers::{Nanos, TimedPose};

/// The epoch of an instant, of first frame and number of each; the first of all for what was before.
pub fn epoch_at(epochs: &[(Nanos, u32)], t: Nanos) -> u32 {
    let begun = epochs.partition_point(|(start, _)| *start <= t);
    epochs.get(begun.saturating_sub(1)).map_or(0, |(_, epoch)| *epoch)
}

/// A file being written. A comment stands where another epoch begins.
pub struct TumWriter<'a, W> {
    out: &'a mut W,
    epoch: u32,
}

impl<W: Write> TumWriter<'_, W> {
    pub fn begin(out: &mut W) -> io::Result<TumWriter<'_, W>> {
        writeln!(out, "# t_s tx_m ty_m tz_m qx qy qz qw (world from body)")?;
        Ok(TumWriter { out, epoch: 0 })
    }

    pub fn pose(&mut self, epoch: u32, pose: &TimedPose) -> io::Result<()> {
        if epoch != self.epoch {
            writeln!(self.out, "# epoch {epoch}: in a frame that dead reckoning guessed, unless a place from before was recognised since")?;
            self.epoch = epoch;
        }
        write_line(self.out, pose)
    }
}

fn write_line(out: &mut impl Write, TimedPose { t, pose }: &TimedPose) -> io::Result<()> {
    let sign = if t.0 < 0 { "-" } else { "" };
    let (s, ns) = (t.0.unsigned_abs() / 1_000_000_000, t.0.unsigned_abs() % 1_000_000_000);
    let ([x, y, z], [qx, qy, qz, qw]) = (pose.p.to_array(), pose.q.to_array());
    writeln!(out, "{sign}{s}.{ns:09} {x:.6} {y:.6} {z:.6} {qx:.8} {qy:.8} {qz:.8} {qw:.8}")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use glam::{DQuat, DVec3};
    use stipple_drivers::Pose;

    #[test]
    fn another_epoch_is_a_comment() {
        let mut text = Vec::new();
        let mut file = TumWriter::begin(&mut text).unwrap();
        for epoch in [0, 0, 2, 2] {
            file.pose(epoch, &TimedPose { t: Nanos(5), pose: Pose::IDENTITY }).unwrap();
        }
        let text = String::from_utf8(text).unwrap();
        let comments: Vec<_> = text.lines().enumerate().filter(|(_, line)| line.starts_with('#')).collect();
        assert!(comments.len() == 2 && comments[1].0 == 3 && comments[1].1.starts_with("# epoch 2:"), "{text}");
    }

    #[test]
    fn stamps_keep_their_nanoseconds_and_quaternions_end_with_w() {
        let pose = Pose { q: DQuat::from_xyzw(0.0, 0.6, 0.0, 0.8), p: DVec3::new(1.0, -2.5, 0.25) };
        let poses = [
            TimedPose { t: Nanos(1_403_636_579_763_555_584), pose },
            TimedPose { t: Nanos(5), pose },
            TimedPose { t: Nanos(-1_500_000_000), pose },
        ];
        let mut text = Vec::new();
        let mut file = TumWriter::begin(&mut text).unwrap();
        poses.iter().for_each(|pose| file.pose(0, pose).unwrap());
        let text = String::from_utf8(text).unwrap();
        let lines: Vec<&str> = text.lines().skip(1).collect();
        let rest = "1.000000 -2.500000 0.250000 0.00000000 0.60000000 0.00000000 0.80000000";
        assert_eq!(lines[0], format!("1403636579.763555584 {rest}"));
        assert_eq!(lines[1], format!("0.000000005 {rest}"));
        assert_eq!(lines[2], format!("-1.500000000 {rest}"));
    }
}
