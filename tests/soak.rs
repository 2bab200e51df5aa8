//! What is only seen after a while.
//!
//! Garbage into the estimator and the tracker, mixed with good stretches: what they say stays finite, what
//! they refuse is counted, nothing panics, and they recover. A few seconds of it in `make test`, a
//! minute of it in `make soak`. The cases are drawn by proptest from a fixed seed.
//!
//! The program itself with a map, in `make soak MINUTES=n SPEED=m`: a flight of n times m minutes, whose two processes take no
//! more memory, files and threads after the first minute, whose log has every frame, and which loses nothing.
#![allow(clippy::unwrap_used)]

#[allow(dead_code)] // each test takes of it what it needs
#[path = "program/start.rs"]
mod start;
#[allow(dead_code)] // each test takes of it what it needs
#[path = "bench/world.rs"]
mod world;

use glam::DVec3;
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use start::{children, stipple, BOARD};
use std::f64::consts::{PI, TAU};
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use stipple::config::{FrontendConfig, VioConfig};
use stipple::counters::{Counter, Counters};
use stipple::frontend::{Frontend, Prediction, Track, Tracks};
use stipple::run::gate::ImuGate;
use stipple::run::log::read::{read_files, runs, Message};
use stipple::vio::{Health, Update, Vio};
use stipple_drivers::host::{self, monotonic};
use stipple_drivers::sim::{euroc_rig, write_euroc, Flight, Recording, Scenario, Sim};
use stipple_drivers::source::ImuReading;
use stipple_drivers::{Frames, Image, ImuSample, Nanos, Pose, Span, TimedPose};
use world::{Noise, Path, World, FRAME_SECS, RATE_HZ};

/// Frames of good data at the end: a divergence noticed, a start, and time to settle.
const GOOD: usize = 100;
/// Velocity error after them, m/s.
const RECOVERED: f64 = 0.2;

#[derive(Clone, Copy, Debug)]
enum Kind {
    Good,
    NotFiniteSamples,
    HugeSamples,
    RandomSamples,
    LateSamples,
    RandomTracks,
    NotFiniteTracks,
    Unsorted,
    Empty,
    OneCamera,
    LateFrames,
}

const KINDS: [Kind; 11] = [
    Kind::Good,
    Kind::NotFiniteSamples,
    Kind::HugeSamples,
    Kind::RandomSamples,
    Kind::LateSamples,
    Kind::RandomTracks,
    Kind::NotFiniteTracks,
    Kind::Unsorted,
    Kind::Empty,
    Kind::OneCamera,
    Kind::LateFrames,
];

/// Kind and length, frames.
fn segments() -> impl Strategy<Value = (u64, Vec<(Kind, usize)>)> {
    (any::<u64>(), prop::collection::vec((prop::sample::select(&KINDS[..]), 1usize..40), 1..6))
}

fn runner(cases: u32) -> TestRunner {
    TestRunner::new_with_rng(
        Config { cases, failure_persistence: None, ..Config::default() },
        proptest::test_runner::TestRng::deterministic_rng(proptest::test_runner::RngAlgorithm::ChaCha),
    )
}

fn spoil_sample(kind: Kind, s: &mut ImuSample, noise: &mut Noise) {
    match kind {
        Kind::NotFiniteSamples if noise.uniform() < 0.5 => {
            let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY][noise.bits() as usize % 3];
            let hurt = if noise.uniform() < 0.5 { &mut s.gyro_body } else { &mut s.accel_body };
            hurt[noise.bits() as usize % 3] = bad;
        }
        Kind::HugeSamples => {
            s.gyro_body = noise.vector() * 1e6;
            s.accel_body = noise.vector() * 10f64.powf(noise.uniform() * 300.0);
        }
        Kind::RandomSamples => (s.gyro_body, s.accel_body) = (noise.vector() * 3.0, noise.vector() * 20.0),
        Kind::LateSamples if noise.uniform() < 0.5 => {
            let back = [0, 1, 5_000_000, 3_000_000_000, i64::MAX / 2][noise.bits() as usize % 5];
            s.t = Nanos(s.t.0.saturating_sub(back));
        }
        _ => {}
    }
}

