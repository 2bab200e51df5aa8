//! `stipple doctor`: looks at the sensors for a while and says of each part of a board ok, warn or fail, and what to do.
//!
//! What it asks of the user is to hold the rig still for two seconds and then to turn it about all three axes.

mod machine;
mod signals;

use super::checks::rows::Rows;
use super::checks::{all_passed, gyro, Check, Follower, Verdict};
use super::{open_input, seconds, BoardArgs};
use crate::config::Board;
use crate::run::mailbox::Capture;
use crate::run::memory;
use crate::run::sensors::{self, Input, Source};
use crate::run::status::{print_err, Status};
use crate::run::tracking::FramePacket;
use crate::run::{observe, Flown};
use signals::Brightness;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use stipple_drivers::{Calibration, Fault, FaultKind, ImuSample, Nanos};

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    board: BoardArgs,
    /// Time to read the sensors
    #[arg(long, value_name = "S", default_value = "15", value_parser = seconds)]
    duration: f64,
    /// Play this recording in place of the sensors, at its pace
    #[arg(long, value_name = "DIR")]
    dataset: Option<PathBuf>,
    /// Folder that runs and recordings will go to; its disk must have room
    #[arg(long, value_name = "DIR", default_value = "out")]
    out: PathBuf,
}

/// Stereo pairs matched, one in so many frames.
const PAIR_EVERY: usize = 25;

/// What the sensors gave.
struct Gathered {
    calibration: Calibration,
    frames: Vec<Nanos>,
    samples: Vec<ImuSample>,
    light: Vec<Brightness>,
    follower: Follower,
    rows: Rows,
}

pub fn doctor(args: &Args) -> Result<(), Fault> {
    let mut board = args.board.load()?;
    let missing = memory::replace_missing(&mut board);
    let mut checks = machine::vulkan(&board);
    checks.extend(missing.map(|m| Check::warn(format!("stereo: {}", m.what), m.fix)));
    checks.push(machine::disk(&args.out));
    checks.iter().for_each(Check::print);
    let sensed = match open_input(args.dataset.as_deref(), &args.board, &board) {
        Ok(input) => {
            let memory = machine::memory_ceiling(Some(&input.calibration), &board);
            memory.print();
            let look_s = args.duration;
            print_err(format_args!(
                "hold the rig still for two seconds, then turn it about all three axes ({look_s:.0} s)"
            ));
            let sensed = [vec![memory], sensed(input, &board, look_s)?].concat();
            sensed[1..].iter().for_each(Check::print);
            sensed
        }
        Err(fault) => {
            let mut list = vec![machine::memory_ceiling(None, &board)];
            let named = !board.camera.devices.is_empty() && !board.rig.calibration.is_empty();
            if args.dataset.is_none() && named {
                // One part fails; the others may be well, and are judged too.
                list.extend(sensors::parts(args.board.path(), &board).into_iter().map(|(name, found)| match found {
                    Ok(what) => Check::ok(format!("{name}: {what}")),
                    Err(fault) => Check::fail(format!("{name}: {}: {}", fault.place, fault.what), fault.fix),
                }));
            }
            if list.iter().all(|c| c.verdict != Verdict::Fail) {
                list.push(Check::fail(format!("sensors: {}: {}", fault.place, fault.what), fault.fix));
            }
            list.iter().for_each(Check::print);
            list
        }
    };
    all_passed(FaultKind::Unavailable, args.board.path(), checks.iter().chain(&sensed))
}

