//! The cameras that train the map: what each sees of a keyframe, through which lens, and which of its pixels count.
//!
//! `rectified`: the left view of the pair, then the right one, as pinholes. `fisheye`: each raw Kannala-Brandt image
//! as it is, with its own intrinsics; the pair is then rectified only for its depth (`Pair`). All have one size.

use super::keyframes::Keyframe;
use super::view::{Fisheye, View};
use crate::config::{MapConfig, Projection};
use crate::mem::Footprint;
use crate::stereo::rectify::box_average;
use crate::stereo::{DepthMap, Pinhole, Stereo};
use glam::{DVec2, DVec3};
use stipple_drivers::{Calibration, Fault, FaultKind, Image, Lens, Pose, RigCamera};

/// One camera that trains.
#[derive(Clone, Debug)]
pub struct Eye {
    pub camera: Pinhole,
    pub fisheye: Option<Fisheye>,
    pub body_from_cam: Pose,
    /// Zero where a pixel does not count.
    pub valid: Vec<u8>,
}

impl Eye {
    pub fn view(&self, world_from_body: Pose) -> View {
        View { world_from_cam: world_from_body * self.body_from_cam, camera: self.camera, fisheye: self.fisheye }
    }
}

/// Farther off the axis a pixel does not count, rad: lenses are calibrated to about here, and beyond are their mounts.
const ANGLE_MAX: f64 = 1.65;

/// How many of a rig's cameras train. A rig may have fewer than the board would let.
pub fn count(cameras: usize, config: &MapConfig) -> usize {
    let most = if config.projection == Projection::Rectified { 2 } else { cameras };
    (config.cameras as usize).min(most)
}

/// Images of a keyframe that the mapper is handed: those that train, and the pair that depth comes from.
pub fn images(cameras: usize, config: &MapConfig) -> usize {
    count(cameras, config).max(2)
}

/// Of the images that train, how many in colour.
pub fn colours(cameras: usize, config: &MapConfig) -> usize {
    if config.colour {
        count(cameras, config)
    } else {
        0
    }
}

/// Of a colour, whichever camera's.
pub fn channels(config: &MapConfig) -> usize {
    if config.colour {
        3
    } else {
        1
    }
}

pub fn footprint(calibration: &Calibration, config: &MapConfig, pixels: usize) -> Footprint {
    let n = count(calibration.cameras.len(), config);
    let mut f = Footprint::default();
    f.host("map: masks of the cameras", n * pixels);
    if config.projection == Projection::Fisheye {
        f.host("map: rectified image to seed from", channels(config) * pixels);
        f.host("map: depth as the fisheye sees it", pixels * (size_of::<u32>() + 2 * size_of::<f32>()));
    }
    f
}

