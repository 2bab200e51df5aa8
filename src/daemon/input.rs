//! What a run plays: a recording on disk, or a flight the simulator rendered into memory.

use crate::config::{ReplayConfig, RigConfig};
use std::path::{Path, PathBuf};
use stipple_drivers::paced::Images;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Calibration, Exit, Fault, Frames, ImuSample, Nanos, Span, TimedPose};

pub struct Input {
    pub name: String,
    pub calibration: Calibration,
    pub imu: Vec<ImuSample>,
    pub stamps: Vec<Nanos>,
    /// world_from_body; empty where there is none.
    pub truth: Vec<TimedPose>,
    pub warnings: Vec<String>,
    pub counters: Vec<(&'static str, u64)>,
    pub source: Images,
}

impl Input {
    pub fn recording(dataset: &Path, config: &ReplayConfig, rig: &RigConfig) -> Result<Input, Fault> {
        let options = OpenOptions {
            pair_tolerance: Span::from_secs(config.pair_tolerance_s),
            imu_hole: Span::from_secs(config.imu_hole_s),
            calibration: (!config.calibration.is_empty()).then(|| PathBuf::from(&config.calibration)),
            readout: (rig.readout_s > 0.0).then(|| Span::from_secs(rig.readout_s)),
        };
        let r = Recording::open(dataset, &options)?;
        let reader = r.reader();
        let name =
            dataset.file_name().map_or_else(|| dataset.display().to_string(), |n| n.to_string_lossy().into_owned());
        Ok(Input {
            name,
            stamps: r.frames.iter().map(|f| f.t).collect(),
            counters: r.counters.list(),
            calibration: r.calibration,
            imu: r.imu,
            truth: r.truth,
            warnings: r.warnings,
            source: Images::Recording(reader),
        })
    }

    /// Renders every frame before the flight starts, so that rendering takes nothing from it; the first `colours` cameras in
    /// colour.
    pub fn rendered(
        scenario: &Scenario,
        colours: usize,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Input, Fault> {
        let mut sim = Sim::new(scenario)?;
        let count = sim.frame_count();
        let mut frames = Vec::with_capacity(count);
        for i in 0..count {
            let mut f = Frames::in_colour(sim.calibration(), colours);
            sim.render(i, &mut f);
            frames.push(f);
            progress(i + 1, count);
        }
        Ok(Input {
            name: format!("simulated flight `{}`", scenario.name),
            calibration: sim.calibration().clone(),
            imu: sim.imu().to_vec(),
            stamps: frames.iter().map(|f| f.t).collect(),
            truth: sim.truth(),
            warnings: vec![],
            counters: vec![],
            source: Images::Rendered(frames),
        })
    }

    /// Refuses grey images where colour is asked for of the first `cameras`.
    pub fn needs_colour(&self, cameras: usize, place: &str) -> Result<(), Fault> {
        if self.source.has_colour(cameras) {
            return Ok(());
        }
        let what = format!("map.colour = true, but the images of {place} are grey");
        Err(Fault::new(Exit::Config, "map.colour", what, "set map.colour = false"))
    }

    /// Frames whose stamp is less than `duration_s` after the first.
    pub fn frames_within(&self, duration_s: Option<f64>) -> usize {
        match (duration_s, self.stamps.first()) {
            (Some(s), Some(&first)) => self.stamps.partition_point(|t| (*t - first).secs() < s),
            _ => self.stamps.len(),
        }
    }

    pub fn length_s(&self) -> f64 {
        match (self.stamps.first(), self.stamps.last()) {
            (Some(a), Some(b)) => (*b - *a).secs(),
            _ => 0.0,
        }
    }
}
