//! Places of an earlier flight, damaged where the checksums of the store do not tell: a list of four bytes each, which record,
//! where in it and with what. They are read, and a vehicle that looks for itself among them finds no pose that is not finite.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;
use std::sync::{Arc, LazyLock};
use stipple::config::FrontendConfig;
use stipple::loops::kept::{self, Keeper};
use stipple::loops::{LoopKeyframe, Loops};
use stipple::store::{About, Key, Limits, Reader, Store};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Frames, Pose, Span};
use tempfile::TempDir;

const LIMITS: Limits = Limits {
    bytes_max: 8 << 20,
    segment_bytes: 1 << 20,
    records_max: 64,
    payload_max: 1 << 16,
    buffers: 4,
    write_bytes_per_s: 0,
};
/// Keyframes of the graph.
const KEYFRAMES: usize = 64;
/// Frames between two keyframes.
const STEP: usize = 5;

type Record = (Key, About, Vec<u8>);

/// Keyframes of a second and a half of flight, and the store that they leave.
struct Flown {
    scenario: Scenario,
    keyframes: Vec<(Arc<Frames>, Pose)>,
    identity: u64,
    records: Vec<Record>,
}

fn scratch() -> TempDir {
    tempfile::tempdir().expect("the scratch folder can be written to")
}

fn loops(scenario: &Scenario) -> Loops {
    Loops::new(&scenario.rig(), &FrontendConfig::default(), KEYFRAMES).expect("the rig sees depth")
}

fn add_all(loops: &mut Loops, keyframes: &[(Arc<Frames>, Pose)], epoch: u32) {
    for (frames, odom_from_body) in keyframes {
        let (t, odom_from_body) = (frames.t, *odom_from_body);
        loops.add(&LoopKeyframe { t, frames, id: None, epoch, odom_from_body, window: &[], body_from_cam: None });
    }
}

fn records(folder: &Path) -> (u64, Vec<Record>) {
    let mut reader = Reader::open(folder).expect("it was written");
    let mut keys = vec![];
    reader.entries(|key, _| keys.push(*key));
    let mut read = |key| {
        let mut payload = vec![];
        let about = reader.read(key, &mut payload).expect("it is whole");
        (key, about, payload)
    };
    let records = keys.into_iter().map(&mut read).collect();
    (reader.identity(), records)
}

static FLOWN: LazyLock<Flown> = LazyLock::new(|| {
    let duration = Span::from_secs(2.5);
    let scenario = Scenario { duration, ..Scenario::named("patrol-two").expect("it is there") };
    let mut sim = Sim::new(&scenario).expect("it can be flown");
    let keyframes: Vec<_> = (STEP..sim.frame_count())
        .step_by(STEP)
        .map(|i| {
            let mut frames = Frames::for_rig(sim.calibration());
            sim.render(i, &mut frames);
            (Arc::new(frames), sim.truth_at(sim.taken(i)).pose)
        })
        .collect();
    let dir = scratch();
    let mut loops = loops(&scenario);
    let keeper = Keeper::new(dir.path(), &scenario.rig(), KEYFRAMES).expect("there is room");
    loops.remember(1, &[], Some(keeper));
    add_all(&mut loops, &keyframes, 0);
    drop(loops);
    let (identity, records) = records(dir.path());
    Flown { scenario, keyframes, identity, records }
});

fuzz_target!(|data: &[u8]| {
    let Flown { scenario, keyframes, identity, records } = &*FLOWN;
    let mut records = records.clone();
    for damage in data.chunks_exact(4).take(32) {
        let n = usize::from(damage[0]) % records.len();
        let (_, about, payload) = &mut records[n];
        let at = usize::from(u16::from_le_bytes([damage[1], damage[2]])) % (about.len() + payload.len());
        *about.iter_mut().chain(payload).nth(at).expect("it is inside") = damage[3];
    }
    let dir = scratch();
    let (mut store, disk) = Store::open(dir.path(), *identity, &LIMITS).expect("it can be made");
    for (key, about, payload) in &records {
        assert!(store.put(*key, about, |to| to.extend_from_slice(payload)));
        disk.serve();
    }
    store.flush().expect("it can be written");
    drop((store, disk));
    let places = kept::read(dir.path(), &scenario.rig()).expect("it is of this rig").places;
    let mut loops = loops(scenario);
    loops.remember(2, &places, None);
    add_all(&mut loops, &keyframes[..3.min(keyframes.len())], 0);
    let placed = loops.map_from_odom();
    assert!(placed.pose.is_finite() && placed.covariance.as_flattened().iter().all(|c| c.is_finite()), "{placed:?}");
    assert!(loops.places().all(|(_, pose)| pose.is_finite()));
});
