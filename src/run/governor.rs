//! The mapper's share of its time, by how hot the board is, what power it takes (`power`), whether Linux throttles it, and how
//! long tracking takes: the map slows down before odometry does. Linux's own files are read, and none is written.

use crate::config::GovernorConfig;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often it looks.
const PERIOD: Duration = Duration::from_secs(1);
/// Shares, from one step to the next, and the last: the map goes on being made, slowly.
const STEP: f64 = 0.7;
const STEPS: u32 = 7;
/// Looks without a reason to slow down before a step back up.
const CALM: u32 = 5;
/// Below the limit by so much, the mapper may work more again.
const COOLER_C: f64 = 3.0;
const POWER_EASED: f64 = 0.9;
const FRAMES_EASED: f64 = 0.7;
/// How far below the temperature at which Linux slows the processor down, °C.
const BELOW_PASSIVE_C: f64 = 5.0;
/// A clock whose limit is lowered by more than this is throttled.
const THROTTLED: f64 = 0.95;

/// A temperature and its limit, where Linux states one.
struct Zone {
    name: String,
    temp: PathBuf,
    passive_c: Option<f64>,
}

/// What the files of Linux say.
struct Board {
    zones: Vec<Zone>,
    /// Files with the highest clock that a core may have now, and its value at the start, kHz.
    clocks: Vec<(PathBuf, f64)>,
}

/// What is measured in a look.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured {
    /// The highest above its limit, °C above, its own value, and its sensor.
    pub hottest: Option<(f64, f64, String)>,
    pub power_w: Option<f64>,
    pub throttled: bool,
    /// Longest time that tracking a frame took, as a share of what it has: with each of its threads, the time between frames.
    pub frame_share: f64,
    /// Frames that were overwritten before tracking took them.
    pub overwritten: u64,
}

pub struct Governor {
    config: GovernorConfig,
    /// Threads of tracking.
    threads: u32,
    board: Board,
    next: Instant,
    /// Steps down from the whole time.
    steps: u32,
    calm: u32,
    /// Why, where the share is less than the whole.
    reason: Option<String>,
    frames: u64,
    overwritten: u64,
}

/// The number that a file holds.
pub(super) fn number(path: &Path) -> Option<f64> {
    fs::read_to_string(path).ok()?.trim().parse().ok()
}

/// The line that a file holds; empty where it cannot be read.
pub(super) fn text(path: PathBuf) -> String {
    fs::read_to_string(path).map(|text| text.trim().to_string()).unwrap_or_default()
}

/// Entries of a folder whose names begin so, in order.
pub(super) fn entries(folder: &Path, prefix: &str) -> Vec<PathBuf> {
    let mut all: Vec<_> = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    all.retain(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(prefix)));
    all.sort();
    all
}

impl Board {
    /// The sensors under `sys`, which is /sys. Those of batteries, disks and radios are left out by where they are.
    fn find(sys: &Path) -> Board {
        let zone = |path: PathBuf| {
            let trips = entries(&path, "trip_point_").into_iter().filter_map(|trip| {
                let of = trip.to_string_lossy().strip_suffix("_type").map(str::to_string)?;
                let slows = matches!(text(trip).as_str(), "passive" | "hot" | "critical");
                number(Path::new(&format!("{of}_temp"))).filter(|m| slows && *m > 0.0).map(|m| m / 1e3)
            });
            let passive_c = trips.reduce(f64::min);
            Zone { name: text(path.join("type")), temp: path.join("temp"), passive_c }
        };
        let mut zones: Vec<Zone> = entries(&sys.join("class/thermal"), "thermal_zone").into_iter().map(zone).collect();
        for hwmon in entries(&sys.join("class/hwmon"), "hwmon") {
            let name = text(hwmon.join("name"));
            let is_processor =
                ["coretemp", "k10temp", "amdgpu", "nouveau", "cpu_thermal", "i915"].contains(&name.as_str());
            for temp in entries(&hwmon, "temp").into_iter().filter(|path| is_processor && path.ends_with_input()) {
                let max = Path::new(&temp.to_string_lossy().replace("_input", "_max")).to_path_buf();
                let passive_c = number(&max).filter(|m| *m > 0.0).map(|m| m / 1e3);
                zones.push(Zone { name: name.clone(), temp, passive_c });
            }
        }
        let cores = entries(&sys.join("devices/system/cpu/cpufreq"), "policy").into_iter();
        let gpus = entries(&sys.join("class/devfreq"), "").into_iter().map(|path| path.join("max_freq"));
        let clocks = cores.map(|path| path.join("scaling_max_freq")).chain(gpus);
        let clocks = clocks.filter_map(|path| Some((number(&path)?, path))).map(|(at_start, path)| (path, at_start));
        Board { zones, clocks: clocks.collect() }
    }

