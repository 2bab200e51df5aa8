//! The mapper as a whole: a recording with its true poses in, a map with a measured error out.
#![allow(clippy::unwrap_used)]

use std::path::PathBuf;
use std::time::Instant;
use stipple::config::Board;
use stipple::gpu::Gpu;
use stipple::map::{Did, Keyframe, Mapper, Panel};
use stipple::output::panel::{panel, View};
use stipple::stereo::Stereo;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Frames, Span};

fn recording(name: &str) -> Option<PathBuf> {
    let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let root = std::env::var_os("STIPPLE_RECORDINGS").map_or(beside, PathBuf::from);
    let path = root.join(name);
    path.is_dir().then_some(path)
}

fn board(overrides: &[String]) -> Board {
    let text = "name = \"test\"\nmemory_max_mib = 2048\n[budget]\nsplats = 65536\nintersections = 524288\n\
                keyframes = 160\nimage_width_max = 1024\nimage_height_max = 1024\n";
    Board::parse("tests/map.rs", text, overrides).unwrap()
}

fn open(recording: &Recording, board: &Board) -> Mapper {
    let stereo = Stereo::new(&recording.calibration, &board.stereo, board.map.scale).unwrap();
    let bytes = Mapper::footprint(&recording.calibration, board).gpu_total();
    Mapper::new(Gpu::open(&board.gpu, bytes).unwrap(), stereo, board).unwrap()
}

/// Every pair with a true pose is a keyframe, every eighth held out, `steps` training steps after each.
fn play(mapper: &mut Mapper, recording: &Recording, keyframes: usize, steps: u32) {
    let mut frames = Frames::for_rig(&recording.calibration);
    let mut reader = recording.reader();
    let mut id = 0;
    for (i, pair) in recording.pairs.iter().enumerate().take(keyframes) {
        let Some(world_from_body) = pose_at(&recording.truth, pair.t, Span(50_000_000)) else { continue };
        reader.read(i, &mut frames).unwrap();
        let images = [frames.images[0].clone(), frames.images[1].clone()];
        let held_out = id % 8 == 7;
        mapper.offer(&Keyframe { id, t: pair.t, world_from_body, images, held_out });
        id += 1;
        let mut left = steps;
        while left > 0 {
            let report = mapper.step(Instant::now()).unwrap();
            match report.did {
                Did::Idle => break,
                Did::Anchor { seeded } => {
                    println!("keyframe {} is an anchor: {seeded} seeds, {:.0} ms", id - 1, report.ms)
                }
                _ => {}
            }
            left -= report.iterations.min(left);
        }
    }
}

fn write_png(dir: &std::path::Path, p: &Panel) {
    let Panel { width, height, observed, rendered, depth, valid, psnr_db, .. } = p;
    let view = View { width: *width, height: *height, observed, rendered, depth, valid, psnr_db: *psnr_db };
    let file = std::fs::File::create(dir.join(format!("{}.png", p.name))).unwrap();
    panel(&view).write_png(&mut std::io::BufWriter::new(file)).unwrap();
}

/// An experiment; settings from the environment: SET="map.x=1 ..", KEYFRAMES, STEPS, OUT.
#[test]
#[ignore = "a measurement of minutes"]
fn v1_01_quality() {
    let Some(path) = recording("euroc_V1_01_easy_keyframes") else {
        return println!("ignored: v1_01_quality: no recordings");
    };
    let env = |key: &str, default: usize| std::env::var(key).map_or(default, |v| v.parse().unwrap());
    let mut overrides = vec!["map.scale=2".to_string()];
    overrides.extend(std::env::var("SET").unwrap_or_default().split_whitespace().map(String::from));
    let recording = Recording::open(&path, &OpenOptions::default()).unwrap();
    let board = board(&overrides);
    let mut mapper = open(&recording, &board);
    println!("{}", mapper.device());
    let start = Instant::now();
    play(&mut mapper, &recording, env("KEYFRAMES", 1000), env("STEPS", 20) as u32);
    let s = start.elapsed().as_secs_f64();
    println!(
        "{} keyframes, {} anchors, {} splats, {} iterations, {s:.1} s",
        mapper.keyframe_count(),
        mapper.anchor_count(),
        mapper.splat_count(),
        mapper.iterations()
    );
    for (name, n) in mapper.counters().list() {
        if n > 0 {
            println!("  {name} {n}");
        }
    }
    for t in mapper.kernel_times() {
        println!(
            "  {:18} {:6} {:9.1} ms total {:8.3} ms each",
            t.name,
            t.count,
            t.total_ms,
            t.total_ms / t.count as f64
        );
    }
    println!("{:?}", mapper.sample(s).unwrap());
    println!("{:?}", mapper.evaluate().unwrap());
    if let Some(dir) = std::env::var_os("OUT").map(PathBuf::from) {
        std::fs::create_dir_all(&dir).unwrap();
        for p in mapper.panels(env("PANELS", 8)).unwrap() {
            write_png(&dir, &p);
            let (mut n, mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
            for i in (0..p.valid.len()).filter(|&i| p.valid[i] != 0) {
                let (x, y) = (f64::from(p.rendered[i]), f64::from(p.observed[i]) / 255.0);
                (n, sx, sy, sxx, sxy, syy) = (n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y);
            }
            let gain = (n * sxy - sx * sy) / (n * sxx - sx * sx);
            let rest = (syy - sy * sy / n) / n - gain * gain * (sxx - sx * sx / n) / n;
            println!(
                "{:14} {:6.2} dB, {:6.2} dB with gain {gain:.3}, mean {:.3} for {:.3}",
                p.name,
                p.psnr_db.unwrap(),
                -10.0 * rest.log10(),
                sx / n,
                sy / n
            );
        }
    }
}