/// The rectified pair beside a fisheye map: the image that seeds take their colour from, and its depth as the left lens
/// sees it.
///
/// Both views have one centre, so the ray of a raw pixel meets the rectified view in one place, and that pixel's depth is
/// its own. It is taken from the nearest, not between several: that would invent surfaces between foreground and background.
/// It is a distance along the ray, as the fisheye's raster counts it, since z shrinks towards 90 degrees and changes sign
/// beyond. Beyond the rectified view (50 degrees off its axis) there is none.
pub struct Pair {
    /// Grey, or red, green and blue.
    pub planes: Vec<Image>,
    pub distance: DepthMap,
    /// By raw pixel at mapping resolution: the rectified one, or `NONE`.
    rectified: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl Pair {
    /// `None` where the rectified view itself trains.
    pub fn new(stereo: &Stereo, left: &Eye, channels: usize) -> Option<Pair> {
        left.fisheye?;
        let rect = stereo.camera();
        let Pinhole { width, height, fx, fy, cx, cy } = rect.pinhole;
        let rect_from_cam = rect.body_from_rect.inverse() * left.body_from_cam;
        let ray = View { world_from_cam: rect_from_cam, camera: left.camera, fisheye: left.fisheye };
        let of = |i: usize| {
            let p = ray.point(i % width, i / width, 1.0).filter(|p| p.z > 0.0)?;
            let (x, y) = ((fx * p.x / p.z + cx).round(), (fy * p.y / p.z + cy).round());
            let inside = (0.0..width as f64).contains(&x) && (0.0..height as f64).contains(&y);
            inside.then(|| (y as usize * width + x as usize) as u32)
        };
        Some(Pair {
            planes: vec![Image::new(width, height); channels],
            distance: DepthMap::new(width, height),
            rectified: (0..width * height).map(|i| of(i).unwrap_or(NONE)).collect(),
        })
    }

    /// From depth along the rectified axis.
    pub fn bend(&mut self, depth: &DepthMap, rect: &Pinhole) {
        let DepthMap { metres, sigma_m, .. } = &mut self.distance;
        for ((to, sigma), &from) in metres.iter_mut().zip(sigma_m).zip(&self.rectified) {
            let (x, y) = ((from as usize % rect.width) as f64, (from as usize / rect.width) as f64);
            let stretch = DVec3::new((x - rect.cx) / rect.fx, (y - rect.cy) / rect.fy, 1.0).length() as f32;
            let of = |plane: &[f32]| plane.get(from as usize).map_or(0.0, |z| z * stretch);
            (*to, *sigma) = (of(&depth.metres), of(&depth.sigma_m));
        }
    }
}

pub fn eyes(stereo: &Stereo, config: &MapConfig) -> Result<Vec<Eye>, Fault> {
    let rig = stereo.rig();
    let one = |i: usize| match config.projection {
        Projection::Rectified => Ok(Eye {
            camera: stereo.camera().pinhole,
            fisheye: None,
            body_from_cam: Pose { p: rig[i].body_from_cam.p, ..stereo.camera().body_from_rect },
            valid: stereo.valid_of(i),
        }),
        Projection::Fisheye => bent(i, &rig[i], &stereo.camera().pinhole, config.scale as usize),
    };
    (0..count(rig.len(), config)).map(one).collect()
}

fn bent(i: usize, c: &RigCamera, mapping: &Pinhole, divisor: usize) -> Result<Eye, Fault> {
    let bad =
        |what: String| Fault::new(FaultKind::Config, "map.projection", what, "set map.projection = \"rectified\"");
    let Lens::KannalaBrandt { k } = c.camera.lens else {
        return Err(bad(format!("\"fisheye\" needs Kannala-Brandt lenses, camera {i} has {:?}", c.camera.lens)));
    };
    let raw = &c.camera;
    let full = Pinhole { width: raw.width, height: raw.height, fx: raw.fx, fy: raw.fy, cx: raw.cx, cy: raw.cy };
    let camera = full.divided(divisor);
    if (camera.width, camera.height) != (mapping.width, mapping.height) {
        let what = format!("camera {i} is {}x{} px, camera 0 is not", raw.width, raw.height);
        return Err(bad(format!("\"fisheye\" needs images of one size: {what}")));
    }
    let within = |x: usize, y: usize| {
        let centre = |v: usize| (v as f64 + 0.5) * divisor as f64 - 0.5;
        let bearing = raw.unproject(DVec2::new(centre(x), centre(y)));
        u8::from(bearing.is_some_and(|b| b.z.clamp(-1.0, 1.0).acos() <= ANGLE_MAX))
    };
    let valid = (0..camera.width * camera.height).map(|i| within(i % camera.width, i / camera.width)).collect();
    Ok(Eye { camera, fisheye: Some(Fisheye::new(k, &camera)), body_from_cam: c.body_from_cam, valid })
}

/// One plane of what camera `i` saw, raw.
pub fn raw(keyframe: &Keyframe, i: usize, channel: usize) -> &Image {
    keyframe.colours.get(i).map_or(&keyframe.images[i], |colour| &colour[channel])
}

/// The image of camera `i` that trains, from its raw one.
pub fn draw(i: usize, eye: &Eye, stereo: &mut Stereo, raw: &Image, out: &mut Image) {
    match eye.fisheye {
        None => stereo.rectify_of(i, raw, out),
        Some(_) => box_average(raw, stereo.divisor(), out),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::StereoConfig;
    use glam::{DQuat, DVec3};
    use stipple_drivers::{Camera, ImuCalibration};

    fn rig() -> Calibration {
        let lens = Lens::KannalaBrandt { k: [0.0034, 0.0008, -0.0017, 0.0003] };
        let camera = Camera { width: 128, height: 120, fx: 48.0, fy: 48.5, cx: 63.1, cy: 60.2, lens };
        let left = Pose::new(DQuat::from_rotation_x(0.05), DVec3::new(0.2, 0.1, 0.0));
        let right = Pose::new(DQuat::from_rotation_y(0.04), DVec3::new(0.3, 0.1, 0.0));
        let cameras = vec![RigCamera::new(camera, left), RigCamera::new(camera, right)];
        Calibration { cameras, imu: ImuCalibration::CONSUMER }
    }

    /// A floor seen by the rectified view is the same floor seen by the raw lens.
    #[test]
    fn depth_of_the_pair_is_bent_to_distance_along_the_raw_lens_rays() {
        let stereo = Stereo::new(&rig(), &StereoConfig::default(), 1, None).expect("a sound rig");
        let config = MapConfig { projection: Projection::Fisheye, ..MapConfig::default() };
        let eye = eyes(&stereo, &config).expect("Kannala-Brandt lenses").remove(0);
        let rect = stereo.camera();
        let flat = View { world_from_cam: rect.body_from_rect, camera: rect.pinhole, fisheye: None };
        // y down: half a metre below the rig, as far as 4 m.
        let floor = |x: usize, y: usize| {
            let ray = flat.point(x, y, 1.0).expect("pinholes see everywhere") - flat.world_from_cam.p;
            let z = 0.5 / ray.y;
            if (0.0..4.0).contains(&z) {
                z as f32
            } else {
                0.0
            }
        };
        let (w, h) = (rect.pinhole.width, rect.pinhole.height);
        let metres = (0..w * h).map(|i| floor(i % w, i / w)).collect();
        let mut pair = Pair::new(&stereo, &eye, 1).expect("a fisheye trains");
        pair.bend(&DepthMap::of(w, h, metres), &rect.pinhole);
        let raw = eye.view(Pose::IDENTITY);
        let (mut seen, mut worst) = (0, 0.0f64);
        for (i, &r) in pair.distance.metres.iter().enumerate().filter(|(_, r)| **r > 0.0) {
            let p = raw.point(i % w, i / w, f64::from(r)).expect("inside the lens");
            // Half a rectified pixel off, of a floor seen at a slant.
            let slant = f64::from(r).powi(2) / 0.5 / rect.pinhole.fx;
            worst = worst.max((p.y - raw.world_from_cam.p.y - 0.5).abs() / slant);
            seen += 1;
        }
        assert!(seen > 1000 && worst < 0.6, "{seen} px, off by {worst} px");
        assert!(pair.distance.metres[..w].iter().all(|r| *r == 0.0), "the ceiling has no depth");
    }
}