fn spoil_tracks(kind: Kind, tracks: &mut Tracks, noise: &mut Noise) {
    let mut pixel = |scale: f64| [(noise.uniform() * scale) as f32, (noise.uniform() * scale) as f32];
    match kind {
        Kind::RandomTracks => tracks.cameras.iter_mut().flat_map(|c| c.iter_mut()).for_each(|t| t.px = pixel(700.0)),
        Kind::NotFiniteTracks => {
            let bad = [f32::NAN, f32::INFINITY, -f32::INFINITY, f32::MAX, -1e30, 0.0];
            let list = tracks.cameras.iter_mut().flat_map(|c| c.iter_mut());
            list.for_each(|t| t.px[t.id as usize % 2] = bad[noise.bits() as usize % bad.len()]);
        }
        Kind::Unsorted => {
            for list in tracks.cameras.iter_mut() {
                list.reverse();
                let first = list.first().copied().unwrap_or_default();
                let _ = list.push(first);
                let _ = list.push(Track { id: u64::MAX, px: pixel(700.0) });
            }
        }
        Kind::Empty => tracks.cameras.iter_mut().for_each(|c| c.clear()),
        Kind::OneCamera => tracks.cameras[noise.bits() as usize % 2].clear(),
        Kind::LateFrames if noise.uniform() < 0.5 => tracks.t = Nanos(tracks.t.0 - (noise.bits() % 200_000_000) as i64),
        _ => {}
    }
}

fn finite(vio: &Vio, update: &Update, kind: Kind) {
    if let Some(o) = update.odometry {
        let biases = o.gyro_bias.is_finite() && o.accel_bias.is_finite();
        assert!(o.world_from_body.is_finite() && o.v_world.is_finite() && biases, "{kind:?}: {o:?}");
    }
    if let Some(c) = vio.covariance() {
        assert!(c.iter().flatten().all(|x| x.is_finite()), "{kind:?}: {c:?}");
    }
    assert!(update.quality <= 100);
}

/// One flight of segments; answers the velocity error at its end, if the estimator is up.
fn fly(seed: u64, segments: &[(Kind, usize)]) -> Option<f64> {
    let path = Path { rest: -1.0 };
    let mut world = World::new(path);
    let mut noise = Noise(seed);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    let mut tracks = Tracks::default();
    let (mut gate, counters) = (ImuGate::new(&world.rig.imu), Counters::default());
    let (mut sample, mut given, mut sent, mut taken) = (0, 0u64, 0u64, 0u64);
    let kinds = segments.iter().flat_map(|(kind, n)| std::iter::repeat_n(*kind, *n));
    let mut error = None;
    for (frame, kind) in kinds.chain(std::iter::repeat_n(Kind::Good, GOOD)).enumerate() {
        let t = frame as f64 * FRAME_SECS + 0.0012;
        while (sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            let mut s = world.imu(sample as f64 / RATE_HZ);
            let arrived = s.t;
            spoil_sample(kind, &mut s, &mut noise);
            let reading = ImuReading { sample: s, ..ImuReading::default() };
            gate.pass(&reading, arrived, &counters, &mut |s| {
                given += 1;
                vio.on_imu(s);
            });
            sample += 1;
        }
        world.tracks(t, &mut tracks);
        spoil_tracks(kind, &mut tracks, &mut noise);
        let update = vio.on_tracks(&tracks);
        sent += 1;
        taken += u64::from(update.odometry.is_some() || update.health.has(Health::INITIALISING));
        finite(&vio, &update, kind);
        let v = |t: f64| (path.pose(t + 1e-4).p - path.pose(t - 1e-4).p) / 2e-4;
        let in_body = |pose: &Pose, v: DVec3| pose.q.conjugate() * v;
        error = update.odometry.map(|o| in_body(&o.world_from_body, o.v_world).distance(in_body(&path.pose(t), v(t))));
    }
    gate.lose(&mut |s| {
        given += 1;
        vio.on_imu(s);
    });
    let (s, c) = (vio.stats(), &counters);
    let refused = [&c.imu_rejected, &c.imu_not_newer, &c.imu_timestamp_jump, &c.imu_frozen].map(Counter::get);
    assert_eq!(given + refused.iter().sum::<u64>(), sample, "every refused sample is counted");
    assert_eq!(taken + s.frames_rejected, sent, "every frame is counted");
    error
}

