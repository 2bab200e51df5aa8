//! A training step of the GPU's kernels against its f64 twin (`tests/gpu/twins`) on Gaussians that a map may hold after something went
//! wrong, and what a hundred steps on them leave.

#[path = "../../gpu/twins/mod.rs"]
#[allow(dead_code, clippy::unwrap_used)] // the tests of the kernels take more of it
pub mod twins;

use crate::page::{number, text, Head, Table};
use glam::{DQuat, DVec3};
use stipple::config::GpuConfig;
use stipple::gpu::Gpu;
use stipple::map::schedule::Rng;
use stipple::map::{Gaussian, LearningRates, Pipeline, Shape, View, Weights};
use stipple::stereo::Pinhole;
use stipple_drivers::{Fault, Pose};
use twins::compare::{compare, finite, Errors, GROUPS};

/// Size of the picture, px.
const SIZE: [usize; 2] = [33, 21];
/// Gaussians of a case.
const SPLATS: usize = 24;
const STEPS: usize = 100;
/// Rates far above any use.
const FAST: LearningRates = LearningRates { position: 4e-3, scale: 2e-2, rotation: 1e-2, opacity: 5e-2, colour: 2e-2 };

struct Case {
    name: &'static str,
    /// Where the camera is, m.
    at: DVec3,
    /// Changes a Gaussian of the usual ones, by its number.
    spoil: fn(usize, &mut Gaussian),
    /// Depth over that of the usual ones.
    depth: f64,
    /// How much wider bounds are than those of every device's tests: where f32 cannot hold what the case is about.
    wider: f64,
}

const USUAL: Case = Case { name: "usual", at: DVec3::new(1.0, -2.0, 0.5), spoil: |_, _| {}, depth: 1.0, wider: 1.0 };

fn cases() -> Vec<Case> {
    let of = |name, spoil| Case { name, spoil, ..USUAL };
    vec![
        USUAL,
        of("scales of 1e-6 m", |_, s| s.log_scale = [1e-6f32.ln(); 3]),
        of("scales of 1e3 m", |_, s| s.log_scale = [1e3f32.ln(); 3]),
        Case {
            wider: 10.0,
            ..of("scales of 1e-6 to 1e3 m in one", |i, s| {
                s.log_scale = std::array::from_fn(|k| 10f32.powi(((i + 3 * k) % 10) as i32 - 6).ln());
            })
        },
        of("needles, 1e4 long", |_, s| s.log_scale = [0.0, -9.2, -9.2]),
        of("opacities of 1e-8 to 1 - 1e-8", |i, s| s.opacity_logit = 1.6 * i as f32 - 18.4),
        Case { wider: 10.0, ..of("colours of 0 to 8", |i, s| s.colour = [i as f32 / 3.0; 3]) },
        of("quaternions of length 1e-3 to 1e3", |i, s| {
            let by = 10f32.powi((i % 7) as i32 - 3);
            s.quat_xyzw = s.quat_xyzw.map(|q| q * by);
        }),
        Case { depth: 0.02, wider: 10.0, ..of("about the near plane, 0.05 m", |_, s| s.log_scale = [-7.0; 3]) },
        // Depths order up to 3 km.
        Case { depth: 600.0, wider: 20.0, ..of("at 0.6 to 2.4 km", |_, s| s.log_scale = s.log_scale.map(|l| l + 6.4)) },
        // A position there is a multiple of 0.06 mm, and at 10 km of 1 mm.
        Case { at: DVec3::new(800.0, -600.0, 10.0), wider: 100.0, ..of("1 km from the origin", |_, _| {}) },
        Case { at: DVec3::new(8e3, -6e3, 100.0), wider: 1000.0, ..of("10 km from the origin", |_, _| {}) },
    ]
}

impl Case {
    fn view(&self) -> View {
        let [width, height] = SIZE;
        let f = 0.8 * width as f64;
        let camera =
            Pinhole { width, height, fx: f, fy: 1.1 * f, cx: 0.5 * width as f64 - 0.3, cy: 0.5 * height as f64 };
        View::new(Pose::new(DQuat::from_scaled_axis(DVec3::new(0.3, -0.5, 0.2)), self.at), camera, None)
    }

