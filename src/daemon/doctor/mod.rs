//! `stipple doctor`: looks at the sensors for a while and says of each part of a board ok, warn or fail, and what to do.
//!
//! What it asks of the user is to hold the rig still for two seconds and then to turn it about all three axes.

pub mod agreement;
pub mod machine;
pub mod motion;
pub mod rotation;
pub mod signals;

use super::hardware;
use super::live::{rig_of, Rig, Run};
use super::pipeline::{Bell, Ends};
use super::progress::Gauges;
use super::sensors::{self, Capture, Inbox};
use crate::config::Board;
use crate::counters::Counters;
use crate::stereo::alignment::Alignment;
use crate::stereo::rectify::Rectification;
use agreement::agreement;
use rotation::Turning;
use signals::Light;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::Arc;
use std::time::{Duration, Instant};
use stipple_drivers::{host, Calibration, Exit, Fault, Frames, Image, ImuSample, Nanos};

/// How long sensors are looked at by default, s.
pub const LOOK_S: f64 = 15.0;
const SLOTS: usize = 6;
/// Stereo pairs matched, one in so many frames.
const PAIR_EVERY: usize = 25;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    Ok,
    Warn,
    Fail,
}

/// One line of the answer, and what to do.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    pub verdict: Verdict,
    what: String,
    fix: String,
}

impl Check {
    pub fn ok(what: impl Into<String>) -> Check {
        Check { verdict: Verdict::Ok, what: what.into(), fix: String::new() }
    }

    pub fn warn(what: impl Into<String>, fix: impl Into<String>) -> Check {
        Check { verdict: Verdict::Warn, what: what.into(), fix: fix.into() }
    }

    pub fn fail(what: impl Into<String>, fix: impl Into<String>) -> Check {
        Check { verdict: Verdict::Fail, what: what.into(), fix: fix.into() }
    }

    pub fn print(&self) {
        let verdict = match self.verdict {
            Verdict::Ok => "ok",
            Verdict::Warn => "warn",
            Verdict::Fail => "fail",
        };
        println!("{verdict:<6} {}", self.what);
        if !self.fix.is_empty() {
            println!("{:<6} -> {}", "", self.fix);
        }
    }
}

/// What the sensors gave while they were looked at.
struct Seen {
    frames: Vec<Nanos>,
    samples: Vec<ImuSample>,
    light: Vec<Light>,
    turning: Turning,
    pairs: Pairs,
    counters: Counters,
    source: Vec<(&'static str, u64)>,
    capture: Option<Capture>,
    notices: Vec<String>,
    broken: Option<Fault>,
}

/// Matches of the left image in the right one, and the other way round: of swapped cameras only the other way has any.
struct Pairs {
    rectification: Result<Rectification, Fault>,
    straight: Alignment,
    swapped: Alignment,
}

impl Pairs {
    fn add(&mut self, calibration: &Calibration, frames: &Arc<Frames>, disparities: usize) {
        let Ok(rectification) = &self.rectification else { return };
        let p = rectification.camera.pinhole;
        let view = |i: usize, image: usize| {
            let mut out = Image::new(p.width, p.height);
            rectification.map(&calibration.cameras[i]).apply(&frames.images[image], &mut out);
            out
        };
        self.straight.add(&view(0, 0), &view(1, 1), disparities);
        self.swapped.add(&view(0, 1), &view(1, 0), disparities);
    }