fn estimator(cases: u32) {
    let result = runner(cases).run(&segments(), |(seed, segments)| {
        let error = fly(seed, &segments);
        prop_assert!(error.is_some_and(|e| e < RECOVERED), "velocity error {error:?} m/s at the end");
        Ok(())
    });
    result.unwrap_or_else(|e| panic!("{e}"));
}

/// Images of another size, missing and left over: answers how many are to be refused.
fn spoil_images(images: &mut Vec<Image>, noise: &mut Noise) -> u64 {
    let camera = noise.bits() as usize % images.len();
    let image = &mut images[camera];
    match noise.bits() % 10 {
        0 => *image = Image::new(image.height, image.width),
        1 => *image = Image::new(noise.bits() as usize % 2000, noise.bits() as usize % 40),
        2 => image.pixels.truncate(noise.bits() as usize % image.pixels.len()),
        3 => images.push(Image::default()),
        4 => {
            images.truncate(camera);
            return 2 - camera as u64;
        }
        _ => return 0,
    }
    1
}

/// Random images, with stripes and flat stretches, some of another size or missing, and wild predictions.
fn tracker(frames: usize) {
    let rig = euroc_rig();
    let mut frontend = Frontend::new(&rig, &FrontendConfig::default()).unwrap();
    let whole = Frames::for_rig(&rig);
    let mut shown = Arc::new(whole.clone());
    let mut noise = Noise(5);
    let mut refused = 0;
    for i in 0..frames {
        let images = Arc::make_mut(&mut shown);
        images.images.clone_from(&whole.images);
        images.t = Nanos(i as i64 * 50_000_000);
        let mode = noise.bits() % 4;
        for image in &mut images.images {
            let flat = noise.bits() as u8;
            for (k, p) in image.pixels.iter_mut().enumerate() {
                *p = match mode {
                    0 => noise.bits() as u8,
                    1 => flat,
                    2 => ((k / 9 % 2) * 255) as u8,
                    _ => (k % 752 / 20 * 37 + k / 752 / 20 * 91) as u8,
                };
            }
        }
        refused += spoil_images(&mut images.images, &mut noise);
        let wild = [0.01, 1.0, 1e6, f64::NAN][noise.bits() as usize % 4];
        let prev_from_now = Some(Pose { q: glam::DQuat::from_scaled_axis(noise.vector()), p: noise.vector() * wild });
        let tracks = frontend.track(&shown, &Prediction { prev_from_now });
        for (camera, list) in rig.cameras.iter().zip(&tracks.cameras) {
            let inside = |t: &Track| {
                let [x, y] = t.px.map(f64::from);
                camera.camera.contains(glam::DVec2::new(x, y), 0.0)
            };
            assert!(list.iter().all(inside), "frame {i}: {list:?}");
            assert!(list.windows(2).all(|w| w[0].id < w[1].id), "ids ascend");
        }
        assert_eq!(frontend.stats().frontend_images_refused, refused, "frame {i}: every refused image is counted");
    }
}

#[test]
fn garbage_is_refused_and_forgotten() {
    estimator(6);
    tracker(16);
}

#[test]
#[ignore = "a minute of it: make soak"]
fn garbage_for_a_minute() {
    estimator(90);
    tracker(100);
}

/// What the resident set may grow by after the first minute, bytes, in the process that flies and in the mapper's, whose driver
/// allocates.
const GROWTH_MAX: [u64; 2] = [1 << 20, 8 << 20];
/// An image being read when looked at.
const FILES_SLACK: u64 = 1;
const WARM: Duration = Duration::from_secs(60);
/// Counters that stay zero in a flight; others, such as a full store of keyframes, are how a map in fixed memory lives.
const LOSSES: [&str; 8] =
    ["frames_", "camera_", "imu_", "log_records_lost", "log_ended", "lines_lost", "threads_", "map_"];
