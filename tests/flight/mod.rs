//! A board, a simulated flight as keyframes, and training step by step, for the tests of the mapper.
#![allow(clippy::unwrap_used)]

use std::time::Instant;
use stipple::config::Board;
use stipple::map::{Keyframe, Mapper, StepKind};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Calibration, Frames};

pub fn board(overrides: &[&str]) -> Board {
    let text = "name = \"test\"\nmemory_max_mib = 2048\n[budget]\nsplats = 20000\nintersections = 400000\n\
                keyframes = 16\nimage_width_max = 1024\nimage_height_max = 1024\n";
    let overrides: Vec<String> = overrides.iter().map(|s| s.to_string()).collect();
    Board::parse("tests/flight/mod.rs", text, &overrides).unwrap()
}

/// `count` keyframes of a simulated flight, half a second apart, at 188 x 120 px; every fourth is held out.
pub fn flight(count: usize) -> (Calibration, Vec<Keyframe>) {
    let mut scenario = Scenario::named("demo").unwrap();
    scenario.image_divisor = 4;
    let mut sim = Sim::new(&scenario).unwrap();
    let calibration = sim.calibration().clone();
    let mut frames = Frames::for_rig(&calibration);
    let apart = (scenario.rate_hz / 2.0) as usize;
    let mut keyframe = |k: usize| {
        sim.render(k * apart, &mut frames);
        let images = frames.images.clone();
        let world_from_body = sim.truth_at(frames.t).pose;
        let held_out = k % 4 == 3;
        Keyframe { id: k as u64, t: frames.t, world_from_body, images, held_out, ..Keyframe::default() }
    };
    let keyframes = (0..count).map(&mut keyframe).collect();
    (calibration, keyframes)
}

/// One thing at a time until `steps` training steps are taken.
pub fn train(mapper: &mut Mapper, steps: u32) {
    let mut taken = 0;
    while taken < steps {
        let report = mapper.step(Instant::now()).unwrap();
        assert!(report.iterations <= 1);
        if report.kind == StepKind::Idle {
            break;
        }
        taken += report.iterations;
    }
}
