//! Tests of the program as a whole, most of which start it as a process. They are one binary: it is built once, and cores
//! stay busy while a slow test runs.
#![allow(clippy::unwrap_used)]

mod autopilot;
mod barometer;
mod calib_noise;
mod cli;
mod colour;
mod doctor;
mod export;
mod instruments;
#[cfg(feature = "opencv")]
mod libraries;
mod live;
mod log;
mod mission;
mod output;
mod panics;
mod record;
mod recordings;
mod service;
mod small_disk;
mod start;
mod status;
#[allow(dead_code)] // each test takes of it what it needs
#[path = "../bench/world.rs"]
mod world;
