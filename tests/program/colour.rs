//! Colour from file to map: a flight written as RGB images is read back, mapped, and shown in its colours.

use crate::start;
use std::path::Path;
use std::time::Instant;
use stipple::config::Board;
use stipple::map::{Keyframe, Mapper, Panel, StepKind};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{write_euroc, Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Frames, Span};

const BOARD: &str = "name = \"test\"\nmemory_max_mib = 2048\n[budget]\nsplats = 20000\nintersections = 400000\n\
                     keyframes = 16\nimage_width_max = 1024\nimage_height_max = 1024\n";

fn board(overrides: &[&str]) -> Board {
    Board::parse("tests/program/colour.rs", BOARD, &overrides.iter().map(|s| s.to_string()).collect::<Vec<_>>())
        .unwrap()
}

/// Frames, 2.5 a second, of the demo after its start at rest, at 188 x 120 px.
fn written(dir: &Path) {
    let mut scenario = Scenario::named("demo").unwrap();
    (scenario.image_divisor, scenario.rate_hz, scenario.duration) = (4, 2.5, Span::from_secs(3.6));
    write_euroc(&mut Sim::new(&scenario).unwrap(), dir, scenario.calibration.cameras.len(), |_, _| {}).unwrap();
}

/// PSNR of each channel of a rendering against each of what was seen.
fn psnr_db(p: &Panel, rendered: usize, observed: usize) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    for i in (0..p.valid.len()).filter(|&i| p.valid[i] != 0) {
        let e =
            f64::from(p.rendered[3 * i + rendered].clamp(0.0, 1.0)) - f64::from(p.observed[3 * i + observed]) / 255.0;
        sum += e * e;
        n += 1;
    }
    -10.0 * (sum / f64::from(n)).log10()
}

fn train(mapper: &mut Mapper, steps: usize) {
    for _ in 0..steps {
        assert_ne!(mapper.step(Instant::now()).unwrap().kind, StepKind::Idle);
    }
}

#[test]
fn a_colour_recording_becomes_a_map_in_its_colours() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("flight");
    written(&path);
    let recording = Recording::open(&path, &OpenOptions::default()).unwrap();
    let board = board(&["map.colour=true"]);
    let mut mapper = Mapper::open(&recording.calibration, &board).unwrap();
    let mut frames = Frames::in_colour(&recording.calibration, 1);
    let mut reader = recording.reader();
    assert!(reader.has_colour(2));
    for (i, frame) in recording.frames.iter().enumerate() {
        reader.read(i, &mut frames).unwrap();
        let world_from_body = pose_at(&recording.truth, frame.t, Span(50_000_000)).unwrap();
        let Frames { images, colours, .. } = frames.clone();
        let held_out = i % 4 == 3;
        let keyframe =
            Keyframe { id: i as u64, t: frame.t, world_from_body, images, colours, held_out, ..Keyframe::default() };
        mapper.ingest(&keyframe).unwrap();
        train(&mut mapper, 40);
    }
    // The last view has had little more than its burst.
    train(&mut mapper, 80);
    let q = mapper.evaluate().unwrap();
    println!("{q:?}");
    assert!(mapper.counters().splats_densified.get() > 100);
    for p in mapper.panels(3).unwrap() {
        let own: Vec<f64> = (0..3).map(|c| psnr_db(&p, c, c)).collect();
        let swapped: Vec<f64> = (0..3).map(|c| psnr_db(&p, c, (c + 1) % 3)).collect();
        println!("{}: {own:.1?} dB, swapped {swapped:.1?}", p.name);
        assert!(own.iter().all(|db| *db > 21.0), "{}: {own:?}", p.name);
        // 3 dB: the squared error to another channel is at least twice that to its own.
        assert!(own.iter().zip(&swapped).all(|(own, swapped)| own - swapped > 3.0), "{}: {own:?}, {swapped:?}", p.name);
    }
    let splats = mapper.splats().unwrap();
    assert!(splats.iter().filter(|s| (s.colour[0] - s.colour[2]).abs() > 0.05).count() * 2 > splats.len());
}

/// The whole program on it: map, renders and report; and what it says of grey images.
#[test]
fn the_program_replays_colour_and_refuses_grey_where_colour_is_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let stipple = |args: &[&str]| {
        let board = dir.path().join("board.toml");
        std::fs::write(&board, BOARD).unwrap();
        let (flight, out) = (dir.path().join("flight"), dir.path().join("out"));
        let truth = flight.join("mav0/state_groundtruth_estimate0/data.csv");
        let mut c = start::stipple();
        c.args(["replay", "--pace", "lockstep", "--set", "map.colour=true"]).args(args);
        c.arg("--board").arg(board).arg("--out").arg(out).arg("--poses").arg(truth).arg(flight).output().unwrap()
    };
    written(&dir.path().join("flight"));
    let o = stipple(&[]);
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let ply = std::fs::read(dir.path().join("out/map.ply")).unwrap();
    let header = String::from_utf8_lossy(&ply[..600]).into_owned();
    let count: usize = header.lines().find_map(|l| l.strip_prefix("element vertex ")?.parse().ok()).unwrap();
    let begin = header.find("end_header\n").unwrap() + "end_header\n".len();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let red = names.iter().position(|n| *n == "f_dc_0").unwrap();
    let coloured = (0..count).filter(|i| {
        let at = |k: usize| begin + 4 * (i * names.len() + red + k);
        let of = |k: usize| f32::from_le_bytes(ply[at(k)..at(k) + 4].try_into().unwrap());
        (of(0) - of(2)).abs() > 0.1
    });
    assert!(coloured.count() * 2 > count, "less than half of {count} Gaussians are coloured");

    std::fs::remove_dir_all(dir.path().join("flight")).unwrap();
    let sim = start::stipple()
        .args(["sim", "demo", "--duration", "1", "--out"])
        .arg(dir.path().join("flight"))
        .output()
        .unwrap();
    assert!(sim.status.success());
    let o = stipple(&[]);
    let said = String::from_utf8_lossy(&o.stderr).into_owned();
    assert_eq!(o.status.code(), Some(78), "{said}");
    assert!(said.contains("map.colour") && said.contains("grey") && said.trim().lines().count() == 1, "{said}");
}
