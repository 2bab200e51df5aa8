//! What a sweep flies: simulated flights by name, a recording, and simulated cameras along
//! recorded flights, each with a simulated and with its real inertial unit.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{self, rig_named, Scenario, Sim};
use stipple_drivers::{Calibration, Fault, FaultKind, Frames, ImuSample, Span, TimedPose};

/// Name, scenario and rig: two cameras, or one, whose window says less and needs more iterations.
const NAMED: [(&str, &str, Option<&str>); 5] = [
    ("demo", "demo", None),
    ("aggressive", "aggressive", None),
    ("demo, one camera", "demo", Some("mono")),
    ("hover", "hover", None),
    ("pauses", "pauses", None),
];
pub const RECORDING: &str = "euroc_MH_01_easy_11s";
/// Recorded flights and where in them to begin, s: at rest, just before taking off.
const RECORDED: [(&str, f64); 3] = [("MH_04_difficult", 16.0), ("V1_02_medium", 1.0), ("V2_02_medium", 0.0)];
const RECORDED_FOLDER: &str = "euroc_text";
/// Path kept past the end of what is flown, s: the fit of a path is loose at its end.
const PATH_MARGIN: f64 = 1.0;

pub struct Input {
    pub name: String,
    /// For the reader of the tables.
    pub about: String,
    source: Source,
}

enum Source {
    Named { scenario: &'static str, rig: Option<&'static str> },
    Recording(PathBuf),
    Recorded { truth: PathBuf, imu: Option<PathBuf>, start_s: f64 },
}

/// An input in memory.
pub struct Flight {
    pub calibration: Calibration,
    pub imu: Vec<ImuSample>,
    pub frames: Vec<Arc<Frames>>,
    pub truth: Vec<TimedPose>,
}

fn named((name, scenario, rig): (&str, &'static str, Option<&'static str>)) -> Input {
    let about = "simulated cameras and inertial unit".into();
    Input { name: name.into(), about, source: Source::Named { scenario, rig } }
}

pub fn quick() -> Vec<Input> {
    vec![named(NAMED[0])]
}

/// Inputs whose files are in the folder of recordings, and the simulated flights in any case.
pub fn all(folders: &Folders) -> Result<Vec<Input>, Fault> {
    let folder = folders.recordings()?;
    let mut inputs: Vec<Input> = NAMED.into_iter().map(named).collect();
    let recording = folder.join(RECORDING);
    if recording.is_dir() {
        let about = "recorded cameras and inertial unit".into();
        inputs.push(Input { name: "MH_01_easy".into(), about, source: Source::Recording(recording) });
    }
    for (name, start_s, [truth, imu]) in recorded(&folder) {
        for (unit, imu) in [("simulated", None), ("real", Some(imu))] {
            inputs.push(Input {
                name: format!("{name} {unit} IMU"),
                about: format!("simulated cameras along the recorded path from {start_s} s, {unit} inertial unit"),
                source: Source::Recorded { truth: truth.clone(), imu, start_s },
            });
        }
    }
    if inputs.len() == NAMED.len() {
        eprintln!("no recordings in {}: simulated flights only", folder.display());
    }
    Ok(inputs)
}

/// Recorded flights: name, where to begin, s, and tables of poses and of inertial samples; those whose files are there.
pub fn recorded(folder: &Path) -> impl Iterator<Item = (&'static str, f64, [PathBuf; 2])> + '_ {
    let files = |(name, start_s)| {
        let flight = folder.join(RECORDED_FOLDER).join(name);
        (name, start_s, ["state_groundtruth_estimate0.csv", "imu0.csv"].map(|file| flight.join(file)))
    };
    RECORDED.into_iter().map(files).filter(|(_, _, tables)| tables.iter().all(|t| t.is_file()))
}

/// Where a bench over recordings reads and writes.
#[derive(clap::Args)]
pub struct Folders {
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of recordings; otherwise $STIPPLE_RECORDINGS, otherwise ../shared/data
    #[arg(long, value_name = "FOLDER")]
    recordings: Option<PathBuf>,
}

impl Folders {
    /// The folder of recordings: the one named, otherwise $STIPPLE_RECORDINGS, otherwise one beside the project.
    pub fn recordings(&self) -> Result<PathBuf, Fault> {
        match &self.recordings {
            Some(folder) if folder.is_dir() => Ok(folder.clone()),
            Some(folder) => Err(Fault::new(
                FaultKind::NoInput,
                folder.display().to_string(),
                "no such folder",
                "name the folder of recordings, or leave --recordings out",
            )),
            None => Ok(std::env::var_os("STIPPLE_RECORDINGS").map_or_else(|| "../shared/data".into(), PathBuf::from)),
        }
    }
}

impl Input {
    /// The first `seconds`, rendered or decoded.
    pub fn load(&self, seconds: f64) -> Result<Flight, Fault> {
        eprintln!("loading {}: {}", self.name, self.about);
        match &self.source {
            Source::Named { scenario, rig } => {
                let mut scenario = Scenario::named(scenario).expect("NAMED are scenarios of the simulator");
                if let Some(rig) = rig {
                    scenario.calibration = rig_named(rig).expect("NAMED has rigs of the simulator");
                }
                rendered(scenario, seconds)
            }
            Source::Recording(path) => read(path, seconds),
            Source::Recorded { truth, imu, start_s } => {
                let mut scenario = Scenario::from_euroc(truth, imu.as_deref())?;
                cut(&mut scenario, *start_s, seconds + PATH_MARGIN);
                rendered(scenario, seconds)
            }
        }
    }
}

/// Leaves `seconds` of a recorded path, from `start_s` after its beginning.
pub fn cut(scenario: &mut Scenario, start_s: f64, seconds: f64) {
    let sim::Flight::Recorded(recording) = &mut scenario.path else { return };
    let Some(first) = recording.poses.first().map(|p| p.t + Span::from_secs(start_s)) else { return };
    let last = first + Span::from_secs(seconds);
    recording.poses.retain(|p| p.t >= first && p.t <= last);
    if let Some(imu) = &mut recording.imu {
        imu.retain(|s| s.t >= first && s.t <= last);
    }
}

/// The first `seconds` of a simulated flight.
pub fn rendered(mut scenario: Scenario, seconds: f64) -> Result<Flight, Fault> {
    scenario.duration = scenario.duration.min(Span::from_secs(seconds));
    let mut sim = Sim::new(&scenario)?;
    let frames = (0..sim.frame_count()).map(|i| {
        let mut frames = Frames::for_rig(sim.calibration());
        sim.render(i, &mut frames);
        Arc::new(frames)
    });
    let frames = frames.collect();
    Ok(Flight { calibration: sim.calibration().clone(), imu: sim.imu().to_vec(), frames, truth: sim.truth() })
}

/// The first `seconds` of a recording; what cannot be read is left out and said.
pub fn read(path: &Path, seconds: f64) -> Result<Flight, Fault> {
    let recording = Recording::open(path, &OpenOptions::default())?;
    let mut reader = recording.reader();
    let mut frames = Vec::new();
    for (i, frame) in recording.frames.iter().enumerate() {
        if (frame.t - recording.frames[0].t).secs() >= seconds {
            break;
        }
        let mut images = Frames::for_rig(&recording.calibration);
        match reader.read(i, &mut images) {
            Ok(()) => frames.push(Arc::new(images)),
            Err(fault) => eprintln!("left out: frame {i}: {fault:?}"),
        }
    }
    Ok(Flight { calibration: recording.calibration, imu: recording.imu, frames, truth: recording.truth })
}