fn sensed(input: Input, board: &Board, look_s: f64) -> Result<Vec<Check>, Fault> {
    let rate_hz = match input.source {
        Source::Live { rate_hz, .. } => Some(rate_hz),
        Source::Recorded(_) => None,
    };
    let (seen, flown) = gather(input, board, look_s)?;
    let (seen, calibration) = (&seen, &seen.calibration);
    let mut checks = vec![];
    if let Some(fault) = &flown.broken {
        checks.push(Check::fail(format!("{}: {}", fault.place, fault.what), fault.fix.clone()));
    }
    for (id, line) in &flown.notices {
        let fix = if id.is_of_sensor() {
            "check plug and cable"
        } else {
            "see what else this machine does, and the limits it sets"
        };
        checks.push(Check::warn(line.clone(), fix));
    }
    let c = &flown.counters;
    checks.push(signals::rate("camera rate", &seen.frames, c.frames_missing.get(), rate_hz));
    let imu: Vec<Nanos> = seen.samples.iter().map(|s| s.t).collect();
    checks.push(signals::rate("inertial rate", &imu, c.imu_missing.get(), Some(calibration.imu.rate_hz)));
    checks.push(skew(seen, &flown));
    checks.extend(flown.capture.and_then(|c| capture(&c, seen, &flown)));
    checks.extend(seen.light.iter().enumerate().map(|(camera, light)| light.check(camera)));
    checks.push(seen.rows.check("stereo", "", board.map.enabled));
    checks.extend(signals::inertia(&seen.samples, calibration));
    checks.push(signals::saturation(&seen.samples));
    checks.extend(gyro::checks(seen.follower.agreement(&seen.samples, &board.vio).as_ref()));
    Ok(checks)
}

/// More of a core than this to read the cameras is more than odometry takes itself.
const CAPTURE_SHARE_MAX: f64 = 0.25;

fn capture(capture: &Capture, seen: &Gathered, flown: &Flown) -> Option<Check> {
    let what = format!("capture: {}", capture.line(&flown.source)?);
    let look_s = (*seen.frames.last()? - *seen.frames.first()?).secs();
    if capture.cpu.total_s() > CAPTURE_SHARE_MAX * look_s {
        let fix = "let the camera send grey, not mjpeg (camera.format), or fewer or smaller frames";
        return Some(Check::warn(what, fix));
    }
    Some(Check::ok(what))
}

/// Images without a partner within the tolerance, as the source counts them.
fn skew(seen: &Gathered, flown: &Flown) -> Check {
    let unpaired: u64 = flown.source.iter().filter(|(name, _)| name.ends_with("images_unpaired")).map(|(_, n)| n).sum();
    let what = format!("left and right: {unpaired} images without a partner in {} frames", seen.frames.len());
    match unpaired {
        0 => Check::ok(what),
        n if n < 2 + seen.frames.len() as u64 / 50 => Check::ok(what),
        _ => Check::warn(what, "trigger the cameras together, or widen the pair tolerance to their skew"),
    }
}

/// Reads the sensors for a while.
fn gather(input: Input, board: &Board, look_s: f64) -> Result<(Gathered, Flown), Fault> {
    let calibration = input.calibration.clone();
    let seen = Arc::new(Mutex::new(Gathered {
        frames: vec![],
        samples: vec![],
        light: vec![Brightness::new(); calibration.cameras.len()],
        follower: Follower::new(&calibration, &board.frontend)?,
        rows: Rows::new(&calibration, board.stereo.disparities),
        calibration,
    }));
    let shared = seen.clone();
    let observer = move |packet: &FramePacket| shared.lock().unwrap_or_else(PoisonError::into_inner).add(packet);
    let (mut flown, _) = observe(input, board, Some(look_s), None, Box::new(observer), &mut Status::silent())?;
    // The observer's own handle goes with its tracker.
    flown.tracker = crate::run::tracking::Tracker::Table(Default::default());
    let seen =
        Arc::into_inner(seen).expect("the observer is gone").into_inner().unwrap_or_else(PoisonError::into_inner);
    Ok((seen, flown))
}

impl Gathered {
    fn add(&mut self, packet: &FramePacket) {
        self.samples.extend(packet.imu.iter());
        if packet.imu_only {
            return;
        }
        let frames = &packet.frames;
        if self.frames.len() % PAIR_EVERY == 0 {
            self.rows.add(frames);
            self.light.iter_mut().enumerate().for_each(|(camera, light)| light.add(frames, camera));
        }
        self.frames.push(frames.t);
        self.follower.add(frames);
    }
}
