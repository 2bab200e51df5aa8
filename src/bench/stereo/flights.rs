//! Simulated flights that methods are judged on: the ones that deviations were fitted to, and others to report.
//!
//! Every flight has a room of its own, furnished by its seed, and no path is in both lists: MH_04's are of its two halves.
//! Invented flights stay in a room of 8 m; MH_04's room is up to 20 m deep, the only one with depths beyond 8 m.

use super::super::inputs;
use super::sets::{self, Set};
use std::path::Path;
use stipple_drivers::sim::Scenario;
use stipple_drivers::Fault;

/// Of each flight, evenly: as many as a software rasteriser matches in minutes.
const FRAMES: usize = 4;
/// Of a recorded path, s.
const SECONDS: f64 = 40.0;

struct Flown {
    /// A scenario of the simulator, or a recorded path and where in it to begin, s.
    path: &'static str,
    from_s: f64,
    seed: u64,
}

const fn flown(path: &'static str, from_s: f64, seed: u64) -> Flown {
    Flown { path, from_s, seed }
}

const FITTED: [Flown; 5] = [
    flown("demo", 0.0, 1),
    flown("aggressive", 0.0, 1),
    flown("demo", 0.0, 2),
    flown("aggressive", 0.0, 2),
    flown("MH_04_difficult", 16.0, 1),
];
const REPORTED: [Flown; 5] = [
    flown("circle", 0.0, 11),
    flown("hover", 0.0, 12),
    flown("MH_04_difficult", 56.0, 15),
    flown("V1_02_medium", 10.0, 16),
    flown("V2_02_medium", 10.0, 17),
];

/// Those whose paths are in the folder of recordings; invented ones in any case.
pub fn sets(folder: &Path, fitted: bool) -> Result<Vec<Set>, Fault> {
    let flights = if fitted { &FITTED } else { &REPORTED };
    flights.iter().filter_map(|f| f.set(folder).transpose()).collect()
}

impl Flown {
    fn set(&self, folder: &Path) -> Result<Option<Set>, Fault> {
        let recorded = folder.join("euroc_text").join(self.path).join("state_groundtruth_estimate0.csv");
        let mut scenario = match Scenario::named(self.path) {
            Some(scenario) => scenario,
            None if !recorded.is_file() => {
                eprintln!("no {}: {} is not flown", recorded.display(), self.path);
                return Ok(None);
            }
            None => Scenario::from_euroc(&recorded, None)?,
        };
        inputs::cut(&mut scenario, self.from_s, SECONDS);
        scenario.seed = self.seed;
        scenario.name = format!("{}, seed {}", self.path, self.seed);
        let frames = (scenario.duration.secs().min(SECONDS) * scenario.rate_hz) as usize;
        sets::simulated(scenario, frames / FRAMES, FRAMES).map(Some)
    }
}