    /// Temperatures above `limit_c`, or where that is 0 above what each sensor itself allows.
    fn measure(&self, limit_c: f64) -> Measured {
        let above = |zone: &Zone| {
            let c = number(&zone.temp)? / 1e3;
            let limit =
                if limit_c > 0.0 { Some(limit_c) } else { zone.passive_c.map(|passive| passive - BELOW_PASSIVE_C) };
            // Sensors that are off say 0, or nonsense.
            Some((c - limit?, c, zone.name.clone())).filter(|_| (1.0..200.0).contains(&c))
        };
        Measured {
            hottest: self.zones.iter().filter_map(above).max_by(|a, b| a.0.total_cmp(&b.0)),
            throttled: self
                .clocks
                .iter()
                .any(|(path, at_start)| number(path).is_some_and(|now| now < THROTTLED * at_start)),
            ..Measured::default()
        }
    }
}

trait EndsWithInput {
    fn ends_with_input(&self) -> bool;
}

impl EndsWithInput for PathBuf {
    fn ends_with_input(&self) -> bool {
        self.to_string_lossy().ends_with("_input")
    }
}

impl Governor {
    /// `threads` track; `sys` is /sys.
    pub fn new(config: &GovernorConfig, threads: u32, sys: &Path) -> Governor {
        Governor {
            config: config.clone(),
            threads,
            board: Board::find(sys),
            next: Instant::now() + PERIOD,
            steps: 0,
            calm: 0,
            reason: None,
            frames: 0,
            overwritten: 0,
        }
    }

    /// Goes on by other limits.
    pub fn set(&mut self, config: &GovernorConfig) {
        self.config = config.clone();
    }

    /// The mapper's share of its time, and why it is not the whole.
    pub fn share(&self) -> (f64, Option<&str>) {
        (STEP.powi(self.steps as i32), self.reason.as_deref())
    }

    /// Looks once a second; answers a line where the share changed. `power_w` is what the board takes, where that is known, `frames`
    /// and `overwritten` count from the start, `latency_most` is the longest that tracking took a frame since the last look: it is
    /// asked for then alone.
    pub fn look(
        &mut self,
        now: Instant,
        power_w: Option<f64>,
        frames: u64,
        overwritten: u64,
        latency_most: impl FnOnce() -> Duration,
    ) -> Option<String> {
        if now < self.next {
            return None;
        }
        let elapsed = PERIOD + now.saturating_duration_since(self.next);
        self.next = now + PERIOD;
        let new_frames = frames.saturating_sub(std::mem::replace(&mut self.frames, frames));
        let overwritten = overwritten.saturating_sub(std::mem::replace(&mut self.overwritten, overwritten));
        let latency_s = latency_most().as_secs_f64() / f64::from(self.threads);
        let frame_share = latency_s * (new_frames + overwritten) as f64 / elapsed.as_secs_f64();
        let measured = match self.config.enabled {
            true => Measured { frame_share, overwritten, power_w, ..self.board.measure(self.config.temperature_max_c) },
            false => Measured::default(),
        };
        self.judge(&measured)
    }

    /// Slows the mapper down where there is a reason to, and lets it work more where there was none for a while.
    fn judge(&mut self, m: &Measured) -> Option<String> {
        let (before, power_max) = (self.steps, self.config.power_max_w);
        let hot = m.hottest.as_ref().filter(|(above, ..)| *above > 0.0);
        let power = m.power_w.filter(|w| power_max > 0.0 && *w > power_max);
        let slow = m.frame_share > self.config.frame_share_max;
        let reason = if m.overwritten > 0 {
            Some(format!("{} frames came before tracking was ready", m.overwritten))
        } else if slow {
            Some(format!("tracking takes {:.0} % of its time for a frame", 100.0 * m.frame_share))
        } else if let Some((_, c, name)) = hot {
            Some(format!("{name} is at {c:.0} degrees"))
        } else if let Some(w) = power {
            Some(format!("the board takes {w:.1} W"))
        } else {
            m.throttled.then(|| "Linux has lowered the clocks".to_string())
        };
        let eased = m.hottest.as_ref().is_none_or(|(above, ..)| *above < -COOLER_C)
            && m.power_w.is_none_or(|w| power_max == 0.0 || w < POWER_EASED * power_max)
            && m.frame_share < FRAMES_EASED * self.config.frame_share_max;
        match reason {
            Some(reason) => {
                // A frame that was lost is worse than one that may be.
                let down = if m.overwritten > 0 { 2 } else { 1 };
                self.steps = (self.steps + down).min(STEPS);
                self.calm = 0;
                self.reason = Some(reason);
            }
            None if eased => self.calm += 1,
            None => self.calm = 0,
        }
        if self.calm >= CALM || !self.config.enabled {
            self.calm = 0;
            self.steps = if self.config.enabled { self.steps.saturating_sub(1) } else { 0 };
        }
        if self.steps == 0 {
            self.reason = None;
        }
        if self.steps == before {
            return None;
        }
        let (share, reason) = self.share();
        let why = match reason {
            Some(reason) if self.steps > before => format!(": {reason}"),
            _ => String::new(),
        };
        Some(format!("the mapper works {:.0} % of its time{why}", 100.0 * share))
    }
}

