//! `stipple calib-noise`: the noise of an inertial unit from a recording of it at rest.

mod allan;
mod rest;

use allan::Figure;
use rest::{Rest, SENSORS};
use std::path::PathBuf;
use stipple_drivers::replay::read_inertial;
use stipple_drivers::{Fault, FaultKind};

#[derive(clap::Args)]
pub struct Args {
    /// Recording of the unit at rest, as `stipple record` leaves it: EuRoC ASL folder, or MCAP (its folder or one file)
    log: PathBuf,
}

/// Names and units of the two figures of each sensor in a calibration.
const KEYS: [[&str; 4]; 2] = [
    ["gyroscope_noise_density", "rad/s/√Hz", "gyroscope_random_walk", "rad/s²/√Hz"],
    ["accelerometer_noise_density", "m/s²/√Hz", "accelerometer_random_walk", "m/s³/√Hz"],
];

pub fn calib_noise(args: &Args) -> Result<(), Fault> {
    let fault = |what: String, fix: String| Err(Fault::new(FaultKind::Data, args.log.display().to_string(), what, fix));
    let mut rest = Rest::new();
    read_inertial(&args.log, |stated_hz, sample| rest.add(stated_hz, sample))?;
    if rest.samples == 0 {
        return fault("holds no sample".into(), "record again".into());
    }
    if let Some((what, fix)) = rest.wrong() {
        return fault(what, fix);
    }
    let Some(noise) = rest.noise() else {
        return fault("no noise explains it".into(), "record longer".into());
    };
    println!(
        "# {:.0} s at rest, {} samples, {:.2} Hz. Figures are root mean squares over three axes, ± one",
        rest.secs(),
        rest.samples,
        rest.rate_hz()
    );
    println!("# standard error. They replace those of imu0/sensor.yaml (EuRoC) or imu_config.yaml (Kalibr).");
    for ([white, density, walk, per_second], n) in KEYS.iter().zip(&noise) {
        println!("{white}: {:.3e}  # {density}{}", n.white.value, certainty(&n.white));
        println!("{walk}: {:.3e}  # {per_second}{}", n.walk.value, certainty(&n.walk));
    }
    println!("noise_source: measured  # at rest: leave this line out where motors shake the unit, which is not measured here");
    for ((sensor, unit), n) in SENSORS.iter().zip(&noise) {
        let Figure { value, .. } = n.instability;
        println!("# bias instability of the {sensor}: {value:.3e} {unit}{}", certainty(&n.instability));
    }
    Ok(())
}

/// How well a figure is known, behind it.
fn certainty(figure: &Figure) -> String {
    match figure.sigma {
        Some(sigma) => format!(" ± {sigma:.1e}"),
        None => format!(
            ": not determined, at most this (95 %); half of it would show in a log of {:.1} h",
            figure.needs / 3600.0
        ),
    }
}