/// How often each processor is asked whether it runs.
const WITNESS_PERIOD: Span = Span(1_000_000);
/// Frames until odometry starts, at the first motion.
const STARTING_MAX: f64 = 100.0;

/// What the kernel says of a process: bytes resident, open files, threads.
fn resources(pid: u32) -> Option<[u64; 3]> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let field = |name: &str| status.lines().find_map(|l| l.strip_prefix(name))?.split_whitespace().next()?.parse().ok();
    let (kib, threads): (u64, u64) = (field("VmRSS:")?, field("Threads:")?);
    Some([1024 * kib, std::fs::read_dir(format!("/proc/{pid}/fd")).ok()?.count() as u64, threads])
}

/// What the log has of a frame: when its state was there, its stamp, and the milliseconds that tracking it took, of the clock
/// and of a processor.
struct Seen {
    at: Nanos,
    stamp: Nanos,
    latency_ms: f64,
    cpu_ms: f64,
}

/// Says of the gaps among the states of the second before `until` whether tracking was late in them, or what it is given.
fn say_late(seen: &[Seen], until: Nanos, speed: f64) {
    let since_due = |s: &Seen| s.at.0 as f64 - (s.stamp - seen[0].stamp).0 as f64 / speed;
    let least = seen.iter().map(since_due).fold(f64::INFINITY, f64::min);
    let late = |s: &Seen| (since_due(s) - least) / 1e6;
    let near = seen.partition_point(|s| (until - s.at).secs() > 1.5)..seen.partition_point(|s| s.at < until);
    for k in near {
        let Some([one, next]) = seen.get(k..k + 2) else { continue };
        if (next.stamp - one.stamp).secs() < 0.075 {
            continue;
        }
        for s in &seen[k.saturating_sub(2)..(k + 4).min(seen.len())] {
            let (stamp, late, took, cpu) = ((s.stamp - seen[0].stamp).secs(), late(s), s.latency_ms, s.cpu_ms);
            eprintln!("  frame of {stamp:.2} s: its state came {late:.1} ms late, took {took:.1} ms, {cpu:.1} of them computing");
        }
    }
}

/// A thread on each processor that does nothing but ask, at the highest priority of all, whether the machine runs: where a
/// host takes a processor of a virtual machine away, no program on it can be in time.
struct Witness {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Vec<[Nanos; 2]>>>,
    /// Its pauses are the machine's: without that priority what else the machine does would count as one.
    has_priority: bool,
}

impl Witness {
    /// Notes the pauses that are longer than `least`.
    fn start(least: Span) -> Witness {
        let stop = Arc::new(AtomicBool::new(false));
        let watch = |cpu: usize| {
            let stop = stop.clone();
            std::thread::spawn(move || {
                pin(cpu);
                let _ = host::ask_for_realtime(50);
                let mut pauses = vec![];
                while !stop.load(Relaxed) {
                    let due = monotonic() + WITNESS_PERIOD;
                    std::thread::sleep(Duration::from_nanos(WITNESS_PERIOD.0 as u64));
                    let now = monotonic();
                    if now - due > least {
                        pauses.push([due, now]);
                    }
                }
                pauses
            })
        };
        let threads = (0..std::thread::available_parallelism().unwrap().get()).map(watch).collect();
        let has_priority = std::thread::spawn(|| host::ask_for_realtime(50).is_ok()).join().unwrap();
        Witness { stop, threads, has_priority }
    }

    /// Pauses of any processor, from when to when, ascending; those that overlap are one.
    fn pauses(self) -> Vec<[Nanos; 2]> {
        self.stop.store(true, Relaxed);
        let mut all: Vec<_> = self.threads.into_iter().flat_map(|t| t.join().unwrap()).collect();
        all.sort_unstable();
        all.dedup_by(|next, one| {
            let overlap = next[0] <= one[1];
            one[1] = if overlap { one[1].max(next[1]) } else { one[1] };
            overlap
        });
        all
    }
}

