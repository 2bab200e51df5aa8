//! Rectified pairs with true disparity: Middlebury's from files, and flights of the simulator.
//!
//! The simulator renders EuRoC's rig, distortion and noise included; its images go through the rectification of
//! a run. Truth comes from two more cameras of the same rig, which are the rectified ones.

use std::ops::Range;
use std::path::Path;
use stipple::stereo::rectify::Rectification;
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Camera, Fault, FaultKind, Frames, Image, Lens, Pose, RigCamera};

pub struct Pair {
    pub left: Image,
    pub right: Image,
    /// Disparity of the left image, px; negative where unknown.
    pub truth: Vec<f32>,
    /// The right camera sees it too.
    pub visible: Vec<bool>,
}

/// Pairs of one size that are judged together.
pub struct Set {
    pub name: String,
    pub about: String,
    pub pairs: Vec<Pair>,
    pub disparities: u32,
    /// Depth times disparity, m px, where the rig is known.
    pub focal_baseline: Option<f64>,
}

impl Set {
    pub fn size(&self) -> (usize, usize) {
        (self.pairs[0].left.width, self.pairs[0].left.height)
    }
}

const MIDDLEBURY: [&str; 2] = ["middlebury_cones", "middlebury_teddy"];
/// Covers both scenes: 55 px at most.
const MIDDLEBURY_DISPARITIES: u32 = 64;
/// Disparities that differ by more between the eyes are of two surfaces, px.
const SAME_PX: f32 = 1.0;

/// Middlebury's pairs that are in the folder of recordings.
pub fn middlebury(folder: &Path) -> Result<Vec<Set>, Fault> {
    let mut sets = vec![];
    for name in MIDDLEBURY {
        let files = folder.join(name);
        if !files.is_dir() {
            continue;
        }
        let (left, right) = (grey(&files.join("im2.png"))?, grey(&files.join("im6.png"))?);
        let truth = quarters(&pgm(&files.join("disp2.pgm"))?);
        let from_right = quarters(&grey(&files.join("disp6.png"))?);
        let visible = visible(left.width, &truth, &from_right);
        sets.push(Set {
            name: name.to_string(),
            about: "Scharstein and Szeliski, CVPR 2003, a quarter of full size".into(),
            pairs: vec![Pair { left, right, truth, visible }],
            disparities: MIDDLEBURY_DISPARITIES,
            focal_baseline: None,
        });
    }
    Ok(sets)
}

/// Pixels whose disparity in the right image is known and agrees at the place that the left one's points to.
fn visible(width: usize, left: &[f32], right: &[f32]) -> Vec<bool> {
    let of = |i: usize| {
        let x = (i % width) as f32 - left[i];
        let j = i - i % width + x.round().max(0.0) as usize;
        left[i] >= 0.0 && x >= -0.5 && (right[j] - left[i]).abs() <= SAME_PX
    };
    (0..left.len()).map(of).collect()
}

/// Quarters of a pixel, 0 where unknown.
fn quarters(stored: &Image) -> Vec<f32> {
    stored.pixels.iter().map(|p| if *p > 0 { f32::from(*p) / 4.0 } else { -1.0 }).collect()
}

fn unreadable(path: &Path, what: impl std::fmt::Display) -> Fault {
    Fault::new(FaultKind::Data, path.display().to_string(), format!("cannot read: {what}"), "fetch the file again")
}

/// Colours by their luma (ITU-R BT.601).
fn grey(path: &Path) -> Result<Image, Fault> {
    let file = std::fs::File::open(path).map_err(|e| unreadable(path, e))?;
    let mut decoder = png::Decoder::new(std::io::BufReader::new(file));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(|e| unreadable(path, e))?;
    let mut bytes = vec![0; reader.output_buffer_size().ok_or_else(|| unreadable(path, "too large"))?];
    let info = reader.next_frame(&mut bytes).map_err(|e| unreadable(path, e))?;
    let mut image = Image::new(info.width as usize, info.height as usize);
    let channels = info.color_type.samples();
    for (px, c) in image.pixels.iter_mut().zip(bytes.chunks_exact(channels)) {
        let luma = |c: &[u8]| (299 * u32::from(c[0]) + 587 * u32::from(c[1]) + 114 * u32::from(c[2]) + 500) / 1000;
        *px = if channels >= 3 { luma(c) as u8 } else { c[0] };
    }
    Ok(image)
}

