//! `stipple-bench ply`: what a viewer shows of a map.ply, scored on the left images of a recording at given poses.
//!
//! Reader and renderer are written here from the published format and method (Kerbl et al., SIGGRAPH 2023), in double precision
//! on the CPU, and share nothing with the mapper but the rectification of the images. For each view: PSNR as the map stands, and
//! with gain and offset fitted by least squares over pixels that the camera did not saturate, then clamped as a camera does.

use crate::page::{count, number, text, Page, Part, Table};
use crate::table;
use glam::{DMat3, DQuat, DVec2, DVec3};
use std::path::PathBuf;
use stipple::output::metrics::percentile;
use stipple::output::OutputDir;
use stipple::stereo::rectify::Rectification;
use stipple::stereo::Pinhole;
use stipple_drivers::replay::{read_trajectory, OpenOptions, Recording};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, FaultKind, Frames, Image, Pose, Span};

/// What a viewer shows of a map.ply: a reader and renderer apart from the mapper's; a minute
#[derive(clap::Args)]
pub struct Args {
    /// The map
    map: PathBuf,
    /// Recording whose left images it is compared with
    dataset: PathBuf,
    /// Poses of the images (EuRoC or TUM csv)
    #[arg(long, value_name = "CSV")]
    poses: PathBuf,
    /// The N of `replay --holdout N`: every Nth view is counted apart
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
    holdout: Option<u32>,
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Gap in the table of poses that is interpolated across, as in a replay.
const POSE_GAP_MAX: Span = Span(100_000_000);
/// Views nearest the median exposure that are reported apart.
const NEAREST: usize = 10;

/// One Gaussian, in the world.
struct Gaussian {
    mean: DVec3,
    covariance: DMat3,
    opacity: f64,
    /// Mean of the three channels, 0 to 1.
    grey: f64,
}

/// Reads the properties that 3DGS viewers read, by name.
fn read(path: &std::path::Path) -> Result<Vec<Gaussian>, Fault> {
    let wrong = |what: String| Fault::new(FaultKind::Data, path.display().to_string(), what, "name a map.ply");
    let bytes = std::fs::read(path).map_err(|e| {
        Fault::new(FaultKind::NoInput, path.display().to_string(), format!("cannot be read: {e}"), "name a map.ply")
    })?;
    const END: &[u8] = b"end_header\n";
    let body = bytes.windows(END.len()).position(|w| w == END).ok_or_else(|| wrong("has no end_header".into()))?;
    let header = String::from_utf8_lossy(&bytes[..body]).into_owned();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let column = |name: &str| names.iter().position(|n| *n == name).ok_or_else(|| wrong(format!("has no `{name}`")));
    let at =
        |list: [&str; 3]| -> Result<[usize; 3], Fault> { Ok([column(list[0])?, column(list[1])?, column(list[2])?]) };
    let (place, scale) = (at(["x", "y", "z"])?, at(["scale_0", "scale_1", "scale_2"])?);
    let (colour, imaginary) = (at(["f_dc_0", "f_dc_1", "f_dc_2"])?, at(["rot_1", "rot_2", "rot_3"])?);
    let (opacity, real) = (column("opacity")?, column("rot_0")?);
    let rows = bytes[body + END.len()..].chunks_exact(4 * names.len());
    Ok(rows
        .map(|row| {
            let f = |i: usize| f64::from(f32::from_le_bytes([0, 1, 2, 3].map(|k| row[4 * i + k])));
            let three = |i: [usize; 3]| DVec3::from_array(i.map(f));
            let q = DQuat::from_vec4(three(imaginary).extend(f(real))).normalize();
            let m = DMat3::from_quat(q) * DMat3::from_diagonal(three(scale).exp());
            // The constant spherical harmonic, 1 / (2 √π).
            let grey = colour.map(|i| (0.5 + 0.282_094_791_773_878_14 * f(i)).max(0.0)).iter().sum::<f64>() / 3.0;
            Gaussian {
                mean: three(place),
                covariance: m * m.transpose(),
                opacity: 1.0 / (1.0 + (-f(opacity)).exp()),
                grey,
            }
        })
        .collect())
}

/// Means of the Gaussians of a map.
pub fn means(map: &std::path::Path) -> Result<Vec<DVec3>, Fault> {
    Ok(read(map)?.into_iter().map(|g| g.mean).collect())
}

/// A Gaussian as a view has it: centre, inverse covariance (a, b, c), depth, reach in pixels.
struct Splat<'a> {
    of: &'a Gaussian,
    centre: DVec2,
    conic: [f64; 3],
    depth: f64,
    reach: DVec2,
}

