//! A map that lies in a store, exported: as PLY and as `.spz`, whole or the part that was asked for, from a store that is damaged
//! or written to meanwhile. What reads the files back is gaussforge (tests/export/to_ply.py), whose reader of `.spz` is
//! Niantic's.

use crate::start::{stipple, text};
use glam::{DQuat, DVec3};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};
use stipple::gpu::kernels::types::Splat;
use stipple::map::block::{BlockAbout, BlockArrays, KeyframeAbout, RunAbout, KIND_BLOCK, KIND_KEYFRAME, KIND_RUN};
use stipple::map::{Exposure, Gaussian};
use stipple::output::export::{export, Form, Request};
use stipple::output::ply::write_ply;
use stipple::store::{Disk, Key, Limits, Store};
use stipple_drivers::{host, FaultKind, Pose};

const LIMITS: Limits = Limits {
    bytes_max: 256 << 20,
    segment_bytes: 4 << 20,
    records_max: 1 << 12,
    payload_max: 1 << 20,
    buffers: 4,
    write_bytes_per_s: 0,
};
/// What most images of the stores below were taken with.
const EXPOSURE: Exposure = Exposure { gain: 1.25, offset: -0.05 };

/// Repeatable numbers in -1..1.
fn noise(seed: u64) -> f32 {
    let x = (seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    ((x >> 40) as f32 / (1u64 << 24) as f32) * 2.0 - 1.0
}

/// The Gaussians of block `id`, whose rotations are not of unit length.
fn gaussians(id: u32, n: usize) -> Vec<Gaussian> {
    let one = |i: usize| {
        let v = |k: u64| noise((u64::from(id) * 1_000_000 + i as u64) * 16 + k);
        Gaussian {
            mean: [20.0 * v(0), 20.0 * v(1), 5.0 * v(2)],
            log_scale: [-4.0 + v(3), -4.0 + v(4), -6.0 + v(5)],
            quat_xyzw: [v(6), v(7), v(8), 1.5 * v(9)],
            opacity_logit: 4.0 * v(10),
            colour: [11, 12, 13].map(|k| 0.5 + 0.45 * v(k)),
        }
    };
    (0..n).map(one).collect()
}

/// A block of these Gaussians in colour, with nothing of training but its steps.
fn block(gaussians: &[Gaussian], moved: Pose) -> (BlockAbout, Vec<u8>) {
    let splat = |g: &Gaussian| {
        let ([x, y, z], [a, b, c]) = (g.mean, g.log_scale);
        Splat { mean_opacity: [x, y, z, g.opacity_logit], scale_colour: [a, b, c, g.colour[0]], quat: g.quat_xyzw }
    };
    let splats: Vec<Splat> = gaussians.iter().map(splat).collect();
    let chroma: Vec<[f32; 2]> = gaussians.iter().map(|g| [g.colour[1], g.colour[2]]).collect();
    let steps = vec![1; splats.len()];
    let mut payload = vec![];
    BlockArrays { splats: &splats, steps: &steps, chroma: &chroma, ..BlockArrays::default() }.encode(&mut payload);
    (BlockAbout { count: splats.len() as u32, colour: true, moved, ..BlockAbout::default() }, payload)
}

struct Kept {
    store: Store,
    disk: Disk,
}

impl Kept {
    /// A store in DIR/map with the record of a run and three keyframes, of which one is held out and one is an outlier.
    fn new(dir: &Path, limits: &Limits) -> Kept {
        let (store, disk) = Store::open(&dir.join("map"), 7, limits).unwrap();
        let mut kept = Kept { store, disk };
        kept.run(0);
        kept
    }

    fn run(&mut self, run: u32) {
        self.put(Key { kind: KIND_RUN, run, id: 0 }, &RunAbout::default().encode(), &[]);
        let wild = Exposure { gain: 4.0, offset: 0.3 };
        for (id, exposure, held_out) in [(0, EXPOSURE, false), (1, wild, true), (2, wild, true), (3, EXPOSURE, false)] {
            let about = KeyframeAbout { exposure, held_out, ..KeyframeAbout::default() };
            self.put(Key { kind: KIND_KEYFRAME, run, id }, &about.encode(), &[1; 100]);
        }
    }

    fn put(&mut self, key: Key, about: &stipple::store::About, payload: &[u8]) {
        if !self.store.has_room() {
            self.disk.serve();
        }
        assert!(self.store.put(key, about, |to| to.extend_from_slice(payload)), "{key:?}: {:?}", self.store.figures());
    }

    fn block(&mut self, run: u32, id: u32, gaussians: &[Gaussian], moved: Pose) {
        let (about, payload) = block(gaussians, moved);
        self.put(Key { kind: KIND_BLOCK, run, id }, &about.encode(), &payload);
    }

    fn close(mut self) {
        self.disk.serve();
        self.store.flush().unwrap();
    }
}

/// Gaussians as a viewer is to see them.
fn shown(gaussians: &[Gaussian]) -> Vec<Gaussian> {
    let level = |c: f32| EXPOSURE.observed(f64::from(c)) as f32;
    gaussians.iter().map(|g| Gaussian { colour: g.colour.map(level), ..*g }).collect()
}

fn ply_bytes(gaussians: &[Gaussian]) -> Vec<u8> {
    let mut bytes = vec![];
    write_ply(&mut bytes, gaussians.iter().copied()).unwrap();
    bytes
}

/// The columns of a PLY of floats, by name.
fn columns(path: &Path) -> BTreeMap<String, Vec<f32>> {
    let bytes = fs::read(path).unwrap();
    const END: &[u8] = b"end_header\n";
    let body = bytes.windows(END.len()).position(|w| w == END).unwrap() + END.len();
    let header = std::str::from_utf8(&bytes[..body]).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    assert_eq!(header.lines().filter(|l| l.starts_with("property")).count(), names.len(), "{header}");
    let rows = bytes[body..].chunks_exact(4 * names.len());
    let floats: Vec<Vec<f32>> =
        rows.map(|row| row.chunks_exact(4).map(|v| f32::from_le_bytes(v.try_into().unwrap())).collect()).collect();
    let column = |i: usize| floats.iter().map(|row| row[i]).collect();
    names.iter().enumerate().map(|(i, name)| (name.to_string(), column(i))).collect()
}

fn run_export(dir: &Path, more: &[&str]) -> Output {
    stipple().arg("export").arg(dir).args(more).output().unwrap()
}

#[test]
fn ply_of_a_store_is_the_ply_of_the_same_gaussians() {
    let dir = tempfile::tempdir().unwrap();
    let mut kept = Kept::new(dir.path(), &LIMITS);
    let blocks: Vec<Vec<Gaussian>> = (0..3).map(|id| gaussians(id, 500)).collect();
    // Not in order, and one is written twice.
    for id in [2, 0, 1, 0] {
        kept.block(0, id, &blocks[id as usize], Pose::IDENTITY);
    }
    kept.close();
    let o = run_export(dir.path(), &[]);
    assert!(o.status.success(), "{}", text(&o));
    let expected = ply_bytes(&shown(&blocks.concat()));
    assert!(fs::read(dir.path().join("export.ply")).unwrap() == expected);
    let said = format!("1500 Gaussians of 3 blocks of run 0, {} bytes; runs in the store: 1", expected.len());
    assert!(text(&o).contains(&said) && text(&o).lines().count() == 1, "{}", text(&o));
}

#[test]
fn a_block_that_was_moved_is_exported_where_it_is_now() {
    let dir = tempfile::tempdir().unwrap();
    let mut kept = Kept::new(dir.path(), &LIMITS);
    let block = gaussians(0, 200);
    let moved = Pose::new(DQuat::from_scaled_axis(DVec3::new(0.3, -1.2, 0.7)), DVec3::new(100.0, -3.0, 2.0));
    kept.block(0, 0, &block, moved);
    kept.close();
    assert!(run_export(dir.path(), &[]).status.success());
    let read = columns(&dir.path().join("export.ply"));
    for (i, g) in block.iter().enumerate() {
        let of = |name: &str| f64::from(read[name][i]);
        let at = DVec3::new(of("x"), of("y"), of("z"));
        let q = DQuat::from_xyzw(of("rot_1"), of("rot_2"), of("rot_3"), of("rot_0")).normalize();
        let was = glam::Quat::from_array(g.quat_xyzw).as_dquat().normalize();
        assert!((at - moved.transform(glam::Vec3::from_array(g.mean).as_dvec3())).length() < 1e-4);
        assert!(q.dot(moved.q * was).abs() > 1.0 - 1e-6);
    }
}

#[test]
fn the_newest_run_that_has_blocks_is_exported_unless_another_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let mut kept = Kept::new(dir.path(), &LIMITS);
    kept.block(0, 5, &gaussians(5, 10), Pose::IDENTITY);
    kept.run(1);
    kept.block(1, 6, &gaussians(6, 20), Pose::IDENTITY);
    kept.run(2);
    kept.close();
    for (more, run, n) in [(&[][..], 1, 20), (&["--run", "0"], 0, 10)] {
        let o = run_export(dir.path(), more);
        let said = format!("{n} Gaussians of 1 blocks of run {run}, ");
        assert!(text(&o).contains(&said) && text(&o).contains("runs in the store: 3"), "{}", text(&o));
    }
    let o = run_export(dir.path(), &["--run", "2"]);
    assert!(
        o.status.code() == Some(65) && text(&o).contains("no blocks of run 2") && text(&o).contains("0, 1"),
        "{}",
        text(&o)
    );
}