/// A binary grey map of 8 bits.
fn pgm(path: &Path) -> Result<Image, Fault> {
    let bytes = std::fs::read(path).map_err(|e| unreadable(path, e))?;
    let mut words = vec![];
    let mut at = 0;
    while words.len() < 4 && at < bytes.len() {
        let end = bytes[at..].iter().position(|b| b.is_ascii_whitespace()).map_or(bytes.len(), |n| at + n);
        let word = String::from_utf8_lossy(&bytes[at..end]).into_owned();
        match word.starts_with('#') {
            true => at = bytes[at..].iter().position(|b| *b == b'\n').map_or(bytes.len(), |n| at + n + 1),
            false => {
                at = end + 1;
                words.extend((!word.is_empty()).then_some(word));
            }
        }
    }
    let number = |i: usize| words.get(i).and_then(|w| w.parse::<usize>().ok());
    let (Some("P5"), Some(width), Some(height), Some(255)) =
        (words.first().map(String::as_str), number(1), number(2), number(3))
    else {
        return Err(unreadable(path, "not a binary PGM of 8 bits"));
    };
    let pixels = bytes.get(at..at + width * height).ok_or_else(|| unreadable(path, "is cut short"))?.to_vec();
    Ok(Image { width, height, pixels })
}

/// Range that is called near, m, and how many frames of a flight are looked at for it.
const NEAR_M: Range<f32> = 0.5..1.0;
const LOOKED_AT: usize = 48;

/// The `count` of these frames in which most is near, if anything is.
fn nearest(sim: &mut Sim, frames: Range<usize>, count: usize, depth: &mut [f32]) -> Vec<usize> {
    let mut found: Vec<(usize, usize)> = vec![];
    for i in frames.clone().step_by((frames.len() / LOOKED_AT).max(1)) {
        sim.depth(i, 2, depth);
        found.push((depth.iter().filter(|z| NEAR_M.contains(z)).count(), i));
    }
    found.sort_unstable_by(|a, b| b.cmp(a));
    found.into_iter().filter(|(near, _)| *near > 0).take(count).map(|(_, i)| i).collect()
}

/// Frames of a flight through a run's rectification: of `frames` the middles of `even` equal parts, and the `near` that see
/// most of what is near.
pub fn simulated(mut scenario: Scenario, frames: Range<usize>, even: usize, near: usize) -> Result<Set, Fault> {
    scenario.image_divisor = 1;
    let rectification = Rectification::new(&scenario.calibration)?;
    let rect = rectification.camera;
    let p = rect.pinhole;
    let maps = [0, 1].map(|i| rectification.map(&scenario.calibration.cameras[i]));
    let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
    let camera = Camera { width: p.width, height: p.height, fx: p.fx, fy: p.fy, cx: p.cx, cy: p.cy, lens };
    for i in 0..2 {
        let at = Pose { p: scenario.calibration.cameras[i].body_from_cam.p, ..rect.body_from_rect };
        scenario.calibration.cameras.push(RigCamera::new(camera, at));
    }
    let focal_baseline = p.fx * rect.baseline_m;
    let mut sim = Sim::new(&scenario)?;
    let mut images = Frames::for_rig(sim.calibration());
    let (mut left_z, mut right_z) = (vec![0.0; p.width * p.height], vec![0.0; p.width * p.height]);
    let disparity = |z: &f32| if *z > 0.0 { (focal_baseline / f64::from(*z)) as f32 } else { -1.0 };
    let mut pairs = vec![];
    let flown = frames.start..frames.end.min(sim.frame_count());
    let mut chosen: Vec<usize> = (0..even).map(|k| flown.start + flown.len() * (2 * k + 1) / (2 * even)).collect();
    chosen.extend(nearest(&mut sim, flown, near, &mut left_z));
    for i in chosen {
        sim.render(i, &mut images);
        sim.depth(i, 2, &mut left_z);
        sim.depth(i, 3, &mut right_z);
        let rectified = [0, 1].map(|eye: usize| {
            let mut image = Image::new(p.width, p.height);
            maps[eye].apply(&images.images[eye], &mut image);
            image
        });
        let [left, right] = rectified;
        let truth: Vec<f32> = left_z.iter().map(disparity).collect();
        let from_right: Vec<f32> = right_z.iter().map(disparity).collect();
        let visible = visible(p.width, &truth, &from_right);
        pairs.push(Pair { left, right, truth, visible });
    }
    Ok(Set {
        name: format!("sim_{}", scenario.name),
        about: format!("{} frames of a simulated flight with EuRoC's rig, 752x480", pairs.len()),
        pairs,
        disparities: 128,
        focal_baseline: Some(focal_baseline),
    })
}