    fn check(&self, board: &Board) -> Check {
        match &self.rectification {
            Err(fault) if board.map.enabled => {
                return Check::fail(format!("stereo: the calibration {}", fault.what), fault.fix.clone())
            }
            Err(fault) => {
                let fix = "right for cameras that look apart; odometry needs no more, a map does";
                return Check::warn(format!("stereo: the calibration {}", fault.what), fix);
            }
            Ok(_) => {}
        }
        let (n, m) = (self.straight.rows.len(), self.swapped.rows.len());
        if m > 2 * n && m > 20 {
            let what = format!("stereo: {n} corners match as calibrated, {m} with the cameras swapped");
            return Check::fail(
                what,
                "cameras 0 and 1 are swapped: exchange them in camera.devices or in the calibration",
            );
        }
        match self.straight.summary() {
            None => Check::warn(
                format!("stereo: only {n} corners match"),
                "look at something with detail, a metre away or more",
            ),
            Some((rows, _)) if rows.abs() > super::dataset::ROWS_MAX_PX => Check::warn(
                format!("stereo: camera 1 sees points {rows:+.2} px lower after rectification"),
                "stereo matches rows: calibrate the extrinsics and principal points anew",
            ),
            Some((rows, spread)) => Check::ok(format!(
                "stereo: rows agree to {rows:+.2} px ({n} corners, deviation {:.2} px)",
                1.4826 * spread
            )),
        }
    }
}

/// `stipple doctor`
pub fn doctor(path: &Path, out: &Path, set: &[String], options: &Run) -> Result<(), Fault> {
    let board = Board::load(path, set)?;
    let mut checks = machine::vulkan(&board);
    checks.push(machine::disk(out));
    checks.iter().for_each(Check::print);
    let look_s = options.duration_s.unwrap_or(LOOK_S);
    let run = Run { duration_s: Some(look_s), dataset: options.dataset.clone(), record: None };
    let sensed = match rig_of(path, &board, &run) {
        Ok(rig) => {
            let memory = machine::memory_ceiling(Some(&rig.calibration), &board);
            memory.print();
            eprintln!("hold the rig still for two seconds, then turn it about all three axes ({look_s:.0} s)");
            let sensed = [vec![memory], sensed(rig, &board, look_s)?].concat();
            sensed[1..].iter().for_each(Check::print);
            sensed
        }
        Err(fault) => {
            let memory = machine::memory_ceiling(None, &board);
            let mut list = vec![memory];
            let named = !board.camera.devices.is_empty() && !board.rig.calibration.is_empty();
            if options.dataset.is_none() && named {
                // One part fails; the others may be well, and are said too.
                list.extend(hardware::parts(path, &board).into_iter().map(|(name, found)| match found {
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
    let failed = checks.iter().chain(&sensed).filter(|c| c.verdict == Verdict::Fail).count();
    match failed {
        0 => Ok(()),
        n => {
            let what = format!("{n} check{} failed", if n == 1 { "" } else { "s" });
            Err(Fault::new(Exit::Unavailable, path.display().to_string(), what, "see the lines above"))
        }
    }
}

fn sensed(rig: Rig, board: &Board, look_s: f64) -> Result<Vec<Check>, Fault> {
    let (calibration, expected_hz) = (rig.calibration.clone(), rig.expected_hz);
    let seen = look(rig, board, look_s)?;
    let mut checks = vec![];
    if let Some(fault) = &seen.broken {
        checks.push(Check::fail(format!("{}: {}", fault.place, fault.what), fault.fix.clone()));
    }
    for line in &seen.notices {
        checks.push(Check::warn(line.clone(), "check plug and cable"));
    }
    checks.push(signals::rate("camera rate", &seen.frames, seen.counters.frames_missing.get(), expected_hz));
    let imu: Vec<Nanos> = seen.samples.iter().map(|s| s.t).collect();
    checks.push(signals::rate("inertial rate", &imu, seen.counters.imu_missing.get(), Some(calibration.imu.rate_hz)));
    checks.push(skew(&seen));
    checks.extend(seen.capture.and_then(|c| capture(&c, &seen)));
    checks.extend(seen.light.iter().enumerate().map(|(camera, light)| light.check(camera)));
    checks.push(seen.pairs.check(board));
    checks.extend(signals::inertia(&seen.samples, &calibration));
    checks.push(signals::saturation(&seen.samples, seen.counters.imu_saturated.get(), board));
    let found = agreement(&seen.turning.turns, &seen.samples, calibration.cameras[0].body_from_cam.q);
    checks.extend(signals::turning(found.as_ref()));
    Ok(checks)
}

/// More of a core than this to read the cameras is more than odometry takes itself.
const CAPTURE_SHARE_MAX: f64 = 0.25;

fn capture(capture: &Capture, seen: &Seen) -> Option<Check> {
    let what = format!("capture: {}", capture.line(&seen.source)?);
    let look_s = (*seen.frames.last()? - *seen.frames.first()?).secs();
    if capture.cpu.total_s() > CAPTURE_SHARE_MAX * look_s {
        return Some(Check::warn(
            what,
            "let the camera send grey, not mjpeg (camera.format), or fewer or smaller frames",
        ));
    }
    Some(Check::ok(what))
}

/// Images without a partner within the tolerance, as the source counts them.
fn skew(seen: &Seen) -> Check {
    let unpaired: u64 = seen.source.iter().filter(|(name, _)| name.ends_with("images_unpaired")).map(|(_, n)| n).sum();
    let what = format!("left and right: {unpaired} images without a partner in {} frames", seen.frames.len());
    match unpaired {
        0 => Check::ok(what),
        n if n < 2 + seen.frames.len() as u64 / 50 => Check::ok(what),
        _ => Check::warn(what, "trigger the cameras together, or widen the pair tolerance to their skew"),
    }
}

/// Reads the sensors with the threads of a run and looks at what comes.
fn look(rig: Rig, board: &Board, look_s: f64) -> Result<Seen, Fault> {
    let (calibration, mut sensors) = (rig.calibration, rig.sensors);
    let mut seen = Seen {
        frames: vec![],
        samples: vec![],
        light: vec![Light::new(); calibration.cameras.len()],
        turning: Turning::new(&calibration, &board.frontend)?,
        pairs: Pairs {
            rectification: Rectification::new(&calibration),
            straight: Alignment::default(),
            swapped: Alignment::default(),
        },
        counters: Counters::default(),
        source: rig.opened,
        capture: None,
        notices: vec![],
        broken: None,
    };
    let (inbox, bell, counters) = (Inbox::new(SLOTS, &calibration, 0), Bell::default(), Counters::default());
    let (over, gauges, begun) = (AtomicBool::new(false), Gauges::default(), Instant::now());
    let stop = host::stop_asked_for();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let _ended = Ends(&over, Some(&bell));
            sensors::camera(&inbox, &mut sensors.frames, &bell, &counters, &gauges);
        });
        scope.spawn(|| sensors::inertial(&inbox, &mut sensors.imu, &bell, &over, &counters));
        let mut held = None;
        loop {
            let ended = over.load(Relaxed);
            let late = begun.elapsed().as_secs_f64() >= look_s;
            inbox.stop.fetch_or(late || stop.load(Relaxed), Relaxed);
            match inbox.take(&mut held, &over, &counters) {
                Some(slot) => {
                    seen.samples.extend(slot.imu.iter());
                    if !slot.frameless {
                        take(&mut seen, &calibration, &slot.frames, board.stereo.disparities as usize);
                    }
                    let _ = inbox.spare.push(slot);
                }
                None if ended => break,
                None => std::thread::sleep(Duration::from_millis(1)),
            }
            while let Some(line) = inbox.notices.pop() {
                seen.notices.push(line);
            }
        }
    });
    seen.source.extend(sensors.frames.counters());
    seen.broken = inbox.broken.pop();
    seen.capture = inbox.capture.get().copied();
    seen.counters = counters;
    Ok(seen)
}

fn take(seen: &mut Seen, calibration: &Calibration, frames: &Arc<Frames>, disparities: usize) {
    if seen.frames.len() % PAIR_EVERY == 0 {
        seen.pairs.add(calibration, frames, disparities);
        seen.light.iter_mut().enumerate().for_each(|(camera, light)| light.add(frames, camera));
    }
    seen.frames.push(frames.t);
    seen.turning.add(frames);
}
