//! Stipple: live stereo-inertial odometry and a 3D Gaussian map, in fixed memory, on small GPUs.
//!
//! Sensors push time-stamped samples into bounded queues; a sans-IO estimator turns them into
//! states and keyframes; a mapper spends a fixed GPU budget on them; every byte is bought at boot
//! from a board file.
//!
//! ```text
//! frames -> mailbox(newest) -> frontend -Tracks-> vio -Keyframe(offer)-> map.step(deadline)
//! imu    -> queue -----------------------------------^                   map -> report, map.ply
//! ```
//!
//! Allowed edges, checked by `tests/tidy.rs`: `math`, `mem`, `limits`, `config` and `counters` are seen by
//! all; `frontend` and `vio` see the vocabulary of `stipple-drivers`; `vio` also sees `frontend`'s
//! `Tracks`; `stereo` and `map` see `gpu`; `map` sees `stereo`; `vio` never sees `gpu`; `map` never sees
//! `frontend`; `run` sees all of these, `commands` see `run`, and nobody sees `commands`.

// The world of points for unit tests (tests/bench/world.rs) names this crate as integration tests do.
#[cfg(test)]
extern crate self as stipple;
#[cfg(test)]
#[path = "../tests/bench/world.rs"]
pub mod world;

pub mod commands;
pub mod config;
pub mod counters;
pub mod frontend;
pub mod gpu;
pub mod limits;
pub mod map;
pub mod math;
pub mod mem;
pub mod output;
pub mod run;
pub mod stereo;
pub mod vio;