#[cfg(test)]
pub(super) mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    pub fn write(root: &Path, files: &[(&str, &str)]) {
        for (name, content) in files {
            let path = root.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, format!("{content}\n")).unwrap();
        }
    }

    /// Files of a Raspberry Pi 5, an x86 and a Jetson, in what matters here.
    fn boards() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        write(
            dir.path(),
            &[
                ("class/thermal/thermal_zone0/type", "cpu-thermal"),
                ("class/thermal/thermal_zone0/temp", "61000"),
                ("class/thermal/thermal_zone0/trip_point_0_type", "critical"),
                ("class/thermal/thermal_zone0/trip_point_0_temp", "110000"),
                ("class/thermal/thermal_zone0/trip_point_1_type", "passive"),
                ("class/thermal/thermal_zone0/trip_point_1_temp", "80000"),
                ("class/thermal/thermal_zone1/type", "off"),
                ("class/thermal/thermal_zone1/temp", "-256000"),
                ("class/hwmon/hwmon0/name", "coretemp"),
                ("class/hwmon/hwmon0/temp1_input", "55000"),
                ("class/hwmon/hwmon0/temp1_max", "100000"),
                ("class/hwmon/hwmon1/name", "nvme"),
                ("class/hwmon/hwmon1/temp1_input", "99000"),
                ("class/hwmon/hwmon1/temp1_max", "70000"),
                ("devices/system/cpu/cpufreq/policy0/scaling_max_freq", "2400000"),
                ("class/devfreq/17000000.gpu/max_freq", "624750000"),
            ],
        );
        dir
    }

    #[test]
    fn sensors_of_the_board_are_read_in_their_units() {
        let dir = boards();
        let board = Board::find(dir.path());
        let m = board.measure(0.0);
        let (above, c, name) = m.hottest.unwrap();
        assert_eq!((above, c, name.as_str()), (61.0 - 75.0, 61.0, "cpu-thermal"), "the closest to its own limit");
        assert!(!m.throttled);
        assert_eq!(board.measure(50.0).hottest.unwrap().0, 11.0);
        write(dir.path(), &[("class/devfreq/17000000.gpu/max_freq", "306000000")]);
        assert!(board.measure(0.0).throttled);
        // A machine that tells nothing, and one whose files are gone.
        assert_eq!(Board::find(Path::new("/nowhere")).measure(80.0), Measured::default());
        dir.close().unwrap();
        assert_eq!(board.measure(80.0), Measured::default());
    }

    #[test]
    fn mapper_slows_down_for_each_reason_and_comes_back_when_there_is_none() {
        let config = GovernorConfig { power_max_w: 10.0, ..GovernorConfig::default() };
        let governor = || Governor::new(&config, 1, Path::new("/nowhere"));
        let calm = Measured { frame_share: 0.3, ..Measured::default() };
        let reasons = [
            (Measured { overwritten: 2, ..calm.clone() }, "2 frames came before", 0.49),
            (Measured { frame_share: 0.9, ..calm.clone() }, "tracking takes 90 %", 0.7),
            (Measured { hottest: Some((1.0, 76.0, "cpu".into())), ..calm.clone() }, "cpu is at 76 degrees", 0.7),
            (Measured { power_w: Some(12.0), ..calm.clone() }, "12.0 W", 0.7),
            (Measured { throttled: true, ..calm.clone() }, "Linux has lowered the clocks", 0.7),
        ];
        for (measured, why, share) in reasons {
            let mut g = governor();
            let line = g.judge(&measured).unwrap();
            assert!(line.contains(why), "{line}");
            assert!((g.share().0 - share).abs() < 1e-9);
            // For as long as it lasts it goes on down, to a share that is none of nothing.
            (0..20).for_each(|_| drop(g.judge(&measured)));
            let least = g.share().0;
            assert!((0.05..0.1).contains(&least) && g.share().1.is_some(), "{least}");
            let lines = (0..100).filter(|_| g.judge(&calm).is_some()).count();
            assert_eq!((g.share(), lines), ((1.0, None), STEPS as usize), "each change is told");
        }
        // Between the limits nothing changes.
        let mut g = governor();
        g.judge(&Measured { frame_share: 0.9, ..calm.clone() });
        assert!((0..100).all(|_| g.judge(&Measured { frame_share: 0.7, ..calm.clone() }).is_none()));
        g.set(&GovernorConfig { enabled: false, ..config.clone() });
        assert_eq!((g.judge(&Measured::default()).is_some(), g.share().0), (true, 1.0));
    }

    #[test]
    fn time_that_tracking_takes_is_compared_with_the_time_between_frames() {
        let mut g = Governor::new(&GovernorConfig::default(), 2, Path::new("/nowhere"));
        let start = g.next;
        assert_eq!(g.look(start, None, 20, 0, || Duration::from_millis(40)), None, "40 % of twice 50 ms");
        assert_eq!(g.look(start, None, 20, 0, || panic!("not yet")), None);
        let line = g.look(start + PERIOD, None, 40, 0, || Duration::from_millis(90));
        assert!(line.unwrap().contains("tracking takes 90 %"));
        g.set(&GovernorConfig { power_max_w: 10.0, ..GovernorConfig::default() });
        let line = g.look(start + 2 * PERIOD, Some(12.0), 60, 0, || Duration::from_millis(40));
        assert!(line.unwrap().contains("the board takes 12.0 W"));
    }
}