/// Keeps the calling thread on one processor, where that is allowed.
fn pin(cpu: usize) {
    let thread = std::fs::read_link("/proc/thread-self").unwrap();
    let id = thread.file_name().unwrap().to_str().unwrap();
    let _ = std::process::Command::new("taskset").args(["-pc", &cpu.to_string(), id]).stdout(Stdio::null()).status();
}

/// Twice around a room and back to where it began, at rest there: what plays it again has no jump.
fn round_trip() -> Scenario {
    // Of `Demo` past its start: 0.766 rad/s, the same place and attitude after 4 pi.
    const UNDER_WAY: f64 = 2.4;
    const ROUND: f64 = 2.0 * TAU / 0.766;
    const REST: f64 = 1.5;
    const RAMP: f64 = 2.0;
    const MARGIN: f64 = 0.15; // the simulator leaves out the ends of what it fits
    let begun = |x: f64| 0.5 * (x - RAMP / PI * (PI * x / RAMP).sin());
    let way = |t: f64| {
        let x = (t - REST).clamp(0.0, ROUND + RAMP);
        match (x < RAMP, x > ROUND) {
            (true, _) => begun(x),
            (_, true) => ROUND - begun(ROUND + RAMP - x),
            _ => x - 0.5 * RAMP,
        }
    };
    let mut scenario = Scenario::named("demo").unwrap();
    let cam_from_body = scenario.calibration.cameras[0].body_from_cam.inverse();
    let n = (100.0 * (2.0 * REST + RAMP + ROUND + 2.0 * MARGIN)) as i64;
    let at = |i: i64| {
        let look = Flight::Demo.look(UNDER_WAY + way(0.01 * i as f64 - MARGIN)).unwrap();
        TimedPose { t: Nanos(1_000_000_000 + i * 10_000_000), pose: look * cam_from_body }
    };
    scenario.path = Flight::Recorded(Recording { poses: (0..n).map(at).collect(), biases: vec![], imu: None });
    scenario.duration = Span::from_secs(60.0);
    scenario.image_divisor = 4;
    scenario
}

