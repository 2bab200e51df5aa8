//! `stipple-bench record`: what recording takes from odometry. One flight in real time, from memory, with a recorder and
//! without in turns, in one process, so that the machine is the same for both.

use crate::run::default_board;
use serde_json::{json, Value};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use stipple::config::Board;
use stipple::output::metrics::percentile;
use stipple::output::OutputDir;
use stipple::run::recorder::Recording;
use stipple::run::sensors::{Input, Recorded, Source};
use stipple::run::status::Status;
use stipple::run::tracking::{OdometryRun, Tracker};
use stipple::run::{fly_in_real_time, memory, Realtime};
use stipple_drivers::paced::Images;
use stipple_drivers::sim::Scenario;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Span};

/// Of the simulated flight, s.
const FLIGHT_S: f64 = 8.0;

/// One pass over the flight.
struct Pass {
    records: bool,
    tracked: usize,
    overwritten: u64,
    /// From taking a frame to its pose, ms.
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
        let Source::Recorded(Recorded { mut images, stamps, imu }) = input.source else {
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
        };
        let shape = Frames::for_rig(&self.calibration);
        let (sensors, recording) = Recording::start(into, recorded.paced(), &self.calibration, board, &shape)?;
        let tracker = Tracker::Odometry(Box::new(OdometryRun::new(&self.calibration, board, self.frames.len())?));
        let options = Realtime { holdout: 0, until_s: None, sensors_s: None, stop: &AtomicBool::new(false) };
        let flown = fly_in_real_time(sensors, &self.calibration, tracker, None, &options, &mut Status::silent());
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
    /// As for replay; without it a simulated flight at 752x480
    dataset: Option<PathBuf>,
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Of each kind
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
    let table = table(&flight, &board, &list);
    println!("{table}");
    out.write("record.md", |w| writeln!(w, "{table}"))?;
    let rows: Vec<Value> = list.iter().map(json_row).collect();
    out.write("record.json", |w| {
        serde_json::to_writer_pretty(&mut *w, &rows)?;
        writeln!(w)
    })
}

fn json_row(p: &Pass) -> Value {
    let recorded: serde_json::Map<_, _> = p.recorded.iter().map(|(n, v)| (n.to_string(), json!(v))).collect();
    json!({
        "records": p.records,
        "frames_tracked": p.tracked,
        "frames_overwritten": p.overwritten,
        "ms_p50": p.ms_p50,
        "ms_p99": p.ms_p99,
        "recorded": recorded,
    })
}

fn table(flight: &Flight, board: &Board, list: &[Pass]) -> String {
    let c = &flight.calibration.cameras[0].camera;
    let (n, s) = (flight.frames.len(), flight.length_s());
    let mut text = format!(
        "{}: {} cameras of {}x{} at {:.1} Hz, {:.0} inertial samples a second, ring of {} frames\n\n\
         | recording | tracked | overwritten | a frame, median; 99 % ms | written | dropped | ring at most | writer, ms of CPU a frame |\n\
         |---|---|---|---|---|---|---|---|\n",
        flight.name,
        flight.calibration.cameras.len(),
        c.width,
        c.height,
        (n.max(2) - 1) as f64 / s,
        flight.imu.len() as f64 / s,
        board.record.ring_frames,
    );
    for p in list {
        let count = |name: &str| p.recorded.iter().find(|(n, _)| *n == name).map(|(_, v)| *v);
        let or_dash = |v: Option<u64>| v.map_or("-".into(), |v| v.to_string());
        let written = count("record_frames_written");
        let cpu = count("record_cpu_us").zip(written).map(|(us, n)| us as f64 * 1e-3 / n.max(1) as f64);
        let _ = writeln!(
            text,
            "| {} | {} | {} | {:.2}; {:.2} | {} | {} | {} | {} |",
            if p.records { "on" } else { "off" },
            p.tracked,
            p.overwritten,
            p.ms_p50,
            p.ms_p99,
            or_dash(written),
            or_dash(count("record_frames_dropped")),
            or_dash(count("record_ring_most")),
            cpu.map_or("-".into(), |ms| format!("{ms:.1}")),
        );
    }
    let median = |records: bool, of: fn(&Pass) -> f64| {
        let values: Vec<f64> = list.iter().filter(|p| p.records == records).map(of).collect();
        percentile(&values, 0.5).unwrap_or(f64::NAN)
    };
    let ratio = |of: fn(&Pass) -> f64| median(true, of) / median(false, of);
    let _ = write!(
        text,
        "\nodometry's time a frame with recording over that without, medians of the passes: {:.2} (median), {:.2} (99 %)",
        ratio(|p| p.ms_p50),
        ratio(|p| p.ms_p99)
    );
    text
}
