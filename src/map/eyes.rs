//! The cameras that train the map: what each sees of a keyframe, through which lens, and which of its pixels count.
//!
//! `rectified`: the left view of the pair, then the right one, as pinholes. `fisheye`: each raw Kannala-Brandt image
//! as it is, with its own intrinsics; the pair is then rectified only to seed from its depth. All have one size.

use super::view::{Fisheye, View};
use crate::config::{MapConfig, Projection};
use crate::mem::Footprint;
use crate::stereo::rectify::box_average;
use crate::stereo::{Pinhole, Stereo};
use glam::DVec2;
use stipple_drivers::{Calibration, Exit, Fault, Image, Lens, Pose, RigCamera};

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

pub fn footprint(calibration: &Calibration, config: &MapConfig, pixels: usize) -> Footprint {
    let n = count(calibration.cameras.len(), config);
    let mut f = Footprint::default();
    f.host("map: masks of the cameras", n * pixels);
    if config.projection == Projection::Fisheye {
        f.host("map: rectified image to seed from", pixels);
    }
    f
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
    let bad = |what: String| Fault::new(Exit::Config, "map.projection", what, "set map.projection = \"rectified\"");
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

/// The image of camera `i` that trains, from its raw one.
pub fn draw(i: usize, eye: &Eye, stereo: &mut Stereo, raw: &Image, out: &mut Image) {
    match eye.fisheye {
        None => stereo.rectify_of(i, raw, out),
        Some(_) => box_average(raw, stereo.divisor(), out),
    }
}
