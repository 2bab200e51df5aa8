//! `stipple-bench kernels`: what a training step costs by kernel, and how far that is from what the device could do.
//!
//! Cases are a wavy wall of N Gaussians seen whole, at several N and resolutions, and, given a recording, Gaussians
//! seeded from its stereo depth. Each case trains twice: with every command timed, for the shares, and untimed, for
//! steps a second. A kernel's roofline is the longer of its bytes at the device's copy bandwidth and its operations at
//! its multiply-add peak; both are measured by kernels of ours just before (`model`).

mod model;
mod scene;

use crate::page::{count, mebibytes, number, percent, text, Page, Part, Table};
use crate::table;
use model::{Counts, Peaks};
use scene::Scene;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;
use stipple::config::{GpuConfig, StereoConfig, StereoMethod};
use stipple::gpu::{Gpu, Timing};
use stipple::map::{LearningRates, Pipeline, Shape, StepStats, Tiling, View, Weights};
use stipple::output::chart::{bars, Chart, Series};
use stipple::output::OutputDir;
use stipple_drivers::Fault;

const SIZES: [(usize, usize); 4] = [(320, 240), (376, 240), (752, 480), (1280, 720)];
const COUNTS: [usize; 4] = [10_000, 50_000, 200_000, 500_000];
/// The axis that is not swept is held at these.
const SIZE: (usize, usize) = (752, 480);
const COUNT: usize = 50_000;
/// Counts and size that trainers on a CPU are quoted at.
const SMALL: ([usize; 2], (usize, usize)) = ([6_000, 30_000], (320, 240));
/// Seeds of a recorded scene: what the published system keeps of V1_01.
const RECORDED: usize = 52_000;
/// Time a case is trained for, twice, s, and its steps.
const SECONDS: f64 = 1.0;
const STEPS: (usize, usize) = (3, 300);
/// The most (Gaussian, tile) pairs a binding of 128 MiB has gradients for.
const INTERSECTIONS_MAX: usize = 4 << 20;
/// Large enough that every Gaussian moves, small enough that the picture stays what it was.
const RATES: LearningRates = LearningRates { position: 1e-4, scale: 1e-3, rotation: 1e-3, opacity: 1e-3, colour: 1e-3 };

/// Time of a training step by kernel, against what the device could do
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Substring of the Vulkan device's name
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// Also on Gaussians seeded from the stereo depth of this recording, at full resolution
    #[arg(long, value_name = "FOLDER")]
    recording: Option<PathBuf>,
    /// One small case
    #[arg(long)]
    quick: bool,
    /// Only the cases that are of use without a GPU: 6 000 and 30 000 at 320x240, 50 000 at 752x480
    #[arg(long, conflicts_with = "quick")]
    small: bool,
    /// Without subgroups: what every device runs
    #[arg(long)]
    baseline: bool,
    /// Pixels a lane of the raster shades: 2, 4 or 8
    #[arg(long, value_name = "N", value_parser = clap::builder::PossibleValuesParser::new(["2", "4", "8"]))]
    column: Option<String>,
}

/// One kernel of a case, a step.
struct Cost {
    name: &'static str,
    calls: f64,
    ms: f64,
    bytes: f64,
    flops: f64,
    roof_ms: f64,
}

struct Case {
    name: String,
    counts: Counts,
    /// Time on the device with every command timed, ms: the sum of `kernels`.
    timed_ms: f64,
    /// Time on the device and on the clock with no command timed, ms.
    device_ms: f64,
    wall_ms: f64,
    /// Time of the host to record, encode and submit, while the step before runs, ms.
    host_ms: f64,
    arena_bytes: u64,
    /// Gaussians listed for a tile that has any, and for the one that has most.
    list_mean: f64,
    list_longest: u32,
    kernels: Vec<Cost>,
}