#[test]
fn a_bounded_map_has_the_most_important_gaussians_and_a_region_those_within() {
    let dir = tempfile::tempdir().unwrap();
    let mut kept = Kept::new(dir.path(), &LIMITS);
    let mut blocks: Vec<Vec<Gaussian>> = (0..4).map(|id| gaussians(id, 1000)).collect();
    // A hundred of equal importance, about the middle: some of them are taken.
    let alike = blocks[1][0];
    let mut all: Vec<f32> = blocks.concat().iter().map(Gaussian::importance).collect();
    all.sort_by(f32::total_cmp);
    let logit = |o: f32| (o / (1.0 - o)).ln();
    let middle =
        Gaussian { log_scale: [0.5 * all[2000].ln() + 0.5; 3], opacity_logit: logit((-1.0f32).exp()), ..alike };
    blocks[1][..100].fill(middle);
    // What cannot be drawn is in no map, and does not count.
    blocks[2][7].quat_xyzw = [0.0; 4];
    blocks[2][8].mean[1] = f32::NAN;
    blocks[2][9].log_scale[1] = f32::INFINITY;
    (0..4).for_each(|id| kept.block(0, id, &blocks[id as usize], Pose::IDENTITY));
    kept.close();
    let mut whole = blocks.concat();
    whole.drain(2007..2010);
    let expected = |of: &[Gaussian], most: usize| {
        let mut order: Vec<usize> = (0..of.len()).collect();
        order.sort_by(|a, b| of[*b].importance().total_cmp(&of[*a].importance()).then(a.cmp(b)));
        order.truncate(most);
        order.sort_unstable();
        ply_bytes(&shown(&order.iter().map(|i| of[*i]).collect::<Vec<_>>()))
    };
    let above = whole.iter().filter(|g| g.importance() > middle.importance()).count();
    let (to, map) = (dir.path().join("x.ply"), dir.path().join("map"));
    for most in [1, 17, 1000, above, above + 40, above + 100, 3996, 3997, 9000] {
        let request = Request { most: Some(most as u64), ..Request::default() };
        let done = export(&map, &to, Form::Ply, &request).unwrap();
        assert_eq!(done.gaussians as usize, most.min(whole.len()));
        assert!(fs::read(&to).unwrap() == expected(&whole, most), "{most}");
    }
    let within: Vec<Gaussian> =
        whole.iter().filter(|g| g.mean[0] >= -5.0 && g.mean[0] <= 5.0 && g.mean[2] <= 1.0).copied().collect();
    assert!(within.len() > 100 && within.len() < 2000);
    for most in [50, 9000] {
        let number = most.to_string();
        let args = ["--region", "-5,-1000,-1000,5,1000,1", "--most", &number, "--out", to.to_str().unwrap()];
        let o = run_export(dir.path(), &args);
        assert!(o.status.success() && fs::read(&to).unwrap() == expected(&within, most), "{}", text(&o));
    }
    let request = Request { region: Some([[900.0; 3], [901.0; 3]]), ..Request::default() };
    let fault = export(&map, &to, Form::Ply, &request).unwrap_err();
    assert!(fault.kind == FaultKind::Data && fault.what.contains("region"), "{fault}");
    assert!(fs::read(&to).unwrap() == expected(&within, 9000), "what was there stays");
}