#[test]
#[ignore = "minutes of it: make soak MINUTES=5"]
fn a_flight_of_hours_takes_no_more_memory_files_and_threads() {
    let number = |name, or: f64| std::env::var(name).map_or(or, |m| m.parse().expect("a number"));
    let (minutes, speed) = (number("STIPPLE_SOAK_MINUTES", 5.0), number("STIPPLE_SOAK_SPEED", 5.0));
    let (dir, memory) = (tempfile::tempdir().unwrap(), std::path::Path::new("/dev/shm"));
    // A camera waits for no disk: its recording is in memory, where there is such a file system.
    let recorded = if memory.is_dir() { tempfile::tempdir_in(memory).unwrap() } else { tempfile::tempdir().unwrap() };
    let (data, out) = (recorded.path().join("flight"), dir.path().join("out"));
    write_euroc(&mut Sim::new(&round_trip()).unwrap(), &data, 0, |_, _| {}).unwrap();
    let (duration, speed_word) = ((60.0 * minutes).to_string(), speed.to_string());
    let mut run = stipple();
    run.args(["run", "--board", BOARD, "--set", "map.scale=1", "--dataset", data.to_str().unwrap(), "--repeat"]);
    run.args(["--speed", &speed_word, "--duration", &duration, "--out", out.to_str().unwrap()]);
    let said = std::fs::File::create(dir.path().join("said")).unwrap();
    let mut child = run.stdout(Stdio::null()).stderr(said.try_clone().unwrap()).spawn().unwrap();
    let said = || std::fs::read_to_string(dir.path().join("said")).unwrap();
    // A frame waits in the mailbox until the next one comes.
    let frame_period = Span::from_secs(0.05 / speed);
    let witness = Witness::start(Span(frame_period.0 / 2));
    let (begun, began, mut next) = (Instant::now(), monotonic(), Duration::ZERO);
    let (mut warm, mut most, mut mapper) = ([[0; 3]; 2], [[0; 3]; 2], None);
    // Ends before the run does: evaluation and report take what they need.
    while begun.elapsed().as_secs_f64() < 60.0 * minutes - 2.0 {
        std::thread::sleep(Duration::from_secs(1));
        mapper = mapper.or_else(|| children(child.id()).first().copied());
        let pids = [Some(child.id()), mapper];
        let Some(seen) = pids.map(|pid| pid.and_then(resources)).into_iter().collect::<Option<Vec<_>>>() else {
            panic!("a process ended after {:?}: {}", begun.elapsed(), said())
        };
        let of = if begun.elapsed() < WARM { &mut warm } else { &mut most };
        of.iter_mut().flatten().zip(seen.iter().flatten()).for_each(|(most, now)| *most = (*most).max(*now));
        if begun.elapsed() >= next {
            next += Duration::from_secs(15);
            eprintln!("{:.0} s: flying and mapping, [bytes, files, threads]: {seen:?}", begun.elapsed().as_secs_f64());
        }
    }
    assert!(child.wait().unwrap().success(), "{}", said());
    let (has_priority, mut pauses) = (witness.has_priority, witness.pauses());
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    let frames = report["frames"].as_u64().unwrap();
    let counted = report.as_object().unwrap().iter().filter(|(_, n)| n.as_u64() != Some(0));
    let counted: Vec<_> = counted.filter_map(|(name, n)| Some((name.strip_prefix("count_")?, n))).collect();
    let (mut seen, mut overwritten, mut losses) = (vec![], 0, vec![]);
    read_files(&runs(&out).unwrap()[0].files, |at, message| {
        match message {
            Message::State(s) => {
                seen.push(Seen { at, stamp: Nanos(s.t_ns), latency_ms: s.latency_ms, cpu_ms: s.cpu_ms });
            }
            Message::Counters(counters) => {
                let now = counters.get("frames_overwritten").copied().unwrap_or(0);
                losses.extend((now > overwritten).then_some((at, now - overwritten)));
                overwritten = now;
            }
            _ => {}
        }
        Ok(())
    })
    .unwrap();
    let logged = seen.len() as u64;
    eprintln!("flown {:.0} s in {minutes} minutes: {frames} frames, {logged} in the log", frames as f64 / 20.0);
    // Counters tell within a second what a pause of the machine cost.
    let mut excused = 0;
    for (at, lost) in losses {
        let (near, rest): (Vec<_>, _) =
            pauses.into_iter().partition(|[from, to]| (*to - at).secs() > -2.0 && *from < at);
        // Each excuses once.
        pauses = rest;
        let paused: Vec<_> = near.iter().map(|[from, to]| *to - *from).collect();
        let (s, ms) = ((at - began).secs(), Vec::from_iter(paused.iter().map(|p| p.0 / 1_000_000)));
        eprintln!(
            "{lost} frames were overwritten within a second of {s:.1} s; threads that do nothing paused {ms:?} ms"
        );
        say_late(&seen, at, speed);
        let excuse = paused.iter().map(|p| (p.0 / frame_period.0 + 1) as u64).sum();
        excused += if has_priority { lost.min(excuse) } else { 0 };
    }
    eprintln!("until a minute {warm:?}\nafter it      {most:?}\ncounters {counted:?}\n{}", report["gpu_bytes"]);
    for ((most, warm), growth) in most.iter().zip(&warm).zip(GROWTH_MAX) {
        assert!(most[0] <= warm[0] + growth && most[1] <= warm[1] + FILES_SLACK && most[2] <= warm[2]);
    }
    assert_eq!(
        (&report["heap_after_seal"], logged),
        (&0.into(), frames),
        "nothing is allocated, every frame is logged"
    );
    assert!(frames as f64 > 0.95 * 20.0 * 60.0 * minutes * speed);
    for (name, n) in counted.into_iter().filter(|(name, _)| LOSSES.iter().any(|loss| name.starts_with(loss))) {
        let most = match name {
            "frames_overwritten" => excused as f64,
            "frames_without_odometry" => STARTING_MAX,
            _ => 0.0,
        };
        assert!(n.as_f64().unwrap() <= most, "{name}: {n}");
    }
}
