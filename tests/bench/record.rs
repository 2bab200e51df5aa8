//! `stipple-bench record`: what recording takes from odometry. One flight in real time, from memory, with a recorder and
//! without in turns, in one process, so that the machine is the same for both.

use crate::page::{count, number, text, Page, Part, Table};
use crate::run::default_board;
use crate::table;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use stipple::config::Board;
use stipple::output::metrics::percentile;
use stipple::output::OutputDir;
use stipple::run::recorder::Recording;
use stipple::run::sensors::{Input, Playback, Recorded, Source};
use stipple::run::status::Status;
use stipple::run::tracking::{OdometryRun, Tracker};
use stipple::run::{fly_in_real_time, memory, Realtime, Steering};
use stipple_drivers::paced::Images;
use stipple_drivers::record::Format;
use stipple_drivers::sim::Scenario;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Span};

/// Length of the simulated flight, s.
const FLIGHT_S: f64 = 8.0;

/// One pass over the flight.
struct Pass {
    records: bool,
    tracked: usize,
    overwritten: u64,
    /// Time from taking a frame to its pose, ms.
    ms_p50: f64,
    ms_p99: f64,
    recorded: Vec<(&'static str, u64)>,
}

/// A flight with every image decoded before, as a camera has it.
struct Flight {
    name: String,
    calibration: Calibration,
    frames: Vec<Frames>,
    imu: Vec<ImuSample>,
}

impl Flight {
    fn of(input: Input) -> Flight {
        let (calibration, name) = (input.calibration, input.name);
        let Source::Recorded(Recorded { mut images, stamps, imu, .. }) = input.source else {
            unreachable!("a recording, or a rendered flight")
        };
        let read = |i: usize| {
            let mut frames = Frames::for_rig(&calibration);
            images.read(i, &mut frames).is_ok().then_some(frames)
        };
        let frames = (0..stamps.len()).filter_map(read).collect();
        Flight { name, calibration, frames, imu }
    }

    fn length_s(&self) -> f64 {
        match (self.frames.first(), self.frames.last()) {
            (Some(a), Some(b)) => (b.t - a.t).secs(),
            _ => 0.0,
        }
    }

    fn fly(&self, board: &Board, into: Option<&Path>) -> Result<Pass, Fault> {
        let recorded = Recorded {
            images: Images::Rendered(self.frames.clone()),
            stamps: self.frames.iter().map(|f| f.t).collect(),
            imu: self.imu.clone(),
            aids: vec![],
        };
        let shape = Frames::for_rig(&self.calibration);
        let into = into.map(|dir| (dir, Format::Euroc));
        let (sensors, recording) =
            Recording::start(into, recorded.paced(Playback::default()), &self.calibration, board, &shape)?;
        let tracker = Tracker::Odometry(Box::new(OdometryRun::new(&self.calibration, board, self.frames.len())?));
        let options = Realtime { holdout: 0, until_s: None, sensors_s: None, stop: &AtomicBool::new(false) };
        let flown = fly_in_real_time(
            sensors,
            &self.calibration,
            tracker,
            (None, None),
            &options,
            &mut Status::silent(),
            &mut Steering::default(),
        );
        let run = flown.tracker.odometry().expect("flown by odometry");
        let ms: Vec<f64> = run.back.frame_ms.iter().map(|(_, ms)| *ms).collect();
        let mut recorded = vec![];
        // What it lacks is among the counters.
        recording.map(|r| r.finish(&mut recorded));
        Ok(Pass {
            records: into.is_some(),
            tracked: ms.len(),
            overwritten: flown.counters.frames_overwritten.get(),
            ms_p50: percentile(&ms, 0.5).unwrap_or(f64::NAN),
            ms_p99: percentile(&ms, 0.99).unwrap_or(f64::NAN),
            recorded,
        })
    }
}

/// Odometry's time a frame with recording and without, in turns in real time, and what the recorder keeps up with
#[derive(clap::Args)]
pub struct Args {
    /// Recording, as for replay; without it a simulated flight at 752x480
    dataset: Option<PathBuf>,
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Passes with a recorder, and as many without
    #[arg(long, value_name = "N", default_value = "3", value_parser = clap::value_parser!(u64).range(1..=100))]
    passes: u64,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let (out, passes) = (OutputDir::create(&args.out)?, args.passes);
    let board = default_board(&["map.enabled=false".to_string()])?;
    let input = match &args.dataset {
        Some(path) => Input::recording(path, None, &board)?,
        None => {
            let mut scenario = Scenario::named("demo").expect("the demo's scenario is compiled in");
            (scenario.image_divisor, scenario.duration) = (1, Span::from_secs(FLIGHT_S));
            Input::rendered(&scenario, 0, |_, _| {})?
        }
    };
    memory::check_fits(&input.name, &input.calibration, &board, true)?;
    let flight = Flight::of(input);
    let mut list = vec![];
    for pass in 0..2 * passes {
        let dir = out.file(&format!("recording-{pass}"));
        let records = pass % 2 == 1;
        list.push(flight.fly(&board, records.then_some(dir.as_path()))?);
        eprintln!("pass {} of {}", pass + 1, 2 * passes);
        // It was measured, not wanted.
        let _ = std::fs::remove_dir_all(&dir);
    }
    let c = &flight.calibration.cameras[0].camera;
    let (n, s) = (flight.frames.len(), flight.length_s());
    let page = Page {
        name: "record",
        title: "Recording beside odometry",
        what: format!(
            "{}: {} cameras of {}x{} at {:.1} Hz, {:.0} inertial samples a second, ring of {} frames",
            flight.name,
            flight.calibration.cameras.len(),
            c.width,
            c.height,
            (n.max(2) - 1) as f64 / s,
            flight.imu.len() as f64 / s,
            board.record.ring_frames,
        ),
        facts: vec![],
        parts: vec![Part::Note(ratio(&list)), Part::Table(table(&list))],
    };
    println!("{}\n\n{}\n", page.what, ratio(&list));
    page.finish(&out)
}

fn table(list: &[Pass]) -> Table {
    fn recorded(p: &Pass, name: &str) -> Option<u64> {
        p.recorded.iter().find(|(n, _)| *n == name).map(|(_, v)| *v)
    }
    let written = |p: &Pass| recorded(p, "record_frames_written");
    let cpu = |p: &Pass| recorded(p, "record_cpu_us").zip(written(p)).map(|(us, n)| us as f64 * 1e-3 / n.max(1) as f64);
    table!("record", "Passes", list, |p| false, [
        text("recording") => if p.records { "on" } else { "off" },
        count("tracked") => p.tracked,
        count("overwritten") => p.overwritten,
        number("a frame", "ms", 2) => p.ms_p50,
        number("a frame 99 %", "ms", 2) => p.ms_p99,
        count("written") => written(p),
        count("dropped") => recorded(p, "record_frames_dropped"),
        count("ring at most") => recorded(p, "record_ring_most"),
        number("writer CPU a frame", "ms", 1) => cpu(p),
    ])
}

fn ratio(list: &[Pass]) -> String {
    let median = |records: bool, of: fn(&Pass) -> f64| {
        let values: Vec<f64> = list.iter().filter(|p| p.records == records).map(of).collect();
        percentile(&values, 0.5).unwrap_or(f64::NAN)
    };
    let ratio = |of: fn(&Pass) -> f64| median(true, of) / median(false, of);
    format!(
        "odometry's time a frame with recording over that without, medians of the passes: {:.2} (median), {:.2} (99 %)",
        ratio(|p| p.ms_p50),
        ratio(|p| p.ms_p99)
    )
}