struct Bench {
    device: String,
    tiling: Tiling,
    peaks: Peaks,
    /// Cases by N at `SIZE`, by resolution at `COUNT`; `SMALL`, and the recorded scene.
    by_count: Vec<Case>,
    by_size: Vec<Case>,
    single: Vec<Case>,
    /// From opening the device to the end of the first step, s: with no compiled pipelines kept, and with them.
    start_s: [f64; 2],
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let config = GpuConfig {
        device: args.device.clone().unwrap_or_default(),
        subgroups: !args.baseline,
        ..GpuConfig::default()
    };
    // First, so that a wrong folder is told before the sweep.
    let stereo = StereoConfig { method: StereoMethod::Sgm, ..StereoConfig::default() };
    let seeded = |folder: &PathBuf| Scene::recorded(folder, RECORDED, &stereo, &config);
    let recorded = args.recording.as_ref().map(seeded).transpose()?;
    let out = OutputDir::create(&args.out)?;
    let mut gpu = Gpu::open(&config, model::arena_bytes(args.quick))?;
    let peaks = model::measure(&mut gpu, args.quick)?;
    let mut tiling = Tiling::of(gpu.caps());
    tiling.column = args.column.as_ref().and_then(|n| n.parse().ok()).unwrap_or(tiling.column);
    let device = gpu.caps().name.clone();
    drop(gpu);
    eprintln!("{device}: copies {:.1} GB/s, {:.1} GFLOP/s", peaks.bytes_per_s * 1e-9, peaks.flops_per_s * 1e-9);
    let run = |scene: &Scene| measure(&config, scene, tiling, &peaks, args.quick);
    let wall = |n: usize, (w, h): (usize, usize)| run(&Scene::wall(w, h, n));
    let mut bench =
        Bench { device, tiling, peaks, by_count: vec![], by_size: vec![], single: vec![], start_s: [0.0; 2] };
    if args.quick {
        bench.by_count.push(wall(2_000, (160, 120))?);
    } else {
        for n in if args.small { &[] } else { &COUNTS[..] } {
            bench.by_count.push(wall(*n, SIZE)?);
        }
        for size in if args.small { &[] } else { &SIZES[..] } {
            bench.by_size.push(wall(COUNT, *size)?);
        }
        for n in SMALL.0 {
            bench.single.push(wall(n, SMALL.1)?);
        }
        if args.small {
            bench.single.push(wall(COUNT, SIZE)?);
        }
    }
    if let Some(scene) = &recorded {
        bench.single.push(run(scene)?);
    }
    let scene = recorded.unwrap_or_else(|| {
        if args.quick {
            Scene::wall(160, 120, 2_000)
        } else {
            Scene::wall(SIZE.0, SIZE.1, COUNT)
        }
    });
    bench.start_s = starts(&config, &scene, tiling, &out.file("pipelines"))?;
    let [cold, warm] = bench.start_s;
    eprintln!(
        "from opening the device to the end of the first step: {cold:.2} s, {warm:.2} s with compiled pipelines kept"
    );
    page(&bench).write(&out)?;
    println!("{}\n\n{}", cases_table(&bench).text(), out.file("kernels.html").display());
    Ok(())
}

/// A device and a map of the scene, with pipelines kept in `cache` if there is one.
fn open(config: &GpuConfig, scene: &Scene, tiling: Tiling, cache: Option<&Path>) -> Result<(Gpu, Pipeline), Fault> {
    let n = scene.splats.len();
    let camera = &scene.view.camera;
    let shape = Shape {
        width: camera.width as u32,
        height: camera.height as u32,
        splats: n as u32,
        intersections: (16 * n + 200_000).min(INTERSECTIONS_MAX) as u32,
        images: 1,
        cameras: 1,
        channels: 1,
        fisheye: false,
        half_size: false,
    };
    let mut gpu = Gpu::open(config, Pipeline::arena_bytes(&shape)?)?;
    cache.iter().for_each(|folder| _ = gpu.reuse_pipelines(folder));
    let mut p = Pipeline::with_tiling(&mut gpu, shape, tiling)?;
    gpu.keep_pipelines()?;
    p.pool.append(&mut gpu, &scene.splats)?;
    p.loss.set_image(&mut gpu, 0, &scene.image)?;
    p.loss.set_mask(&mut gpu, 0, &scene.mask)?;
    Ok((gpu, p))
}

/// Time from opening the device to the end of the first step in a process that has loaded the driver, s: with an empty `cache` of pipelines, and with one that is filled.
/// A driver's own cache is the user's to turn off.
fn starts(config: &GpuConfig, scene: &Scene, tiling: Tiling, cache: &Path) -> Result<[f64; 2], Fault> {
    OutputDir::create(cache)?;
    let mut taken = [0.0; 2];
    for s in &mut taken {
        let begun = Instant::now();
        let (mut gpu, mut p) = open(config, scene, tiling, Some(cache))?;
        p.train(&mut gpu, &scene.view, 0, Some(&RATES), &Weights::default())?;
        *s = begun.elapsed().as_secs_f64();
    }
    _ = std::fs::remove_dir_all(cache);
    Ok(taken)
}

