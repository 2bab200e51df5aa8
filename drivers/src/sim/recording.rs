//! Ground truth and inertial samples of a recorded flight, from csv in EuRoC's format.
//!
//! Truth rows: stamp ns, p (3), q wxyz (4), then optionally v (3), gyro bias (3), accelerometer
//! bias (3). Inertial rows: stamp ns, gyro (3), specific force (3). Stamps must increase.
//!
//! Estimated truth jumps now and then (12 cm in 5 ms in MH_04), which no inertial unit would have
//! felt. Where positions leave what the stated velocities allow, what follows is shifted to fit:
//! the simulated room is built around the path, so nothing depends on its absolute place.

use super::imu::Bias;
use super::scenario::Recording;
use crate::fault::{Fault, FaultKind};
use crate::types::{ImuSample, Nanos, Pose, TimedPose};
use glam::{DQuat, DVec3};
use std::path::Path;

/// Largest difference of the stated velocity and that of two successive positions, m/s. Between
/// jumps the recordings of EuRoC stay below 0.08.
const JUMP: f64 = 0.2;

pub fn read(truth: &Path, imu: Option<&Path>) -> Result<Recording, Fault> {
    let mut recording = Recording { poses: Vec::new(), biases: Vec::new(), imu: None };
    let mut shift = DVec3::ZERO;
    let mut before: Option<(Nanos, DVec3, DVec3)> = None; // stamp, position, velocity as read
    for row in rows(truth, 7)? {
        let v = &row.values;
        let q = DQuat::from_xyzw(v[4], v[5], v[6], v[3]);
        if !(0.9..1.1).contains(&q.length()) {
            return Err(Fault::at(
                FaultKind::Data,
                truth,
                row.line,
                "the quaternion is not of unit length",
                "columns are stamp, p xyz, q wxyz",
            ));
        }
        let p = DVec3::new(v[0], v[1], v[2]);
        if v.len() >= 10 {
            let velocity = DVec3::new(v[7], v[8], v[9]);
            if let Some((t, p_before, v_before)) = before {
                let expected = 0.5 * (velocity + v_before) * (row.t - t).secs();
                if (p - p_before - expected).length() > JUMP * (row.t - t).secs() {
                    shift -= p - p_before - expected;
                }
            }
            before = Some((row.t, p, velocity));
        }
        recording.poses.push(TimedPose { t: row.t, pose: Pose::new(q, p + shift) });
        if v.len() >= 16 {
            let (gyro, accel) = (DVec3::new(v[10], v[11], v[12]), DVec3::new(v[13], v[14], v[15]));
            recording.biases.push(Bias { t: row.t, gyro, accel });
        }
    }
    if let Some(path) = imu {
        let sample = |row: Row| {
            let v = &row.values;
            let (gyro_body, accel_body) = (DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5]));
            ImuSample { t: row.t, gyro_body, accel_body }
        };
        recording.imu = Some(rows(path, 6)?.into_iter().map(sample).collect());
    }
    Ok(recording)
}

struct Row {
    line: usize,
    t: Nanos,
    values: Vec<f64>,
}

/// Rows of a stamp and at least `columns` finite numbers, by increasing stamp; two at least.
fn rows(path: &Path, columns: usize) -> Result<Vec<Row>, Fault> {
    let open = |e: csv::Error| {
        Fault::new(FaultKind::NoInput, path.display().to_string(), e.to_string(), "give a csv in EuRoC's format")
    };
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .comment(Some(b'#'))
        .flexible(true)
        .trim(csv::Trim::All)
        .from_path(path)
        .map_err(open)?;
    let mut rows: Vec<Row> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| {
            let line = e.position().map_or(0, |p| p.line() as usize);
            Fault::at(FaultKind::Data, path, line, e.to_string(), "give a csv in EuRoC's format")
        })?;
        let line = record.position().map_or(0, |p| p.line() as usize);
        let wrong = |what: String| Fault::at(FaultKind::Data, path, line, what, "give a csv in EuRoC's format");
        let stamp = record.get(0).unwrap_or_default();
        let t = Nanos(stamp.parse().map_err(|_| wrong(format!("'{stamp}' is not a stamp in nanoseconds")))?);
        let number = |s: &str| {
            s.parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| wrong(format!("'{s}' is not a number")))
        };
        let values = record.iter().skip(1).map(number).collect::<Result<Vec<f64>, Fault>>()?;
        if values.len() < columns {
            return Err(wrong(format!("{} columns, {} are needed", values.len() + 1, columns + 1)));
        }
        if rows.last().is_some_and(|r| r.t >= t) {
            return Err(wrong("the stamp does not increase".to_string()));
        }
        rows.push(Row { line, t, values });
    }
    if rows.len() < 2 {
        return Err(Fault::new(
            FaultKind::Data,
            path.display().to_string(),
            "has fewer than two rows",
            "give a csv in EuRoC's format",
        ));
    }
    Ok(rows)
}
