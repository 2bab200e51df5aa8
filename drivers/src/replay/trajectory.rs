//! Tables of poses: EuRoC ground truth and TUM-VI mocap (comma separated; ns, p, q wxyz, further columns ignored), and TUM
//! text (blank separated; seconds, p, q xyzw).

use super::findings::Findings;
use super::{order, table};
use crate::types::{Nanos, Pose, TimedPose};
use crate::Fault;
use glam::{DQuat, DVec3};
use std::path::Path;

const COLUMNS: &str = "stamp, x y z, unit quaternion (wxyz and ns between commas; xyzw and s between blanks)";

/// Reads a table of `world_from_body` poses. Nothing may be wrong in it, as a caller has no way to learn of it later: the
/// first finding is a fault.
pub fn read_trajectory(path: &Path) -> Result<Vec<TimedPose>, Fault> {
    let mut findings = Findings::default();
    let poses = read(path, &mut findings)?;
    findings.refuse_any().map(|()| poses)
}

/// Reads a table of poses; rows that are wrong are dropped, and none left is a fault.
pub fn read(path: &Path, findings: &mut Findings) -> Result<Vec<TimedPose>, Fault> {
    let is_tum = |text: &[u8]| !text.split(|b| *b == b'\n').any(|l| !l.starts_with(b"#") && l.contains(&b','));
    let tum = is_tum(&table::read_bytes(path, table::TABLE_BYTES_MAX)?);
    let rows = table::read(path, COLUMNS, |fields| if tum { tum_row(fields) } else { euroc_row(fields) }, findings)?;
    let rows = order::increasing(rows, |r| r.t, path, findings);
    Ok(rows.into_iter().map(|r| r.value).collect())
}

fn euroc_row(fields: &[&str]) -> Option<TimedPose> {
    let (t, v) = (fields.first()?.parse().ok()?, table::numbers(fields.get(1..8)?)?);
    pose(Nanos(t), DVec3::new(v[0], v[1], v[2]), DQuat::from_xyzw(v[4], v[5], v[6], v[3]))
}

fn tum_row(fields: &[&str]) -> Option<TimedPose> {
    let [t, values @ ..] = fields else { return None };
    let v: [f64; 7] = table::numbers(values)?.try_into().ok()?;
    pose(stamp_from_secs(t)?, DVec3::new(v[0], v[1], v[2]), DQuat::from_xyzw(v[3], v[4], v[5], v[6]))
}

fn pose(t: Nanos, p: DVec3, q: DQuat) -> Option<TimedPose> {
    /// Ground truth is printed with as few as three decimals.
    const NORM_TOLERANCE: f64 = 1e-2;
    let ok = p.is_finite() && (q.length() - 1.0).abs() < NORM_TOLERANCE;
    ok.then(|| TimedPose { t, pose: Pose::new(q, p) })
}

/// A stamp from seconds, digit by digit: a double resolves only 0.2 µs of seconds since 1970.
fn stamp_from_secs(text: &str) -> Option<Nanos> {
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    if whole.is_empty() || !digits(whole) || !digits(fraction) {
        let secs: f64 = text.parse().ok()?;
        return (secs.abs() < 9e9).then(|| Nanos((secs * 1e9).round() as i64));
    }
    let fraction: i64 = format!("{fraction:0<9}").get(..9)?.parse().ok()?;
    Some(Nanos(whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?.checked_add(fraction)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_keep_their_nanoseconds() {
        assert_eq!(stamp_from_secs("1403636584.763555584"), Some(Nanos(1403636584763555584)));
        assert_eq!(stamp_from_secs("12.5"), Some(Nanos(12_500_000_000)));
        assert_eq!(stamp_from_secs("1.5e1"), Some(Nanos(15_000_000_000)));
        assert_eq!(stamp_from_secs("-0.25"), Some(Nanos(-250_000_000)));
        assert_eq!(stamp_from_secs("99999999999999"), None);
        assert_eq!(stamp_from_secs("x"), None);
        assert_eq!(stamp_from_secs("nan"), None);
    }
}