/// Changes one byte of what is on the disk.
fn damage(folder: &Path, payload: &[u8]) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let mut bytes = fs::read(&path).unwrap();
        if let Some(at) = bytes.windows(64).position(|w| w == &payload[..64]) {
            bytes[at + 70] ^= 4;
            return fs::write(path, bytes).unwrap();
        }
    }
    panic!("the payload is nowhere");
}

#[test]
fn a_damaged_block_is_left_out_and_said() {
    let dir = tempfile::tempdir().unwrap();
    let mut kept = Kept::new(dir.path(), &LIMITS);
    let blocks: Vec<Vec<Gaussian>> = (0..3).map(|id| gaussians(id, 100)).collect();
    (0..3).for_each(|id| kept.block(0, id, &blocks[id as usize], Pose::IDENTITY));
    kept.close();
    damage(&dir.path().join("map"), &block(&blocks[1], Pose::IDENTITY).1);
    let o = run_export(dir.path(), &[]);
    assert!(o.status.success(), "{}", text(&o));
    assert!(text(&o).contains("note: 1 of 3 blocks are damaged and left out: 1\n"), "{}", text(&o));
    assert!(
        fs::read(dir.path().join("export.ply")).unwrap() == ply_bytes(&shown(&[&blocks[0][..], &blocks[2]].concat()))
    );
    // A payload of another length than its header says is damage too, and where all is damaged there is no map.
    for id in [0, 2] {
        damage(&dir.path().join("map"), &block(&blocks[id], Pose::IDENTITY).1);
    }
    fs::remove_file(dir.path().join("export.ply")).unwrap();
    let o = run_export(dir.path(), &[]);
    assert!(o.status.code() == Some(65) && text(&o).contains("each of the 3 blocks"), "{}", text(&o));
    assert!(!dir.path().join("export.ply").exists());
}

