//! Simulated flights that methods are judged on: the ones that deviations were fitted to, and others to report.
//!
//! Every flight has a room of its own, furnished by its seed, and no path is in both lists, though halves of one are: fitted
//! to the first half of `aggressive` and reported on the second, and so with recorded ones. Invented flights stay in a room of 8 m; MH_04's room is up to 20 m deep, the only one with depths beyond 8 m.
//! Of each the frames that see most within a metre are added, of which evenly chosen ones see next to nothing.

use super::sets::{self, Set};
use crate::inputs;
use std::path::Path;
use stipple_drivers::sim::{self, Scenario};
use stipple_drivers::Fault;

/// Frames of a flight: evenly chosen, and those nearest to something.
#[derive(Clone, Copy)]
pub struct Frames {
    pub even: usize,
    pub near: usize,
}

/// Flown from `from_s` on, s: of a recorded path, and of an invented one.
const SECONDS: f64 = 40.0;
const INVENTED_SECONDS: f64 = 6.0;

struct Flown {
    /// A scenario of the simulator or a recorded path, and where in it to begin, s.
    path: &'static str,
    from_s: f64,
    seed: u64,
}

const fn flown(path: &'static str, from_s: f64, seed: u64) -> Flown {
    Flown { path, from_s, seed }
}

const FITTED: [Flown; 9] = [
    flown("demo", 0.0, 1),
    flown("demo", 4.0, 2),
    flown("aggressive", 0.0, 1),
    flown("aggressive", 0.0, 2),
    flown("aggressive", 0.0, 3),
    flown("MH_04_difficult", 16.0, 1),
    flown("MH_04_difficult", 16.0, 2),
    flown("V1_02_medium", 48.0, 1),
    flown("V2_02_medium", 60.0, 1),
];
const REPORTED: [Flown; 8] = [
    flown("circle", 0.0, 51),
    flown("hover", 2.0, 52),
    flown("aggressive", 6.0, 53),
    flown("aggressive", 6.0, 54),
    flown("MH_04_difficult", 56.0, 55),
    flown("MH_04_difficult", 56.0, 56),
    flown("V1_02_medium", 8.0, 57),
    flown("V2_02_medium", 10.0, 58),
];

/// Those whose paths are in the folder of recordings; invented ones in any case.
pub fn sets(folder: &Path, fitted: bool, frames: Frames) -> Result<Vec<Set>, Fault> {
    let flights: &[Flown] = if fitted { &FITTED } else { &REPORTED };
    flights.iter().filter_map(|f| f.set(folder, frames).transpose()).collect()
}

impl Flown {
    fn set(&self, folder: &Path, count: Frames) -> Result<Option<Set>, Fault> {
        let recorded = folder.join("euroc_text").join(self.path).join("state_groundtruth_estimate0.csv");
        let mut scenario = match Scenario::named(self.path) {
            Some(scenario) => scenario,
            None if !recorded.is_file() => {
                eprintln!("no {}: {} is not flown", recorded.display(), self.path);
                return Ok(None);
            }
            None => Scenario::from_euroc(&recorded, None)?,
        };
        let span = match scenario.path {
            sim::Flight::Recorded(_) => {
                inputs::cut(&mut scenario, self.from_s, SECONDS);
                0.0..SECONDS
            }
            _ => self.from_s..self.from_s + INVENTED_SECONDS,
        };
        scenario.seed = self.seed;
        scenario.name = format!("{}, seed {}", self.path, self.seed);
        let frame = |t: f64| (t * scenario.rate_hz) as usize;
        let frames = frame(span.start)..frame(span.end.min(scenario.duration.secs()));
        sets::simulated(scenario, frames, count.even, count.near).map(Some)
    }
}