/// Least depth drawn, m.
const NEAR: f64 = 0.05;
/// Margin of the slope of the projection, in widths of the picture.
const MARGIN: f64 = 0.15;
/// Variance of the screen-space low-pass, px².
const LOW_PASS: f64 = 0.3;
const ALPHA_MIN: f64 = 1.0 / 255.0;
const ALPHA_MAX: f64 = 0.99;
const TRANSMITTANCE_MIN: f64 = 1e-4;

fn project<'a>(of: &'a Gaussian, cam_from_world: &Pose, p: &Pinhole) -> Option<Splat<'a>> {
    let x = cam_from_world.transform(of.mean);
    if x.z < NEAR || of.opacity < ALPHA_MIN {
        return None;
    }
    let r = cam_from_world.rotation();
    let v = r * of.covariance * r.transpose();
    // The slope of the projection is taken no farther out than a little beyond the picture, as every viewer does: what is
    // beside a camera would smear over all of it.
    let slope = |at: f64, f: f64, c: f64, n: usize| {
        let margin = MARGIN * n as f64 / f;
        (at / x.z).clamp(-c / f - margin, (n as f64 - c) / f + margin)
    };
    let (tx, ty) = (slope(x.x, p.fx, p.cx, p.width), slope(x.y, p.fy, p.cy, p.height));
    let (jx, jy) = (DVec3::new(1.0, 0.0, -tx) * (p.fx / x.z), DVec3::new(0.0, 1.0, -ty) * (p.fy / x.z));
    let (a, b, c) = (jx.dot(v * jx) + LOW_PASS, jx.dot(v * jy), jy.dot(v * jy) + LOW_PASS);
    let determinant = a * c - b * b;
    let tau = (of.opacity / ALPHA_MIN).ln();
    let reach = DVec2::new((2.0 * tau * a).sqrt(), (2.0 * tau * c).sqrt());
    let centre = DVec2::new(p.fx * x.x / x.z + p.cx, p.fy * x.y / x.z + p.cy);
    let inside = centre.x + reach.x >= 0.0 && centre.y + reach.y >= 0.0;
    let inside = inside && centre.x - reach.x <= p.width as f64 && centre.y - reach.y <= p.height as f64;
    let conic = [c / determinant, -b / determinant, a / determinant];
    (inside && determinant > 0.0).then_some(Splat { of, centre, conic, depth: x.z, reach })
}

/// Front to back over black, pixel (0, 0) centred at (0, 0).
fn render(map: &[Gaussian], cam_from_world: &Pose, p: &Pinhole) -> Vec<f64> {
    let mut splats: Vec<Splat> = map.iter().filter_map(|g| project(g, cam_from_world, p)).collect();
    splats.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let mut light = vec![0.0; p.width * p.height];
    let mut passed = vec![1.0; p.width * p.height];
    for s in &splats {
        let range = |centre: f64, reach: f64, n: usize| {
            ((centre - reach).ceil().max(0.0) as usize)
                ..(((centre + reach).floor() + 1.0).clamp(0.0, n as f64) as usize)
        };
        let [a, b, c] = s.conic;
        for y in range(s.centre.y, s.reach.y, p.height) {
            for x in range(s.centre.x, s.reach.x, p.width) {
                let (i, d) = (y * p.width + x, DVec2::new(x as f64, y as f64) - s.centre);
                let alpha = (s.of.opacity * (-0.5 * (a * d.x * d.x + 2.0 * b * d.x * d.y + c * d.y * d.y)).exp())
                    .min(ALPHA_MAX);
                if alpha >= ALPHA_MIN && passed[i] >= TRANSMITTANCE_MIN {
                    light[i] += passed[i] * alpha * s.of.grey;
                    passed[i] *= 1.0 - alpha;
                }
            }
        }
    }
    light
}

/// Gain and offset that take a rendering closest to an image where the camera did not saturate.
fn fitted(rendered: &[f64], image: &[f64], valid: &[u8]) -> (f64, f64) {
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for i in (0..image.len()).filter(|&i| valid[i] != 0 && (0.02..0.98).contains(&image[i])) {
        let (x, y) = (rendered[i], image[i]);
        (n, sx, sy, sxx, sxy) = (n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y);
    }
    let gain = (n * sxy - sx * sy) / (n * sxx - sx * sx).max(1e-9);
    (gain, (sy - gain * sx) / f64::max(n, 1.0))
}