fn measure(config: &GpuConfig, scene: &Scene, tiling: Tiling, peaks: &Peaks, quick: bool) -> Result<Case, Fault> {
    let n = scene.splats.len();
    let camera = &scene.view.camera;
    let (mut gpu, mut p) = open(config, scene, tiling, None)?;
    let mut step = |gpu: &mut Gpu| -> Result<f64, Fault> {
        p.train(gpu, &scene.view, 0, Some(&RATES), &Weights::default())?;
        Ok(gpu.last_submit_ms())
    };
    let first = Instant::now();
    step(&mut gpu)?;
    step(&mut gpu)?;
    let steps = match quick {
        true => STEPS.0,
        false => ((2.0 * SECONDS / first.elapsed().as_secs_f64()) as usize).clamp(STEPS.0, STEPS.1),
    };
    let before: Vec<(u64, f64)> = gpu.timings().iter().map(|t| (t.count, t.total_ms)).collect();
    let mut timed_ms = 0.0;
    for _ in 0..steps {
        timed_ms += step(&mut gpu)?;
    }
    let timings: Vec<_> = gpu.timings().to_vec();
    let per = 1.0 / steps as f64;
    let ([wall_ms, device_ms, host_ms], last) = overlapped(&mut gpu, &mut p, &scene.view, steps)?;
    let counts = Counts {
        splats: n as f64,
        visible: f64::from(last.stats.visible),
        intersections: f64::from(last.stats.intersections),
        pixels: (camera.width * camera.height) as f64,
        tile_pixels: tiling.tile().iter().map(|n| f64::from(*n)).product(),
    };
    let (list_mean, list_longest) = lists(&mut gpu, &p)?;
    let case = Case {
        name: scene.name.clone(),
        timed_ms: timed_ms * per,
        device_ms: device_ms * per,
        wall_ms: wall_ms * per,
        host_ms: host_ms * per,
        arena_bytes: gpu.arena_used(),
        list_mean,
        list_longest,
        kernels: costs(&timings, &before, &counts, peaks, per),
        counts,
    };
    eprintln!(
        "{:<32} {:>8} intersections, {:.0} to {} a tile: {:.3} ms of device a step, {:.1} steps/s",
        case.name,
        last.stats.intersections,
        case.list_mean,
        case.list_longest,
        case.device_ms,
        case.steps_per_s()
    );
    Ok(case)
}

/// Trains as the mapper does, a step started before the one before it is finished, no command timed. Answers the time on the
/// clock, on the device and on the host, ms.
fn overlapped(gpu: &mut Gpu, p: &mut Pipeline, view: &View, steps: usize) -> Result<([f64; 3], StepStats), Fault> {
    gpu.time_commands(0);
    let (start, mut device_ms, mut host_ms) = (Instant::now(), 0.0, 0.0);
    let (mut under_way, mut last) = (None, StepStats::default());
    for i in 0..=steps {
        let begun = Instant::now();
        let next = (i < steps).then(|| p.start(gpu, view, 0, &RATES, &Weights::default())).transpose()?;
        host_ms += begun.elapsed().as_secs_f64() * 1e3;
        if let Some(step) = std::mem::replace(&mut under_way, next) {
            last = p.finish(gpu, &step)?;
            device_ms += gpu.last_submit_ms();
        }
    }
    Ok(([start.elapsed().as_secs_f64() * 1e3, device_ms, host_ms], last))
}

/// Costs of the kernels that ran, the dearest first: timings less those `before`, `per` step.
fn costs(timings: &[Timing], before: &[(u64, f64)], counts: &Counts, peaks: &Peaks, per: f64) -> Vec<Cost> {
    let cost = |(t, before): (&Timing, &(u64, f64))| {
        let calls = (t.count - before.0) as f64 * per;
        let (bytes, flops) = counts.model(t.name);
        let ms = (t.total_ms - before.1) * per;
        Cost { name: t.name, calls, ms, bytes, flops, roof_ms: peaks.ms(bytes, flops) }
    };
    let ran = timings.iter().zip(before).filter(|(t, before)| t.count > before.0);
    let mut costs: Vec<Cost> = ran.map(cost).collect();
    costs.sort_by(|a, b| b.ms.total_cmp(&a.ms));
    costs
}

/// Mean and largest length of the lists of tiles, of those that have one.
fn lists(gpu: &mut Gpu, p: &Pipeline) -> Result<(f64, u32), Fault> {
    let ranges = p.renderer.lists.buffers.ranges;
    let mut all = vec![[0u32; 2]; ranges.len()];
    gpu.download(ranges, 0, &mut all).map_err(Fault::from)?;
    let lengths: Vec<u32> = all.iter().map(|[from, to]| to - from).filter(|n| *n > 0).collect();
    let sum: f64 = lengths.iter().map(|n| f64::from(*n)).sum();
    Ok((sum / lengths.len().max(1) as f64, lengths.into_iter().max().unwrap_or(0)))
}

impl Case {
    fn steps_per_s(&self) -> f64 {
        1e3 / self.wall_ms
    }
}

impl Bench {
    fn cases(&self) -> impl Iterator<Item = &Case> {
        self.by_count.iter().chain(&self.by_size).chain(&self.single)
    }
}