    /// Gaussians in and about the view.
    fn splats(&self, view: &View) -> Vec<Gaussian> {
        let mut rng = Rng::new(1);
        let mut uniform = |low: f64, high: f64| low + (high - low) * rng.below(1 << 24) as f64 / f64::from(1 << 24);
        let c = view.camera;
        let mut splat = |i: usize| {
            let z = self.depth * uniform(1.0, 4.0);
            let [x, y] = [(c.width, c.cx), (c.height, c.cy)].map(|(size, centre)| uniform(0.0, size as f64) - centre);
            let p = view.world_from_cam.transform(DVec3::new(x / c.fx * z, y / c.fy * z, z));
            let mut splat = Gaussian {
                mean: p.as_vec3().to_array(),
                log_scale: std::array::from_fn(|_| uniform(-4.0, -1.2) as f32),
                quat_xyzw: std::array::from_fn(|_| uniform(-1.0, 1.0) as f32),
                opacity_logit: uniform(-3.0, 3.5) as f32,
                colour: [uniform(0.05, 0.95) as f32; 3],
            };
            (self.spoil)(i, &mut splat);
            splat
        };
        (0..SPLATS).map(&mut splat).collect()
    }
}

pub struct Row {
    name: &'static str,
    wider: f64,
    errors: Errors,
    /// Loss at the first step and at the last.
    losses: [f64; 2],
    /// Gaussians and gradients left out of the steps, as they were not finite.
    refused: u64,
    finite: bool,
}

impl Row {
    /// The first thing that is not as it has to be.
    pub fn complaint(&self) -> Option<String> {
        let finite = self.finite && self.losses.iter().all(|loss| loss.is_finite());
        let complaint = match self.refused {
            0 if finite => self.errors.complaint(self.wider),
            n => Some(format!("something is not finite; {n} refused")),
        };
        complaint.map(|what| format!("{}: {what}", self.name))
    }
}

fn row(case: &Case) -> Result<Row, Fault> {
    let [width, height] = SIZE.map(|px| px as u32);
    let (view, splats) = (case.view(), case.splats(&case.view()));
    let shape = Shape {
        width,
        height,
        splats: SPLATS as u32,
        intersections: 1 << 14,
        images: 2,
        channels: 1,
        cameras: 1,
        fisheye: false,
        half_size: false,
    };
    let mut gpu = Gpu::open(&GpuConfig::default(), Pipeline::arena_bytes(&shape)?)?;
    let mut p = Pipeline::new(&mut gpu, shape)?;
    p.pool.append(&mut gpu, &splats)?;
    let pixels = SIZE[0] * SIZE[1];
    let level =
        |i: usize| (128.0 + 90.0 * (0.35 * (i % SIZE[0]) as f64).sin() * (0.2 * (i / SIZE[0]) as f64).cos()) as u8;
    let goal: Vec<u8> = (0..pixels).map(level).collect();
    let errors = compare(&mut gpu, &mut p, &view, &splats, [&goal, &vec![255; pixels]])?;
    let (mut losses, mut refused) = ([f64::NAN; 2], 0);
    for step in 0..STEPS {
        let done = p.train(&mut gpu, &view, 1, Some(&FAST), &Weights::default())?;
        losses[usize::from(step > 0)] = done.loss;
        refused += u64::from(done.stats.failed) + u64::from(done.gradients_rejected);
    }
    let finite = p.pool.download(&mut gpu)?.iter().all(finite);
    Ok(Row { name: case.name, wider: case.wider, errors, losses, refused, finite })
}

/// Cases whose name contains `only`.
pub fn rows(only: &str) -> Result<Vec<Row>, Fault> {
    cases().iter().filter(|case| case.name.contains(only)).map(row).collect()
}

pub const NOTE: &str = "Kernels: one training step of 24 Gaussians on 33x21 px in f32 against the twin in f64: the largest difference of a pixel's grey, of the gradients by each group of parameters and by the pose over the largest of their kind, and the bound that every device is held to; where a Gaussian's alpha is within rounding of the least that is drawn, a pixel may differ by a grey level and bounds are wider. Then the loss at the first and at the last of a hundred steps at rates far above any use. Bold: over its bound, or something was not finite.";

/// A difference, for a table: its first figure and its power of ten.
fn small(v: f64) -> String {
    format!("{v:.0e}")
}

pub fn table(rows: &[Row]) -> Table {
    let mut heads: Vec<Head> = ["case", "picture, of 1", "pixel gradient"].map(text).to_vec();
    heads.extend(GROUPS.iter().map(|(name, _)| text(name)));
    heads.extend([text("pose"), text("close decision"), number("loss", "", 3), number("at the end", "", 3)]);
    Table::new("steps", "Kernels against their twin in f64", rows, &heads, |r| {
        let e = &r.errors;
        let mut cells = vec![r.name.into(), small(e.picture).into(), small(e.pixel).into()];
        cells.extend(e.groups.map(|g| small(g).into()));
        cells.extend([small(e.pose).into(), if e.flip > 0.0 { "yes" } else { "" }.into()]);
        cells.extend(r.losses.map(|loss| loss.into()));
        (r.complaint().is_some(), cells)
    })
}