fn psnr_db(rendered: impl Iterator<Item = f64>, image: &[f64], valid: &[u8]) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    for ((x, y), _) in rendered.zip(image).zip(valid).filter(|(_, v)| **v != 0) {
        (sum, n) = (sum + (x.clamp(0.0, 1.0) - y).powi(2), n + 1.0);
    }
    -10.0 * (sum / f64::max(n, 1.0)).max(1e-10).log10()
}

/// One view, scored.
struct View {
    number: usize,
    held_out: bool,
    stands_db: f64,
    fitted_db: f64,
    gain: f64,
    offset: f64,
}

impl View {
    /// How far its exposure is from the map's: of ln gain, and of the level of mid-grey.
    fn away(&self) -> f64 {
        self.gain.max(1e-3).ln().abs() + (self.offset + 0.5 * (self.gain - 1.0)).abs()
    }
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let map = read(&args.map)?;
    let recording = Recording::open(&args.dataset, &OpenOptions::default())?;
    let poses = read_trajectory(&args.poses)?;
    let out = OutputDir::create(&args.out)?;
    let rectification = Rectification::new(&recording.calibration)?;
    let camera = rectification.camera;
    let remap = rectification.map(&recording.calibration.cameras[0]);
    let valid = remap.valid_blocks(1);
    let (mut reader, mut frames) = (recording.reader(), Frames::for_rig(&recording.calibration));
    let mut left = Image::new(camera.pinhole.width, camera.pinhole.height);
    let mut views: Vec<View> = vec![];
    for (i, frame) in recording.frames.iter().enumerate() {
        let Some(world_from_body) = pose_at(&poses, frame.t, POSE_GAP_MAX) else { continue };
        if reader.read(i, &mut frames).is_err() {
            continue;
        }
        remap.apply(&frames.images[0], &mut left);
        let image: Vec<f64> = left.pixels.iter().map(|p| f64::from(*p) / 255.0).collect();
        let rendered = render(&map, &(world_from_body * camera.body_from_rect).inverse(), &camera.pinhole);
        let (gain, offset) = fitted(&rendered, &image, &valid);
        let number = views.len();
        views.push(View {
            number,
            held_out: args.holdout.is_some_and(|n| number % n as usize == n as usize - 1),
            stands_db: psnr_db(rendered.iter().copied(), &image, &valid),
            fitted_db: psnr_db(rendered.iter().map(|x| gain * x + offset), &image, &valid),
            gain,
            offset,
        });
    }
    if views.is_empty() {
        let what = "no frame has a pose in the table";
        return Err(Fault::new(
            FaultKind::Data,
            args.poses.display().to_string(),
            what,
            "name the recording's own poses",
        ));
    }
    let greys: Vec<f64> = map.iter().map(|g| g.grey).collect();
    let grey = |part: f64| percentile(&greys, part).unwrap_or(f64::NAN);
    let what = format!("{} Gaussians, grey median {:.2}, 95 % {:.2}", map.len(), grey(0.5), grey(0.95));
    let parts = vec![Part::Table(kinds(&views)), Part::Table(each(&views))];
    println!("{what}");
    Page { name: "ply", title: "What a viewer shows of the map", what, facts: vec![], parts }.finish(&out)
}

/// Means over the kinds of views.
fn kinds(views: &[View]) -> Table {
    let training: Vec<&View> = views.iter().filter(|v| !v.held_out).collect();
    let held_out: Vec<&View> = views.iter().filter(|v| v.held_out).collect();
    let mut nearest = training.clone();
    nearest.sort_by(|a, b| a.away().total_cmp(&b.away()));
    nearest.truncate(NEAREST);
    let mean = |list: &[&View], of: fn(&View) -> f64| {
        (!list.is_empty()).then(|| list.iter().map(|v| of(v)).sum::<f64>() / list.len() as f64)
    };
    let rows = [("training views", training), ("the ten nearest in exposure", nearest), ("held-out views", held_out)];
    table!("ply", "Views", &rows, |r| false, [
        text("views") => r.0,
        count("number") => r.1.len(),
        number("as it stands", "dB", 2) => mean(&r.1, |v| v.stands_db),
        number("exposure fitted", "dB", 2) => mean(&r.1, |v| v.fitted_db),
    ])
}

fn each(views: &[View]) -> Table {
    table!("ply-views", "Each view", views, |v| v.held_out, [
        count("view") => v.number,
        text("kind") => if v.held_out { "held out" } else { "training" },
        number("as it stands", "dB", 2) => v.stands_db,
        number("exposure fitted", "dB", 2) => v.fitted_db,
        number("gain", "", 3) => v.gain,
        number("offset", "", 3) => v.offset,
    ])
}