const NOTE: &str = "A kernel's roofline is the longer of its bytes, each buffer once, at the rate of copies and its operations at the rate of multiply-adds; the rasters' operations count every pixel of a tile against every Gaussian listed, though opaque pixels end early. Kernel times hold the wait for the command before.";

fn page(bench: &Bench) -> Page {
    let ([w, h], tiling, peaks) = (bench.tiling.tile(), &bench.tiling, &bench.peaks);
    let rates = [("copies, GB/s", peaks.bytes_per_s), ("multiply-adds, GFLOP/s", peaks.flops_per_s)];
    let measured = rates.map(|(name, rate)| format!("{name}: {:.0}", rate * 1e-9)).join("; ");
    Page {
        name: "kernels",
        title: "Kernels: cost of a training step",
        what: format!("{}; tiles of {w}x{h} pixels, {} lanes each", bench.device, tiling.lanes),
        facts: vec![
            ("device", json!(bench.device)),
            ("raster", json!({ "lanes": tiling.lanes, "column": tiling.column, "variant": tiling.variant })),
            ("copy_bytes_per_s", json!(peaks.bytes_per_s)),
            ("fma_flops_per_s", json!(peaks.flops_per_s)),
            ("start_s", json!({ "nothing kept": bench.start_s[0], "pipelines kept": bench.start_s[1] })),
        ],
        parts: vec![
            Part::Note(format!("Measured here: {measured}. {NOTE}")),
            Part::Charts(
                "How the cost grows",
                vec![growth(&bench.by_count, "Gaussians"), growth(&bench.by_size, "pixels")],
            ),
            Part::Table(cases_table(bench)),
            Part::Charts("Where the time goes", bench.cases().map(share).collect()),
            Part::Table(kernels_table(bench)),
        ],
    }
}

fn cases_table(bench: &Bench) -> Table {
    table!("cases", "Cases", bench.cases(), |c| false, [
        text("case") => c.name.as_str(),
        count("Gaussians") => c.counts.splats,
        count("visible") => c.counts.visible,
        count("intersections") => c.counts.intersections,
        count("pixels") => c.counts.pixels,
        count("list mean") => c.list_mean,
        count("list longest") => c.list_longest,
        number("device, every command timed", "ms", 3) => c.timed_ms,
        number("device", "ms", 3) => c.device_ms,
        number("wall", "ms", 3) => c.wall_ms,
        number("host", "ms", 3) => c.host_ms,
        number("throughput", "steps/s", 1) => c.steps_per_s(),
        mebibytes("GPU memory") => c.arena_bytes,
    ])
}

fn kernels_table(bench: &Bench) -> Table {
    let rows = bench.cases().flat_map(|c| c.kernels.iter().map(move |k| (c, k)));
    // None where nothing is counted.
    let reached = |k: &Cost| (k.roof_ms > 0.0 && k.ms > 0.0).then(|| k.roof_ms / k.ms);
    table!("kernels", "Kernels", rows, |r| false, [
        text("case") => r.0.name.as_str(),
        text("kernel") => r.1.name,
        count("calls") => r.1.calls,
        number("time", "ms", 4) => r.1.ms,
        number("moved", "bytes", 0) => r.1.bytes,
        count("operations") => r.1.flops,
        number("roofline", "ms", 4) => r.1.roof_ms,
        percent("reached", 0) => reached(r.1),
    ])
}

fn growth(cases: &[Case], x: &str) -> Option<String> {
    let along = |c: &Case| if x == "pixels" { c.counts.pixels } else { c.counts.splats };
    let of = |get: &dyn Fn(&Case) -> f64| cases.iter().map(|c| (along(c), get(c))).collect::<Vec<_>>();
    let part = |names: &'static [&'static str]| {
        of(&|c| c.kernels.iter().filter(|k| names.iter().any(|n| k.name.starts_with(n))).map(|k| k.ms).sum())
    };
    let series = vec![
        Series::dots("step, wall", 1, of(&|c| c.wall_ms)),
        Series::dots("step, device", 2, of(&|c| c.device_ms)),
        Series::dots("rasters", 3, part(&["raster_"])),
        Series::dots("lists", 4, part(&["tile_ranges", "fill_lists", "sort_lists"])),
    ];
    let title = format!("A training step against {x}");
    Chart { title: &title, x, y: "ms", series, from_zero: true, ..Chart::default() }.svg()
}

fn share(case: &Case) -> Option<String> {
    let total = case.kernels.iter().map(|k| k.ms).sum::<f64>().max(f64::MIN_POSITIVE);
    let row = |k: &Cost| (k.name.to_string(), k.ms, format!("{:.3} ms, {:.0} %", k.ms, 100.0 * k.ms / total));
    bars(&case.name, "ms a step", &case.kernels.iter().map(row).collect::<Vec<_>>())
}
