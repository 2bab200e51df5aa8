//! Simulated flights that methods are judged on.
//!
//! The factors of the methods' deviations were fitted to other flights: seeds 1 to 3, which furnish other rooms, and other halves
//! of these paths. Invented flights stay in a room of 8 m; MH_04's room is up to 20 m deep, the only one with depths beyond
//! 8 m. The frames that see most within a metre are added, since evenly chosen ones see next to nothing there.

use super::sets::{self, Set};
use crate::inputs;
use std::path::Path;
use stipple_drivers::sim::{self, Scenario};
use stipple_drivers::Fault;

/// Frames of a flight: evenly chosen ones, and those nearest to something; as many as a software rasteriser matches in minutes.
const EVEN: usize = 3;
const NEAR: usize = 1;
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

const FLIGHTS: [Flown; 8] = [
    flown("circle", 0.0, 51),
    flown("hover", 2.0, 52),
    flown("aggressive", 6.0, 53),
    flown("aggressive", 6.0, 54),
    flown("MH_04_difficult", 56.0, 55),
    flown("MH_04_difficult", 56.0, 56),
    flown("V1_02_medium", 8.0, 57),
    flown("V2_02_medium", 10.0, 58),
];

/// Flights whose paths are in the folder of recordings; invented ones in any case.
pub fn sets(folder: &Path) -> Result<Vec<Set>, Fault> {
    FLIGHTS.iter().filter_map(|f| f.set(folder).transpose()).collect()
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
        sets::simulated(scenario, frames, EVEN, NEAR).map(Some)
    }
}
