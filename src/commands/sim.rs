//! `stipple sim`: a simulated flight as an EuRoC folder with ground truth.

use super::{rendering_progress, seconds};
use std::path::PathBuf;
use stipple_drivers::sim::{rig_named, write_euroc, Scenario, Sim, RIGS};
use stipple_drivers::{Fault, FaultKind, Span};

#[derive(clap::Args)]
pub struct Args {
    /// demo, hover, circle, aggressive, static or pauses; patrol-two or patrol, through a building; twins or doors, past
    /// places that look the same; or `euroc`, to fly the trajectory of --truth
    scenario: String,
    /// Folder to write
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// EuRoC ground-truth csv to fly along
    #[arg(long, value_name = "CSV")]
    truth: Option<PathBuf>,
    /// EuRoC IMU csv to use in place of a simulated IMU
    #[arg(long, value_name = "CSV", requires = "truth")]
    imu: Option<PathBuf>,
    /// Seconds of the flight to write; without it all of it, some 10, of patrol 600
    #[arg(long, value_name = "S", value_parser = seconds)]
    duration: Option<f64>,
    /// Seed of the room and of the sensors' noise; without it the scenario's own
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Cameras: mono, stereo, opposed or four; without it stereo
    #[arg(long, value_name = "NAME")]
    rig: Option<String>,
    /// Let a box of a person's size move through the room: it crosses the view, follows the rig, and fills half of the view
    #[arg(long)]
    person: bool,
    /// Write images as RGB; grey otherwise
    #[arg(long)]
    colour: bool,
    #[command(flatten)]
    defects: Defects,
}

/// Defects of the simulated sensors, which the calibration does not state.
#[derive(Clone, Debug, Default, clap::Args)]
struct Defects {
    /// Clock of the inertial unit ahead of that of the images, s
    #[arg(long, value_name = "S", allow_negative_numbers = true, default_value_t = 0.0)]
    time_offset: f64,
    /// Rolling shutter: time from the first row to the last, s
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    readout: f64,
    /// Fraction by which the inertial unit reads too little on every axis
    #[arg(long, value_name = "FRACTION", allow_negative_numbers = true, default_value_t = 0.0)]
    imu_scale: f64,
    /// Fraction of the light that flickers
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    flicker: f64,
    /// Frequency of the flicker, Hz
    #[arg(long, value_name = "HZ", default_value_t = 100.0)]
    flicker_hz: f64,
}

impl Defects {
    fn apply(&self, scenario: &mut Scenario) -> Result<(), Fault> {
        let within = [
            ("--time-offset", self.time_offset, -1.0..=1.0),
            ("--readout", self.readout, 0.0..=0.1),
            ("--imu-scale", self.imu_scale, -0.5..=0.5),
            ("--flicker", self.flicker, 0.0..=1.0),
            ("--flicker-hz", self.flicker_hz, 0.0..=1e4),
        ];
        for (name, value, range) in within {
            if !range.contains(&value) {
                let what = format!("is {value}, must be {} to {}", range.start(), range.end());
                return Err(Fault::new(FaultKind::Usage, name, what, "choose a value in that range"));
            }
        }
        scenario.camera_errors.time_offset = Span::from_secs(self.time_offset);
        scenario.calibration.cameras.iter_mut().for_each(|c| c.readout = Span::from_secs(self.readout));
        let axes = &mut scenario.imu_errors.axes;
        axes.gyro_scale *= 1.0 + self.imu_scale;
        axes.accel_scale *= 1.0 + self.imu_scale;
        (scenario.light.flicker, scenario.light.flicker_hz) = (self.flicker, self.flicker_hz);
        Ok(())
    }
}

pub fn sim(args: &Args) -> Result<(), Fault> {
    let mut scenario = match (&args.truth, args.scenario.as_str()) {
        (Some(truth), "euroc") => Scenario::from_euroc(truth, args.imu.as_deref())?,
        (None, "euroc") => {
            return Err(Fault::new(FaultKind::Usage, "euroc", "needs the path to fly", "add --truth CSV"));
        }
        (None, name) => Scenario::named(name).ok_or_else(|| unknown_scenario(name))?,
        (Some(_), name) => {
            let fix = "use the scenario `euroc` with --truth";
            return Err(Fault::new(FaultKind::Usage, name, "does not fly a given trajectory", fix));
        }
    };
    if let Some(s) = args.duration {
        scenario.duration = scenario.duration.min(Span::from_secs(s));
    }
    if let Some(seed) = args.seed {
        scenario.seed = seed;
    }
    if let Some(name) = &args.rig {
        let known = || Fault::new(FaultKind::Usage, name, "is not a rig", format!("choose one of {}", RIGS.join(", ")));
        scenario.calibration = rig_named(name).ok_or_else(known)?;
    }
    scenario.person = args.person;
    args.defects.apply(&mut scenario)?;
    let mut sim = Sim::new(&scenario)?;
    let colours = if args.colour { sim.calibration().cameras.len() } else { 0 };
    write_euroc(&mut sim, &args.out, colours, rendering_progress)?;
    crate::run::status::print_out(args.out.display());
    Ok(())
}

fn unknown_scenario(name: &str) -> Fault {
    let known = Scenario::names().collect::<Vec<_>>().join(", ");
    Fault::new(FaultKind::Usage, name, "is not a scenario", format!("choose one of {known}, or `euroc` with --truth"))
}
