//! The byte table: everything a board buys at boot, summed before anything is bought.

use super::keyframes::KeyframeRing;
use super::log;
use super::loop_closing::LoopClosing;
use super::mailbox::Mailbox;
use super::tracking::OdometryRun;
use super::{packets, FRAMES_KEPT};
use crate::config::Board;
use crate::limits::CAMERAS_MAX;
use crate::map::{cameras, Mapper};
use crate::mem::Footprint;
use crate::publish::mavlink::Autopilot;
use crate::publish::{cloud, status, Stamps};
use crate::stereo::Matcher;
use stipple_drivers::record::Ring;
use stipple_drivers::{Calibration, Camera, Fault, FaultKind, Frames, ImuCalibration, Lens, Pose, RigCamera};

/// Puts what this machine has in the place of a library that it lacks; answers what that was.
pub fn replace_missing(board: &mut Board) -> Option<Fault> {
    board.map.enabled.then(|| Matcher::replace_missing(&mut board.stereo)).flatten()
}

/// Everything a run with this rig takes, without the operating system's and the drivers' own; with the ring of a recording
/// where it `records`. Each part is built once and dropped again. Fails where a part cannot take the rig.
pub fn footprint(calibration: &Calibration, board: &Board, records: bool) -> Result<Footprint, Fault> {
    let colours = colours(calibration, board).len();
    let mut f = Footprint::default();
    f.build("queues: frames and samples", || Mailbox::new(packets(board.frontend.threads), calibration, colours));
    OdometryRun::measured(calibration, board, FRAMES_KEPT, &mut f)?;
    LoopClosing::measured(calibration, board, &mut f)?;
    log::Queue::measured(&mut f);
    if board.mavlink.address().is_some() {
        f.build("queues: autopilot", || Autopilot::new(&board.mavlink, Stamps::default(), 0))?;
    }
    f.host("queues: status socket", status::BYTES + if board.map.enabled { 2 * cloud::BYTES } else { 0 });
    if board.map.enabled {
        // First, since it refuses a rig without the cameras that keyframes have images of.
        let mapper = Mapper::footprint(calibration, board)?;
        f.host("queues: keyframes", KeyframeRing::bytes(calibration, board));
        f.extend(mapper);
    }
    if records {
        let shape = Frames::in_colour(calibration, colours);
        f.build("queues: recording", || Ring::new(&shape, board.record.ring_frames as usize));
    }
    Ok(f)
}

/// The cameras that are read in colour.
pub fn colours<'a>(calibration: &'a Calibration, board: &Board) -> &'a [RigCamera] {
    let n = if board.map.enabled { cameras::colours(calibration.cameras.len(), &board.map) } else { 0 };
    &calibration.cameras[..n]
}

/// The largest rig a board accepts: its widest image from a stereo pair, or from every camera its map trains on.
pub fn largest_rig(board: &Board) -> Calibration {
    let (width, height) = (board.budget.image_width_max as usize, board.budget.image_height_max as usize);
    let f = width as f64 * 0.6;
    let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
    let camera = Camera { width, height, fx: f, fy: f, cx: width as f64 / 2.0, cy: height as f64 / 2.0, lens };
    let at = |x: f64| RigCamera::new(camera, Pose { p: glam::DVec3::new(x, 0.0, 0.0), ..Pose::IDENTITY });
    let cameras = cameras::count(CAMERAS_MAX, &board.map).max(2);
    Calibration { cameras: (0..cameras).map(|i| at(0.1 * i as f64)).collect(), imu: ImuCalibration::CONSUMER }
}

/// Refuses a method of stereo that this program has not, and a rig whose images or bytes exceed the board's budget.
pub fn check_fits(place: &str, calibration: &Calibration, board: &Board, records: bool) -> Result<Footprint, Fault> {
    let (w, h) = (board.budget.image_width_max as usize, board.budget.image_height_max as usize);
    for (i, c) in calibration.cameras.iter().enumerate() {
        if c.camera.width > w || c.camera.height > h {
            let what =
                format!("camera {i} is {}x{} px, the board's budget is {w}x{h}", c.camera.width, c.camera.height);
            let fix = "raise budget.image_width_max and image_height_max";
            return Err(Fault::new(FaultKind::Config, place, what, fix));
        }
    }
    if board.map.enabled {
        let left = &calibration.cameras[0].camera;
        Matcher::check_supported(left.width, left.height, &board.stereo)?;
    }
    let f = footprint(calibration, board, records)?;
    let max = board.memory_max_mib << 20;
    if f.total() > max {
        let largest = f.rows.iter().max_by_key(|r| r.bytes).map_or("", |r| r.name);
        let what = format!("needs {:.1} MiB, memory_max_mib is {}", mib(f.total()), board.memory_max_mib);
        let fix = format!("raise memory_max_mib or shrink [budget]; the largest part is `{largest}`");
        return Err(Fault::new(FaultKind::Config, place, what, fix));
    }
    Ok(f)
}

pub fn print(f: &Footprint) {
    for row in &f.rows {
        println!("{:>12}  {:4} {}", row.bytes, if row.gpu { "gpu" } else { "host" }, row.name);
    }
    println!("{:>12}  gpu  total ({:.1} MiB)", f.gpu_total(), mib(f.gpu_total()));
    println!("{:>12}       total ({:.1} MiB)", f.total(), mib(f.total()));
}

pub fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}
