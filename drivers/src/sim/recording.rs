//! Ground truth and inertial samples of a recorded flight, from csv in EuRoC's format.
//!
//! Truth rows: stamp ns, p (3), q wxyz (4), then optionally v (3), gyro bias (3), accelerometer bias (3). Inertial rows:
//! stamp ns, gyro (3), specific force (3). Nothing may be wrong in them.
//!
//! Estimated truth jumps now and then (12 cm in 5 ms in MH_04), which no inertial unit would have felt. Where positions
//! leave what the stated velocities allow, what follows is shifted to fit: the simulated room is built around the path, so
//! nothing depends on its absolute place.

use super::imu::Bias;
use super::scenario::Recording;
use crate::replay::{numbers, read_strictly, Row};
use crate::types::{ImuSample, Nanos, Pose, TimedPose};
use crate::{Fault, FaultKind};
use glam::{DQuat, DVec3};
use std::path::Path;

/// Largest difference of the stated velocity and that of two successive positions, m/s. Between jumps the recordings of
/// EuRoC stay below 0.08.
const JUMP: f64 = 0.2;

/// Reads the path, and the real inertial samples where their file is given; a fault where a row is wrong.
pub fn read(truth: &Path, imu: Option<&Path>) -> Result<Recording, Fault> {
    let mut recording = Recording { poses: Vec::new(), biases: Vec::new(), imu: None };
    let mut shift = DVec3::ZERO;
    let mut before: Option<(Nanos, DVec3, DVec3)> = None; // stamp, position, velocity as read
    for Row { line, value: (t, v) } in rows(truth, 7)? {
        let q = DQuat::from_xyzw(v[4], v[5], v[6], v[3]);
        if !(0.9..1.1).contains(&q.length()) {
            let fix = "columns are stamp, p xyz, q wxyz";
            return Err(Fault::at(FaultKind::Data, truth, line, "the quaternion is not of unit length", fix));
        }
        let p = DVec3::new(v[0], v[1], v[2]);
        if v.len() >= 10 {
            let velocity = DVec3::new(v[7], v[8], v[9]);
            if let Some((t_before, p_before, v_before)) = before {
                let expected = 0.5 * (velocity + v_before) * (t - t_before).secs();
                if (p - p_before - expected).length() > JUMP * (t - t_before).secs() {
                    shift -= p - p_before - expected;
                }
            }
            before = Some((t, p, velocity));
        }
        recording.poses.push(TimedPose { t, pose: Pose::new(q, p + shift) });
        if v.len() >= 16 {
            let (gyro, accel) = (DVec3::new(v[10], v[11], v[12]), DVec3::new(v[13], v[14], v[15]));
            recording.biases.push(Bias { t, gyro, accel });
        }
    }
    if let Some(path) = imu {
        let sample = |Row { value: (t, v), .. }: Row<Values>| ImuSample {
            t,
            gyro_body: DVec3::new(v[0], v[1], v[2]),
            accel_body: DVec3::new(v[3], v[4], v[5]),
            ..ImuSample::default()
        };
        recording.imu = Some(rows(path, 6)?.into_iter().map(sample).collect());
    }
    Ok(recording)
}

type Values = (Nanos, Vec<f64>);

/// Rows of a stamp and at least `columns` finite numbers; two at least.
fn rows(path: &Path, columns: usize) -> Result<Vec<Row<Values>>, Fault> {
    let what = format!("stamp [ns] and {columns} or more numbers");
    let parse = |fields: &[&str]| -> Option<Values> {
        let values = numbers(fields.get(1..)?)?;
        let good = values.len() >= columns && values.iter().all(|v| v.is_finite());
        good.then_some((Nanos(fields[0].parse().ok()?), values))
    };
    let rows = read_strictly(path, &what, parse, |row| row.0)?;
    if rows.len() < 2 {
        let place = path.display().to_string();
        return Err(Fault::new(FaultKind::Data, place, "has fewer than two rows", "give a csv in EuRoC's format"));
    }
    Ok(rows)
}