#[test]
fn what_cannot_be_exported_is_named_and_explained() {
    let dir = tempfile::tempdir().unwrap();
    let o = run_export(dir.path(), &[]);
    assert!(o.status.code() == Some(66) && text(&o).contains("there is no map store"), "{}", text(&o));
    Kept::new(dir.path(), &LIMITS).close();
    let o = run_export(dir.path(), &[]);
    assert!(o.status.code() == Some(65) && text(&o).contains("no blocks of Gaussians yet"), "{}", text(&o));
    let map_jpg = dir.path().join("map.jpg");
    for (more, said) in [
        (&["--out", map_jpg.to_str().unwrap()][..], "call it .ply or .spz"),
        (&["--region", "1,2,3"], "six numbers"),
        (&["--most", "0"], "--most"),
    ] {
        let o = run_export(dir.path(), more);
        assert!(o.status.code() == Some(64) && text(&o).contains(said), "{}", text(&o));
    }
}

const CHILD: &str = "STIPPLE_TEST_EXPORT_MEMORY";
const BLOCKS: u32 = 200;
const OF_A_BLOCK: usize = 2000;
/// What exporting may take beyond the first: a block is 170 kB, histograms and the compressor 1.5 MB.
const MEMORY_MAX: u64 = 4 << 20;

