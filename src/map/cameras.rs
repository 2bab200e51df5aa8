//! The cameras that train the map: what each sees of a keyframe, through which lens, and which of its pixels count.
//!
//! `rectified`: the left view of the pair, then the right one, as pinholes. `fisheye`: each raw Kannala-Brandt image
//! as it is, with its own intrinsics; the pair is then rectified only for its depth (`RectifiedPair`). All have one size.

use super::view::{Fisheye, View};
use crate::config::{MapConfig, Projection};
use crate::stereo::rectify::box_average;
use crate::stereo::{DepthMap, Pinhole, RectifiedViews};
use glam::{DVec2, DVec3};
use stipple_drivers::{Fault, FaultKind, Image, Lens, Pose, RigCamera};

/// One camera that trains.
#[derive(Clone, Debug)]
pub struct TrainingCamera {
    pub camera: Pinhole,
    pub fisheye: Option<Fisheye>,
    pub body_from_cam: Pose,
    /// Zero where a pixel does not count.
    pub valid: Vec<u8>,
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

/// Images of them that are wanted in colour.
pub fn colours(cameras: usize, config: &MapConfig) -> usize {
    if config.colour {
        count(cameras, config)
    } else {
        0
    }
}

/// Channels of a colour, whichever camera's.
pub fn channels(config: &MapConfig) -> usize {
    if config.colour {
        3
    } else {
        1
    }
}

/// The rectified pair beside a fisheye map: the image that seeds take their colour from, and its depth as the left lens
/// sees it.
///
/// Both views have one centre, so the ray of a raw pixel meets the rectified view in one place, and that pixel's depth is
/// its own. It is taken from the nearest, not between several: that would invent surfaces between foreground and background.
/// It is a distance along the ray, as the fisheye's raster counts it, since z shrinks towards 90 degrees and changes sign
/// beyond. Beyond the rectified view (50 degrees off its axis) there is none.
pub struct RectifiedPair {
    /// Grey, or red, green and blue.
    pub planes: Vec<Image>,
    /// Distance along the ray of each pixel.
    pub distance: DepthMap,
    /// By raw pixel at mapping resolution: the rectified one, or `NONE`.
    rectified: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl RectifiedPair {
    /// `None` where the rectified view itself trains.
    pub fn new(views: &RectifiedViews, left: &TrainingCamera, channels: usize) -> Option<RectifiedPair> {
        left.fisheye?;
        let Pinhole { width, height, .. } = views.camera().pinhole;
        let mut pair = RectifiedPair {
            planes: vec![Image::new(width, height); channels],
            distance: DepthMap::new(width, height),
            rectified: vec![NONE; width * height],
        };
        pair.adjust(views, left);
        Some(pair)
    }

    /// Takes over another rectification.
    pub fn adjust(&mut self, views: &RectifiedViews, left: &TrainingCamera) {
        let rect = views.camera();
        let Pinhole { width, height, fx, fy, cx, cy } = rect.pinhole;
        let rect_from_cam = rect.body_from_rect.inverse() * left.body_from_cam;
        let ray = View::new(rect_from_cam, left.camera, left.fisheye);
        let of = |i: usize| {
            let p = ray.point(i % width, i / width, 1.0).filter(|p| p.z > 0.0)?;
            let (x, y) = ((fx * p.x / p.z + cx).round(), (fy * p.y / p.z + cy).round());
            let inside = (0.0..width as f64).contains(&x) && (0.0..height as f64).contains(&y);
            inside.then(|| (y as usize * width + x as usize) as u32)
        };
        self.rectified.iter_mut().enumerate().for_each(|(i, to)| *to = of(i).unwrap_or(NONE));
    }

    /// Takes over depth along the rectified axis.
    pub fn distort(&mut self, depth: &DepthMap, rect: &Pinhole) {
        for (i, from) in self.rectified.iter().map(|from| *from as usize).enumerate() {
            let (x, y) = ((from % rect.width) as f64, (from / rect.width) as f64);
            let stretch = DVec3::new((x - rect.cx) / rect.fx, (y - rect.cy) / rect.fy, 1.0).length() as f32;
            let stretched = |of: &[f32]| of.get(from).map_or(0.0, |z| z * stretch);
            self.distance.metres[i] = stretched(&depth.metres);
            self.distance.sigma_m[i] = stretched(&depth.sigma_m);
        }
    }
}

/// The cameras that train, of a rectified rig.
pub fn training(views: &RectifiedViews, config: &MapConfig) -> Result<Vec<TrainingCamera>, Fault> {
    let rig = views.rig();
    let one = |i: usize| match config.projection {
        Projection::Rectified => Ok(TrainingCamera {
            camera: views.camera().pinhole,
            fisheye: None,
            body_from_cam: views.body_from_rect(i),
            valid: views.valid_of(i),
        }),
        Projection::Fisheye => fisheye(i, &rig[i], &views.camera().pinhole, config.scale as usize),
    };
    (0..count(rig.len(), config)).map(one).collect()
}

/// Takes over where the cameras sit by now. Where rectification was made `anew`, pixels count that it draws now and drew each
/// time before: all images of a camera have one mask.
pub fn adjust(cameras: &mut [TrainingCamera], views: &RectifiedViews, anew: bool) {
    for (i, camera) in cameras.iter_mut().enumerate() {
        camera.body_from_cam = match camera.fisheye {
            Some(_) => views.rig()[i].body_from_cam,
            None => views.body_from_rect(i),
        };
        if anew && camera.fisheye.is_none() {
            views.mask(i, &mut camera.valid);
        }
    }
}

fn fisheye(i: usize, c: &RigCamera, mapping: &Pinhole, divisor: usize) -> Result<TrainingCamera, Fault> {
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
        let bearing = raw.unproject(DVec2::new(centre(x), centre(y))).filter(|_| !c.is_masked(centre(x), centre(y)));
        u8::from(bearing.is_some_and(|b| b.z.clamp(-1.0, 1.0).acos() <= ANGLE_MAX))
    };
    let valid = (0..camera.width * camera.height).map(|i| within(i % camera.width, i / camera.width)).collect();
    Ok(TrainingCamera { camera, fisheye: Some(Fisheye::new(k, &camera)), body_from_cam: c.body_from_cam, valid })
}

/// The image of camera `i` that trains, from its raw one.
pub fn draw(i: usize, camera: &TrainingCamera, views: &mut RectifiedViews, raw: &Image, out: &mut Image) {
    match camera.fisheye {
        None => views.rectify(i, raw, out),
        Some(_) => box_average(raw, views.divisor(), out),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use stipple_drivers::calibration::Mask;
    use stipple_drivers::{Calibration, Camera, ImuCalibration};

    fn rig() -> Calibration {
        let lens = Lens::KannalaBrandt { k: [0.0034, 0.0008, -0.0017, 0.0003] };
        let camera = Camera { width: 128, height: 120, fx: 48.0, fy: 48.5, cx: 63.1, cy: 60.2, lens };
        let left = Pose::new(DQuat::from_rotation_x(0.05), DVec3::new(0.2, 0.1, 0.0));
        let right = Pose::new(DQuat::from_rotation_y(0.04), DVec3::new(0.3, 0.1, 0.0));
        let cameras = vec![RigCamera::new(camera, left), RigCamera::new(camera, right)];
        Calibration { cameras, imu: ImuCalibration::CONSUMER }
    }

    #[test]
    fn pixels_of_the_vehicle_do_not_train() {
        let mut masked = rig();
        masked.cameras[0].masks[0] = Mask { left: 10, top: 70, right: 110, bottom: 120 };
        for projection in [Projection::Rectified, Projection::Fisheye] {
            let config = MapConfig { projection, cameras: 2, ..MapConfig::default() };
            let counts = [rig(), masked.clone()].map(|rig| {
                let views = RectifiedViews::new(&rig, 1).expect("a sound rig");
                let cameras = training(&views, &config).expect("Kannala-Brandt lenses");
                let all = |camera: usize| cameras[camera].valid.iter().filter(|v| **v != 0).count();
                [all(0), all(1)]
            });
            assert!(counts[1][0] + 2000 < counts[0][0] && counts[1][1] == counts[0][1], "{projection:?}: {counts:?}");
        }
    }

    /// A floor seen by the rectified view is the same floor seen by the raw lens.
    #[test]
    fn depth_of_the_pair_becomes_distance_along_the_raw_lens_rays() {
        let views = RectifiedViews::new(&rig(), 1).expect("a sound rig");
        let config = MapConfig { projection: Projection::Fisheye, ..MapConfig::default() };
        let left = training(&views, &config).expect("Kannala-Brandt lenses").remove(0);
        let rect = views.camera();
        let flat = View::new(rect.body_from_rect, rect.pinhole, None);
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
        let metres: Vec<f32> = (0..w * h).map(|i| floor(i % w, i / w)).collect();
        let mut pair = RectifiedPair::new(&views, &left, 1).expect("a fisheye trains");
        let sigma_m = metres.iter().map(|z| 0.125 * z).collect();
        pair.distort(&DepthMap { sigma_m, ..DepthMap::of(w, h, metres) }, &rect.pinhole);
        assert!(pair.distance.metres.iter().zip(&pair.distance.sigma_m).all(|(m, sigma)| 0.125 * m == *sigma));
        let raw = View::new(left.body_from_cam, left.camera, left.fisheye);
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
