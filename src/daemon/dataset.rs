//! `stipple check --dataset`: what a recording says of its own calibration.

use super::doctor::agreement::{agreement, Agreement};
use super::doctor::rotation::Turning;
use super::doctor::{signals, Check};
use crate::config::{Board, FrontendConfig, ReplayConfig, StereoConfig};
use crate::stereo::alignment::Alignment;
use crate::stereo::rectify::Rectification;
use std::path::Path;
use std::sync::Arc;
use stipple_drivers::replay::{OpenOptions, Reader, Recording};
use stipple_drivers::{Fault, Frames, Image, Nanos, Span};

/// Frames looked at, evenly over the recording.
const LOOKED_AT: usize = 8;
/// Half of what costs `bm` a third more error and 2 % of its pixels (hard_misaligned in `stipple-bench stereo`).
pub const ROWS_MAX_PX: f64 = 0.5;

/// Says how far the rows of cameras 0 and 1 disagree after rectification.
///
/// Of TUM-VI's room1 it says -0.55 px, which is the recording's calibration and not the maps made here. Another rectification,
/// from the same camchain.yaml in floating point without tables, finds the same -0.93 mrad in each of three frames. They do
/// not grow with the distance from the axis, as an error of the lens would (-0.91, -0.98, -1.03, -0.66 mrad at tangents to
/// 0.3, 0.6, 0.9, 1.2), nor from left to right, as a roll would (-0.86 to -1.17); a shift and a slope down the picture
/// leave a third of it. So camera 1's principal point is 0.36 raw px off, or its pitch by 0.05 degrees, which rows cannot
/// tell apart. The file's two statements of the extrinsics agree to the last digit.
pub fn check_dataset(dataset: &Path, board: Option<&Board>) -> Result<(), Fault> {
    let replay = board.map_or_else(ReplayConfig::default, |b| b.replay.clone());
    let stereo = board.map_or_else(StereoConfig::default, |b| b.stereo.clone());
    let options = OpenOptions {
        calibration: (!replay.calibration.is_empty()).then(|| replay.calibration.clone().into()),
        pair_tolerance: Span::from_secs(replay.pair_tolerance_s),
        ..OpenOptions::default()
    };
    let recording = Recording::open(dataset, &options)?;
    let rectification = Rectification::new(&recording.calibration)?;
    let p = rectification.camera.pinhole;
    let maps = [0, 1].map(|i| rectification.map(&recording.calibration.cameras[i]));
    let (mut frames, mut reader) = (Frames::for_rig(&recording.calibration), recording.reader());
    let mut pair = [Image::new(p.width, p.height), Image::new(p.width, p.height)];
    let mut alignment = Alignment::default();
    let (mut read, looked_at) = (0, LOOKED_AT.min(recording.frames.len()));
    for k in 0..looked_at {
        let index = (2 * k + 1) * recording.frames.len() / (2 * looked_at);
        if reader.read(index, &mut frames).is_ok() {
            (0..2).for_each(|i| maps[i].apply(&frames.images[i], &mut pair[i]));
            alignment.add(&pair[0], &pair[1], stereo.disparities as usize);
            read += 1;
        }
    }
    println!("{:<6} {} stereo frames, {looked_at} looked at", "", recording.frames.len());
    let frontend = board.map_or_else(FrontendConfig::default, |b| b.frontend.clone());
    let turned = turned(&recording, &mut reader, &frontend)?;
    if read < looked_at {
        println!("{:<6} images: {} of the {looked_at} looked at cannot be read", "warn", looked_at - read);
    }
    for (name, n) in [recording.counters.list(), reader.counters().list()].concat().into_iter().filter(|(_, n)| *n > 0)
    {
        println!("{:<6} {name} {n}", "warn");
    }
    for said in [recording.warnings.first(), reader.warnings().first()].into_iter().flatten() {
        println!("       first: {said}");
    }
    let corners = alignment.rows.len();
    match alignment.summary() {
        None => println!("{:<6} vertical disparity: only {corners} corners match, too few to say", "warn"),
        Some((rows, spread)) => {
            let verdict = if rows.abs() > ROWS_MAX_PX { "warn" } else { "ok" };
            print!("{verdict:<6} vertical disparity: camera 1 sees points {rows:+.2} px lower after rectification");
            println!(" (median of {corners} corners, deviation {:.2} px)", 1.4826 * spread);
            if verdict == "warn" {
                println!("{:<6} stereo matches rows: calibrate the extrinsics and principal points anew", "");
            }
        }
    }
    signals::turning(turned.as_ref()).iter().for_each(Check::print);
    Ok(())
}

/// Frames in order that are followed, from where the gyro turns most.
const FOLLOWED: usize = 300;

/// The rotation of camera 0 against the gyro's.
fn turned(recording: &Recording, reader: &mut Reader, config: &FrontendConfig) -> Result<Option<Agreement>, Fault> {
    let rate = |t: Nanos| {
        let at = recording.imu.partition_point(|s| s.t < t);
        recording.imu.get(at).map_or(0.0, |s| s.gyro_body.length())
    };
    let rates: Vec<f64> = recording.frames.iter().map(|f| rate(f.t)).collect();
    let n = FOLLOWED.min(rates.len());
    let (mut first, mut most, mut sum) = (0, f64::MIN, rates[..n].iter().sum::<f64>());
    for from in 0..=rates.len() - n {
        if sum > most {
            (first, most) = (from, sum);
        }
        sum += rates.get(from + n).copied().unwrap_or(0.0) - rates[from];
    }
    let mut turning = Turning::new(&recording.calibration, config)?;
    let mut frames = Arc::new(Frames::for_rig(&recording.calibration));
    for i in first..first + n {
        if reader.read(i, Arc::make_mut(&mut frames)).is_ok() {
            turning.add(&frames);
        }
    }
    Ok(agreement(&turning.turns, &recording.imu, recording.calibration.cameras[0].body_from_cam.q))
}
