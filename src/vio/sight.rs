//! A landmark's view by the rig as it is estimated: where each camera sits, and when each row was taken.
//!
//! Where nothing of that is estimated and shutters are global, this is `predict` and `reproject` as they
//! stand. Otherwise both cameras, the host's and the viewing one, are carried to their instants
//! (`shutter.rs`), and the view touches the cameras' columns of the rig. Residuals are taken at the
//! estimate, Jacobians at the linearisation points.

use super::landmarks::{Landmark, Observation};
use super::residuals::{predict, reproject, reproject_with_eyes, Body, Eye, Reprojection};
use super::rig::{EYE_DIM, TIME_DIM};
use super::shutter::{carry_back, Shifted};
use super::window::Window;
use crate::limits::CAMERAS_MAX;
use glam::DVec2;

/// Derivatives of a view to the rig's columns that cameras touch; the first `camera_dim` are meant.
pub type CameraColumns = [[f64; TIME_DIM + EYE_DIM * CAMERAS_MAX]; 2];

fn shifted(eye: &Eye, time_offset: f64, row: f32, slot: usize, window: &Window) -> Shifted {
    Shifted::new(&eye.body_from_cam, &window.frame(slot).twist, time_offset + eye.row_delay(row.into()))
}

/// Where a camera sits when it takes a row of the frame in `slot`.
pub fn placed(camera: usize, row: f32, slot: usize, window: &Window) -> Body {
    let eye = &window.rig.eyes()[camera];
    if window.rig.is_plain() {
        return eye.body_from_cam;
    }
    shifted(eye, window.rig.now.time_offset, row, slot, window).body_from_cam
}

/// Pixel at which the observation should be.
pub fn predicted(l: &Landmark, o: &Observation, window: &Window) -> Option<DVec2> {
    let eye = &window.rig.eyes()[o.camera as usize];
    let (host, target) = (&window.frame(l.host as usize).body, &window.frame(o.slot as usize).body);
    if window.rig.is_plain() {
        let host_eye = &window.rig.eyes()[l.host_camera as usize].body_from_cam;
        return predict(&l.point, host_eye, host, eye, target);
    }
    let host_eye = placed(l.host_camera as usize, l.host_row, l.host as usize, window);
    let eye = Eye { body_from_cam: placed(o.camera as usize, o.px[1], o.slot as usize, window), ..*eye };
    predict(&l.point, &host_eye, host, &eye, target)
}

/// Prediction minus observation, and derivatives; those to the rig, where it has columns, go to `columns`.
pub fn observe(l: &Landmark, o: &Observation, window: &Window, columns: &mut CameraColumns) -> Option<Reprojection> {
    let rig = &window.rig;
    let (h, t) = (window.frame(l.host as usize), window.frame(o.slot as usize));
    let (host_camera, camera) = (l.host_camera as usize, o.camera as usize);
    let (host_eye, eye) = (&rig.eyes_jacobian()[host_camera], &rig.eyes_jacobian()[camera]);
    let mut r = if rig.is_plain() {
        reproject(&l.point, &host_eye.body_from_cam, &h.body_jacobian, eye, &t.body_jacobian)?
    } else {
        let time_offset = rig.linearised().time_offset;
        let host = shifted(host_eye, time_offset, l.host_row, l.host as usize, window);
        let target = shifted(eye, time_offset, o.px[1], o.slot as usize, window);
        let eye = Eye { body_from_cam: target.body_from_cam, ..*eye };
        let (r, mut d) = reproject_with_eyes(&l.point, &host.body_from_cam, &h.body_jacobian, &eye, &t.body_jacobian)?;
        let d_time = carry_back(&mut d, &host, &target);
        for (k, row) in columns.iter_mut().enumerate() {
            row.fill(0.0);
            if rig.parts.time_offset {
                row[0] = d_time[k];
            }
            for (camera, d) in [(host_camera, &d.host[k]), (camera, &d.target[k])] {
                if let Some(at) = rig.eye_column(camera) {
                    row[at..].iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
                }
            }
        }
        r
    };
    if h.anchored || t.anchored || rig.anchored {
        r.px = predicted(l, o, window)?;
    }
    r.px -= o.px();
    Some(r)
}
