//! Offset in time, axes, attitude and bias of gyro and camera 0, judged.

use super::agreement::{Agreement, Fine};
use super::coarse::{Coarse, CORRELATED};
use super::Check;
use glam::{DMat3, DVec3};

/// Deviation of a rate from which on two that do not correlate are a fault, rad/s.
const TURNING_MIN: f64 = 0.1;
/// Deviations above which nothing is said: s, degrees.
const OFFSET_SIGMA_MAX: f64 = 2e-3;
const TURNED_SIGMA_MAX: f64 = 1.0;
/// Images 8 ms late cost odometry eight times its error (README), and on simulated flights the offset is found to 0.9 ms.
const OFFSET_OK: f64 = 1.5e-3;
const OFFSET_FAIL: f64 = 8e-3;
/// Degrees. A hand-held recording of good calibration is found 1.0 off, beyond its deviation.
const TURNED_OK: f64 = 2.0;
const TURNED_FAIL: f64 = 5.0;

const ADVICE: &str = "turn the rig by hand about all three axes for ten seconds, before something with corners in it";

/// One line each of what cameras and gyro say of each other.
pub fn checks(found: Option<&Agreement>) -> Vec<Check> {
    let Some(a) = found else {
        return vec![Check::warn("camera against gyro: too few frames with points to say", ADVICE)];
    };
    let c = &a.coarse;
    let rms = [0, 1, 2].map(|axis| c.excitation.col(axis)[axis]);
    let turned = {
        let [x, y, z] = rms.map(f64::sqrt);
        format!("turned {x:.2}, {y:.2}, {z:.2} rad/s rms about the camera's x, y, z")
    };
    // What turns little correlates little, and is no fault.
    let turning = c.gyro_sigma.max(rms.iter().sum::<f64>().sqrt());
    if c.correlation < CORRELATED && turning > TURNING_MIN {
        let what =
            format!("camera against gyro: the rates do not agree at any offset ({:.2}); {turned}", c.correlation);
        let fix = "check that both sensors are fixed to one another, the lens calibration, and which camera is which";
        return vec![Check::fail(what, fix)];
    }
    let axes = axes(c, &turned);
    let Some(fine) = &a.fine else {
        let what = format!(
            "camera against gyro: about {:+.1} ms by their rates alone; odometry does not follow the rig to tell it with \
             extrinsics and bias",
            1e3 * c.offset_s
        );
        return vec![axes, Check::warn(what, ADVICE)];
    };
    vec![offset(fine), axes, extrinsics(fine, c, a.frames), bias(fine)]
}

fn bias(f: &Fine) -> Check {
    let (b, s) = (f.bias, f.bias_sigma.max_element());
    let what = format!("gyro bias in motion: {:+.4}, {:+.4}, {:+.4} rad/s, each ± {s:.4}", b.x, b.y, b.z);
    match () {
        _ if s > 0.02 => Check::warn(what, ADVICE),
        _ if b.length() > 0.1 => Check::warn(what, "a large bias: let the unit warm up, or calibrate it"),
        _ => Check::ok(what),
    }
}

/// The axis of camera 0 about which it turned least, and how to turn more.
fn least_turned(c: &Coarse) -> String {
    let eigen = nalgebra::Matrix3::from(c.excitation.to_cols_array_2d()).symmetric_eigen();
    let axis = eigen.eigenvectors.column(eigen.eigenvalues.imin()).iamax();
    let way = ["x (nod)", "y (left and right)", "z (roll)"][axis];
    format!("turn more about the camera's {way}, to and fro, before something with corners in it")
}

fn offset(a: &Fine) -> Check {
    let (ms, sigma) = (1e3 * a.offset_s, 1e3 * a.offset_sigma_s);
    if a.offset_sigma_s > OFFSET_SIGMA_MAX {
        let what = format!("time offset: {ms:+.1} ± {sigma:.1} ms, too unsure to say: the rate changed too little or not for long enough");
        return Check::warn(what, "turn the rig to and fro, faster, before something with corners in it");
    }
    let what = format!("time offset: the gyro's clock is {ms:+.2} ± {sigma:.2} ms ahead of what the calibration says");
    let fix = format!(
        "add {:+.4} s to timeshift_cam_imu; vio.estimate_time_offset = true takes out what is left",
        a.offset_s
    );
    match a.offset_s.abs() - 2.0 * a.offset_sigma_s {
        s if s < OFFSET_OK => Check::ok(what),
        s if s < OFFSET_FAIL => Check::warn(what, fix),
        _ => Check::fail(what, fix),
    }
}

fn axes(a: &Coarse, turned: &str) -> Check {
    let names = ["x", "y", "z"];
    let fix = "correct the mounting matrix of the unit";
    if a.axes == DMat3::IDENTITY {
        return match a.handed {
            true => Check::ok(format!("axes: right-handed; {turned}")),
            false => Check::warn(format!("axes: {turned}: not enough to tell their signs"), least_turned(a)),
        };
    }
    let signs = DVec3::new(a.axes.x_axis.x, a.axes.y_axis.y, a.axes.z_axis.z);
    let flipped: Vec<usize> = (0..3).filter(|k| signs[*k] < 0.0).collect();
    if signs.abs() == DVec3::ONE && flipped.len() == 1 {
        let what = format!("axes: the gyro's {} axis has the wrong sign", names[flipped[0]]);
        return Check::fail(what, format!("{fix}: its axes are left-handed"));
    }
    let reads = |body: usize| {
        let row = a.axes.row(body);
        let axis = (0..3).find(|k| row[*k] != 0.0).unwrap_or(body);
        format!("{}{}", if row[axis] < 0.0 { "-" } else { "" }, names[axis])
    };
    let hand = if a.axes.determinant() < 0.0 { "; as read they are left-handed" } else { "" };
    let what = format!("axes: the body's x, y, z are the gyro's {}, {}, {}{hand}", reads(0), reads(1), reads(2));
    Check::fail(what, format!("{fix}, or body_from_cam of every camera"))
}

fn extrinsics(f: &Fine, coarse: &Coarse, frames: usize) -> Check {
    let angle = f.turned.length().to_degrees();
    let about = f.turned.normalize_or_zero();
    let sigma = (about * f.turned_sigma).length().to_degrees();
    let most = f.turned_sigma.max_element().to_degrees();
    if most > TURNED_SIGMA_MAX {
        return Check::warn(format!("extrinsics: known to ± {most:.1}° only"), least_turned(coarse));
    }
    let what = format!(
        "extrinsics: camera 0 is {angle:.2} ± {sigma:.2}° about ({:.2}, {:.2}, {:.2}) from where the calibration has it \
         ({frames} frames)",
        about.x, about.y, about.z
    );
    let fix = "calibrate body_from_cam of camera 0 anew";
    match angle - 2.0 * sigma {
        d if d < TURNED_OK => Check::ok(what),
        d if d < TURNED_FAIL => Check::warn(what, fix),
        _ => Check::fail(what, fix),
    }
}