/// The peak of the resident set is a process' own, so that a child exports: first a map of one block, then 400 000 Gaussians.
#[test]
fn exporting_a_building_takes_the_memory_of_a_block() {
    if let Some(dir) = std::env::var_os(CHILD).map(PathBuf::from) {
        let peak = |of: &str, form: Form, name: &str| {
            let most = Request { most: Some(300_000), ..Request::default() };
            export(&dir.join(of).join("map"), &dir.join(name), form, &most).unwrap();
            host::rss_peak_bytes().unwrap()
        };
        let first = [peak("small", Form::Ply, "a.ply"), peak("small", Form::Spz, "a.spz")];
        let then = [peak("large", Form::Ply, "b.ply"), peak("large", Form::Spz, "b.spz")];
        println!("peaks {first:?} {then:?} more {}", then[1] - first[1]);
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let same = gaussians(0, OF_A_BLOCK);
    for (name, blocks) in [("small", 1), ("large", BLOCKS)] {
        fs::create_dir(dir.path().join(name)).unwrap();
        let mut kept = Kept::new(&dir.path().join(name), &LIMITS);
        for id in 0..blocks {
            let there = Pose { p: DVec3::X * f64::from(id), ..Pose::IDENTITY };
            kept.block(0, id, &same, there);
        }
        kept.close();
    }
    let mut child = Command::new(std::env::current_exe().unwrap());
    child
        .args(["export::exporting_a_building_takes_the_memory_of_a_block", "--exact", "--nocapture"])
        .env(CHILD, dir.path());
    let begun = Instant::now();
    let o = child.output().unwrap();
    let said = text(&o);
    let more = said.split("more ").nth(1).and_then(|m| m.split_whitespace().next()?.parse::<u64>().ok());
    eprintln!(
        "{} s, {}",
        begun.elapsed().as_secs_f32(),
        said.lines().find(|l| l.contains("peaks")).unwrap_or_default()
    );
    assert!(o.status.success() && more.is_some_and(|m| m < MEMORY_MAX), "{said}");
    let ply = fs::metadata(dir.path().join("b.ply")).unwrap().len();
    assert!(ply > 300_000 * 68 && fs::metadata(dir.path().join("b.spz")).unwrap().len() < ply / 3);
}

/// Each generation of a block is marked by the opacity of all its Gaussians.
#[test]
fn a_store_that_is_written_to_is_exported_in_whole_blocks() {
    const N: usize = 250;
    const IDS: u32 = 20;
    let dir = tempfile::tempdir().unwrap();
    // All of it is written anew in about two seconds, so that records move and go while they are read.
    let limits = Limits {
        bytes_max: 4 << 20,
        segment_bytes: 128 << 10,
        payload_max: 64 << 10,
        write_bytes_per_s: 2 << 20,
        ..LIMITS
    };
    let mut kept = Kept::new(dir.path(), &limits);
    let blocks: Vec<Vec<Gaussian>> = (0..IDS).map(|id| gaussians(id, N)).collect();
    let marked = |id: u32, mark: f32| -> Vec<Gaussian> {
        blocks[id as usize].iter().map(|g| Gaussian { opacity_logit: mark, ..*g }).collect()
    };
    (0..IDS).for_each(|id| kept.block(0, id, &marked(id, 0.0), Pose::IDENTITY));
    kept.disk.serve();
    kept.store.flush().unwrap();
    let Kept { mut store, disk } = kept;
    let (until, map) = (Instant::now() + Duration::from_secs(4), dir.path().join("map"));
    let (mut whole, mut changed, mut newest) = (0, 0, 0.0f32);
    std::thread::scope(|scope| {
        scope.spawn(|| disk.write_loop());
        scope.spawn(|| {
            for turn in 1u32.. {
                let id = turn % IDS;
                let (about, payload) = block(&marked(id, turn as f32 / 1000.0), Pose::IDENTITY);
                while !store
                    .put(Key { kind: KIND_BLOCK, run: 0, id }, &about.encode(), |to| to.extend_from_slice(&payload))
                {
                    if Instant::now() > until {
                        return disk.stop();
                    }
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        });
        for turn in 0.. {
            if Instant::now() > until {
                break;
            }
            let (form, to) = [(Form::Ply, "a.ply"), (Form::Spz, "a.spz")][turn % 2];
            let to = dir.path().join(to);
            match export(&map, &to, form, &Request::default()) {
                Ok(done) => {
                    assert_eq!((done.gaussians, done.damaged.len()), (u64::from(IDS) * N as u64, 0));
                    whole += 1;
                }
                Err(fault) => {
                    assert!(fault.kind == FaultKind::Unavailable && fault.what.contains("changed"), "{fault}");
                    changed += 1;
                    continue;
                }
            }
            if form == Form::Ply {
                let read = columns(&to);
                for (id, marks) in read["opacity"].chunks_exact(N).enumerate() {
                    assert!(marks.iter().all(|m| *m == marks[0]), "{marks:?}");
                    newest = newest.max(marks[0]);
                    let xs = blocks[id].iter().map(|g| g.mean[0]);
                    assert!(read["x"][id * N..][..N].iter().copied().eq(xs));
                }
            }
        }
    });
    eprintln!("{whole} exports, {changed} refused; the newest generation seen is {newest}");
    assert!(whole > 10 * changed && newest > 0.1);
}

/// Where `make test` puts gaussforge; where it could not, this says so, and the test is left out.
fn python() -> Option<PathBuf> {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/python");
    if python.join("gaussforge").is_dir() {
        return Some(python);
    }
    eprintln!("left out: there is no gaussforge in target/python; `make target/python/gaussforge` fetches it");
    None
}

#[test]
fn a_foreign_reader_finds_the_map_in_both_forms_within_their_rounding() {
    let Some(python) = python() else { return };
    let dir = tempfile::tempdir().unwrap();
    let mut kept = Kept::new(dir.path(), &LIMITS);
    (0..5).for_each(|id| kept.block(0, id, &gaussians(id, 400), Pose::IDENTITY));
    kept.close();
    let map: Vec<Gaussian> = shown(&(0..5).flat_map(|id| gaussians(id, 400)).collect::<Vec<_>>());
    let read = |name: &str| {
        let (from, to) = (dir.path().join(name), dir.path().join(format!("{name}.ply")));
        let o = run_export(dir.path(), &["--out", from.to_str().unwrap()]);
        assert!(o.status.success(), "{}", text(&o));
        let mut foreign = Command::new("python3");
        foreign.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/export/to_ply.py")).args([&from, &to]);
        let o = foreign.env("PYTHONPATH", &python).output().unwrap();
        assert!(o.status.success(), "{}", text(&o));
        columns(&to)
    };
    let [ply, spz] = ["map.ply", "map.spz"].map(read);
    let logistic = |x: f32| 1.0 / (1.0 + (-x).exp());
    for (i, g) in map.iter().enumerate() {
        // A rotation that is written as numbers is read to their last digit or so.
        for (read, names, position, scale, colour, opacity, turn) in [
            (&ply, ["x", "y", "z"], 1e-5, 1e-5, 1e-5, 1e-5, 1e-3),
            // The file's z is the world's -y. 12 bits after the point, a 16th of ln m, 0.15 in 255. Of a rotation, three
            // components are rounded to 1/√2 in 511, and the fourth, which is at least a half, follows: 2.4e-3 in all.
            (&spz, ["x", "z", "y"], 0.5 / 4096.0, 0.5 / 16.0, 0.5 / (255.0 * 0.15), 1.0 / 255.0, 4.8e-3),
        ] {
            let of = |name: &str| read[name][i];
            let up = names[1] == "z";
            let at = names.map(of);
            let at = if up { [at[0], -at[1], at[2]] } else { at };
            let close = |a: f32, b: f32, by: f32| (a - b).abs() <= 1.001 * by + 1e-5;
            assert!((0..3).all(|k| close(at[k], g.mean[k], position)), "{at:?} {g:?}");
            assert!((0..3).all(|k| close(of(&format!("scale_{k}")), g.log_scale[k], scale)), "{g:?}");
            let coefficient = |k: usize| (g.colour[k] - 0.5) / 0.282_094_79;
            assert!((0..3).all(|k| close(of(&format!("f_dc_{k}")), coefficient(k), colour)), "{g:?}");
            assert!(close(logistic(of("opacity")), g.opacity(), opacity), "{} {g:?}", of("opacity"));
            let q = glam::Quat::from_xyzw(of("rot_1"), of("rot_2"), of("rot_3"), of("rot_0")).normalize();
            let upright =
                if up { glam::Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2) } else { glam::Quat::IDENTITY };
            let off = (q * (upright * glam::Quat::from_array(g.quat_xyzw).normalize()).inverse()).normalize();
            assert!(2.0 * off.xyz().length() < turn, "{} {g:?}", off.xyz().length());
        }
    }
    assert_eq!(["x", "opacity"].map(|name| (ply[name].len(), spz[name].len())), [(2000, 2000); 2]);
}
