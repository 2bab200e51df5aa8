//! Calibration files: EuRoC sensor.yaml (`T_BS` = body_from_cam), Kalibr camchain.yaml (`T_cam_imu` = cam_from_body) with
//! imu_config.yaml beside it, Basalt json (`T_imu_cam` = body_from_cam). The body is the inertial unit. Distortion: none,
//! Brown with four coefficients or eight (rational), Kannala-Brandt, double sphere; any other model is refused, since a
//! wrong lens looks like noise to an estimator.
//!
//! Time: `timeshift_cam_imu` and `cam_time_offset_ns` become `RigCamera::time_offset`. A camera of the yaml files is rolling
//! where it has `readout_time` (s, first row to last), `line_delay` (s per row, as Kalibr's rolling-shutter calibration
//! prints) or `shutter: rolling`; the last alone is refused unless the board file states the time. The board file's time
//! replaces that of the files.
//!
//! Noise: `noise_source: measured` beside the figures says that they were measured on this unit (`stipple calib-noise` prints
//! it with them); without it they are taken for those of a data sheet.

use super::cameras;
use super::findings::Findings;
use crate::calibration::{Calibration, ImuCalibration, ImuCorrection, RigCamera};
use crate::camera::{Camera, Lens};
use crate::euroc::{DATASHEET, MEASURED, NOISE_SOURCE};
use crate::types::{Pose, Span};
use crate::{Fault, FaultKind};
use glam::{DMat3, DQuat, DVec3};
use std::path::{Path, PathBuf};

pub(super) mod document;
use document::Document;

/// Noise of a consumer MEMS unit (BMI160 with the white noise doubled and the walks times ten, as TUM-VI recommends for
/// estimators), assumed where a recording does not state it.
pub const IMU_DEFAULTS: ImuCalibration = ImuCalibration {
    rate_hz: 200.0,
    gyro_noise: 1.6e-4,
    gyro_walk: 2.2e-5,
    accel_noise: 2.8e-3,
    accel_walk: 8.6e-4,
    measured: false,
    range: ImuCalibration::RANGE,
    correction: ImuCorrection::NONE,
};
/// Longest readout, s: a camera of one frame a second has no longer one.
const READOUT_MAX: f64 = 1.0;

/// Reads a Kalibr camchain.yaml, a Basalt json, or a EuRoC `mav0` folder; a fault where anything in it is wrong.
pub fn read_calibration(path: &Path) -> Result<Calibration, Fault> {
    read(path, None, &mut Findings::default())
}

/// Reads a calibration file or folder; `readout` is the readout time that the board file states. A
/// fault names the file, the line and the key.
pub fn read(path: &Path, readout: Option<Span>, findings: &mut Findings) -> Result<Calibration, Fault> {
    let mut calibration = if path.is_dir() {
        euroc(path, readout, findings)?
    } else {
        let file = Document::read(path)?;
        if file.has("/value0") {
            basalt(&file)?
        } else if file.has("/cam0") {
            kalibr(&file, readout, findings)?
        } else {
            let what = "neither a Kalibr camchain (no key cam0) nor a Basalt calibration (no key value0)";
            return Err(file.fault("", what));
        }
    };
    if let Some(readout) = readout {
        calibration.cameras.iter_mut().for_each(|c| c.readout = readout);
    }
    match doubled(&calibration.cameras) {
        None => Ok(calibration),
        Some((i, j)) => {
            let what = format!("cameras {i} and {j} look the same way from one place (zero baseline): no depth");
            Err(Fault::new(FaultKind::Config, path.display().to_string(), what, "correct their extrinsics"))
        }
    }
}

/// Two cameras at one place whose axes are less than a right angle apart; back to back is allowed.
fn doubled(cameras: &[RigCamera]) -> Option<(usize, usize)> {
    let axis = |c: &RigCamera| c.body_from_cam.q * DVec3::Z;
    let same = |a: &RigCamera, b: &RigCamera| {
        a.body_from_cam.p.distance(b.body_from_cam.p) < 1e-6 && axis(a).dot(axis(b)) > 1e-6
    };
    let pairs = (0..cameras.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    pairs.into_iter().find(|&(i, j)| same(&cameras[i], &cameras[j]))
}

/// Checks the number of a file's cameras.
fn checked_count(file: &Document, at: &str, count: usize) -> Result<usize, Fault> {
    match count {
        0..=cameras::CAMERAS_MAX => Ok(count.max(1)),
        _ => Err(Fault { fix: "take the others out of it".to_string(), ..file.fault(at, &cameras::too_many(count)) }),
    }
}

/// Reads the calibration that comes with a recording: sensor.yaml in its folders, else a Kalibr camchain.
pub fn of_recording(
    home: &Path,
    mav0: &Path,
    readout: Option<Span>,
    findings: &mut Findings,
) -> Result<Calibration, Fault> {
    if sensor_yaml(mav0, "cam0").is_file() {
        return read(mav0, readout, findings);
    }
    let candidates = ["camchain.yaml", "dso/camchain.yaml"];
    match candidates.iter().map(|name| home.join(name)).find(|path| path.is_file()) {
        Some(path) => read(&path, readout, findings),
        None => {
            let fix = "add it, or name one with --calibration FILE";
            let what = "no calibration: neither cam0/sensor.yaml in it nor camchain.yaml beside it";
            Err(Fault::new(FaultKind::NoInput, mav0.display().to_string(), what, fix))
        }
    }
}

fn sensor_yaml(mav0: &Path, sensor: &str) -> PathBuf {
    mav0.join(sensor).join("sensor.yaml")
}

fn euroc(mav0: &Path, stated: Option<Span>, findings: &mut Findings) -> Result<Calibration, Fault> {
    let mut cameras = Vec::new();
    for k in 0..cameras::recorded(mav0)? {
        let path = sensor_yaml(mav0, &format!("cam{k}"));
        let file = Document::read(&path)?;
        let camera = yaml_camera(&file, "", "distortion_coefficients")?;
        let readout = readout(&file, "", &camera, stated)?;
        let time_offset = time_offset(&file, "")?;
        cameras.push(RigCamera { time_offset, readout, ..RigCamera::new(camera, file.transform("/T_BS/data")?) });
    }
    let imu = yaml_imu(&sensor_yaml(mav0, "imu0"), "rate_hz", findings)?;
    Ok(Calibration { cameras, imu })
}

fn kalibr(file: &Document, stated: Option<Span>, findings: &mut Findings) -> Result<Calibration, Fault> {
    let mut cameras: Vec<RigCamera> = Vec::new();
    for k in 0..checked_count(file, "", cameras::count(file.keys()))? {
        let at = format!("/cam{k}");
        let own = format!("{at}/T_cam_imu");
        let chained = format!("{at}/T_cn_cnm1");
        let body_from_cam = match cameras.last() {
            // Camera-only chains give the first camera's pose and the steps between cameras.
            Some(previous) if !file.has(&own) && file.has(&chained) => {
                previous.body_from_cam * file.transform(&chained)?.inverse()
            }
            _ => file.transform(&own)?.inverse(),
        };
        let time_offset = time_offset(file, &at)?;
        let camera = yaml_camera(file, &at, "distortion_coeffs")?;
        let readout = readout(file, &at, &camera, stated)?;
        cameras.push(RigCamera { time_offset, readout, ..RigCamera::new(camera, body_from_cam) });
    }
    let imu = yaml_imu(&file.path.with_file_name("imu_config.yaml"), "update_rate", findings)?;
    Ok(Calibration { cameras, imu })
}

fn time_offset(file: &Document, at: &str) -> Result<Span, Fault> {
    let shift = format!("{at}/timeshift_cam_imu");
    Ok(if file.has(&shift) { Span::from_secs(file.number(&shift)?) } else { Span(0) })
}

/// The readout time, first row to last, that the file states.
fn readout(file: &Document, at: &str, camera: &Camera, stated: Option<Span>) -> Result<Span, Fault> {
    let key = |name: &str| format!("{at}/{name}");
    let (time, line, shutter) = (key("readout_time"), key("line_delay"), key("shutter"));
    let (named, secs) = if file.has(&time) {
        (time, file.number(&key("readout_time"))?)
    } else if file.has(&line) {
        (line, file.number(&key("line_delay"))? * (camera.height - 1) as f64)
    } else if !file.has(&shutter) || file.text(&shutter)? == "global" {
        return Ok(Span(0));
    } else if file.text(&shutter)? != "rolling" {
        return Err(file.fault(&shutter, "must be global or rolling"));
    } else if stated.is_none() {
        let mut fault = file.fault(&shutter, "a rolling shutter without its readout time");
        fault.fix = "state readout_time (s) beside it, or rig.readout_s in the board file".to_string();
        return Err(fault);
    } else {
        return Ok(Span(0));
    };
    match (0.0..READOUT_MAX).contains(&secs) {
        true => Ok(Span::from_secs(secs)),
        false => Err(file.fault(&named, "a readout takes from 0 to 1 s")),
    }
}

/// Reads the camera keys that EuRoC and Kalibr share.
fn yaml_camera(file: &Document, at: &str, coefficients: &str) -> Result<Camera, Fault> {
    let key = |name: &str| format!("{at}/{name}");
    let numbers = |name: &str, n: usize| file.numbers(&key(name), n);
    let size = numbers("resolution", 2)?;
    let (model, distortion) = (file.text(&key("camera_model"))?, file.text(&key("distortion_model"))?);
    let lens = match (model, distortion) {
        ("pinhole", "none") => Lens::NONE,
        ("pinhole", "radtan" | "radial-tangential") => {
            let d = numbers(coefficients, 4)?;
            Lens::Radtan { k1: d[0], k2: d[1], p1: d[2], p2: d[3] }
        }
        ("pinhole", "rational_polynomial") => {
            let d = numbers(coefficients, 8)?;
            Lens::rational([d[0], d[1], d[4], d[5], d[6], d[7]], d[2], d[3], 0.0)
        }
        ("pinhole", "equidistant") => {
            let d = numbers(coefficients, 4)?;
            Lens::KannalaBrandt { k: [d[0], d[1], d[2], d[3]] }
        }
        ("ds", "none") => {
            let v = numbers("intrinsics", 6)?;
            Lens::DoubleSphere { xi: v[0], alpha: v[1] }
        }
        _ => {
            let what = format!(
                "lens {model} with {distortion} is not known (pinhole with none, radtan, rational_polynomial or equidistant; ds with none)"
            );
            return Err(file.fault(&key("distortion_model"), &what));
        }
    };
    // The double sphere's own two stand before the focal lengths.
    let own = if model == "ds" { 2 } else { 0 };
    let f = &numbers("intrinsics", own + 4)?[own..];
    checked(file, at, [size[0], size[1]], [f[0], f[1], f[2], f[3]], lens)
}

/// The rate of the inertial unit that a sensor.yaml or an imu_config.yaml states, Hz; a fault where it states none.
pub(super) fn stated_rate(file: &Document) -> Result<f64, Fault> {
    let at = if file.has("/imu0") { "/imu0" } else { "" };
    let [euroc, kalibr] = ["rate_hz", "update_rate"].map(|name| format!("{at}/{name}"));
    file.positive(if file.has(&kalibr) { &kalibr } else { &euroc })
}

fn yaml_imu(path: &Path, rate: &str, findings: &mut Findings) -> Result<ImuCalibration, Fault> {
    if !path.is_file() {
        let what = "missing: noise of a consumer MEMS unit at 200 Hz is assumed";
        findings.warn(|c| &mut c.calibration_notes, path, 0, what);
        return Ok(IMU_DEFAULTS);
    }
    let file = Document::read(path)?;
    let at = if file.has("/imu0") { "/imu0" } else { "" };
    if file.has("/T_BS") {
        let imu = file.transform("/T_BS/data")?;
        if imu.p.length() > 1e-9 || imu.q.w.abs() < 1.0 - 1e-12 {
            return Err(file.fault("/T_BS", "must be the identity: the body is the inertial unit"));
        }
    }
    let model = format!("{at}/model");
    if file.has(&model) && file.text(&model)? != "calibrated" {
        let what = "scale and misalignment of this model are not applied (those of a Basalt json are)";
        findings.warn(|c| &mut c.calibration_notes, path, file.line(&model), what);
    }
    let positive = |name: &str| file.positive(&format!("{at}/{name}"));
    Ok(ImuCalibration {
        rate_hz: positive(rate)?,
        gyro_noise: positive("gyroscope_noise_density")?,
        gyro_walk: positive("gyroscope_random_walk")?,
        accel_noise: positive("accelerometer_noise_density")?,
        accel_walk: positive("accelerometer_random_walk")?,
        measured: measured(&file, at)?,
        range: ImuCalibration::RANGE,
        correction: ImuCorrection::NONE,
    })
}

/// Whether the file says that its figures of noise were measured on the unit.
fn measured(file: &Document, at: &str) -> Result<bool, Fault> {
    let key = format!("{at}/{NOISE_SOURCE}");
    match if file.has(&key) { file.text(&key)? } else { DATASHEET } {
        MEASURED => Ok(true),
        DATASHEET => Ok(false),
        _ => Err(file.fault(&key, "must be measured or datasheet")),
    }
}

fn basalt(file: &Document) -> Result<Calibration, Fault> {
    let offset = "/value0/cam_time_offset_ns";
    let time_offset = Span(if file.has(offset) { file.number(offset)?.round() as i64 } else { 0 });
    let mut cameras = Vec::new();
    let lenses = "/value0/intrinsics";
    for k in 0..checked_count(file, lenses, file.length(lenses))? {
        let (at, pose) = (format!("{lenses}/{k}"), format!("/value0/T_imu_cam/{k}"));
        let size = file.numbers(&format!("/value0/resolution/{k}"), 2)?;
        let number = |name: &str| file.number(&format!("{at}/intrinsics/{name}"));
        let lens = match file.text(&format!("{at}/camera_type"))? {
            "pinhole" => Lens::NONE,
            "kb4" => Lens::KannalaBrandt { k: [number("k1")?, number("k2")?, number("k3")?, number("k4")?] },
            "ds" => Lens::DoubleSphere { xi: number("xi")?, alpha: number("alpha")? },
            "pinhole-radtan8" => {
                let k = [number("k1")?, number("k2")?, number("k3")?, number("k4")?, number("k5")?, number("k6")?];
                let r_max = if file.has(&format!("{at}/intrinsics/rpmax")) { number("rpmax")? } else { 0.0 };
                Lens::rational(k, number("p1")?, number("p2")?, r_max)
            }
            other => {
                let what = format!("camera type {other} is not known (pinhole, pinhole-radtan8, kb4, ds)");
                return Err(file.fault(&format!("{at}/camera_type"), &what));
            }
        };
        let f = [number("fx")?, number("fy")?, number("cx")?, number("cy")?];
        let part = |name: &str| file.number(&format!("{pose}/{name}"));
        let q = DQuat::from_xyzw(part("qx")?, part("qy")?, part("qz")?, part("qw")?);
        if (q.length() - 1.0).abs() > ROTATION_TOLERANCE {
            return Err(file.fault(&pose, "the quaternion is not of unit length"));
        }
        let body_from_cam = Pose::new(q, DVec3::new(part("px")?, part("py")?, part("pz")?));
        let camera = checked(file, &at, [size[0], size[1]], f, lens)?;
        cameras.push(RigCamera { time_offset, ..RigCamera::new(camera, body_from_cam) });
    }
    let noise = |name: &str| file.positive(&format!("/value0/{name}/0"));
    let imu = ImuCalibration {
        rate_hz: file.positive("/value0/imu_update_rate")?,
        gyro_noise: noise("gyro_noise_std")?,
        gyro_walk: noise("gyro_bias_std")?,
        accel_noise: noise("accel_noise_std")?,
        accel_walk: noise("accel_bias_std")?,
        measured: measured(file, "/value0")?,
        range: ImuCalibration::RANGE,
        correction: basalt_correction(file)?,
    };
    Ok(Calibration { cameras, imu })
}

/// Largest entry of scale and misalignment: a worse unit is not fit to fly, and a matrix stays invertible far beyond this.
const AXES_MAX: f64 = 0.1;

/// Reads the correction `(I + S) reading - bias`: the accelerometer's S is lower triangular, the gyro's full, both by columns
/// after the three numbers of the bias.
fn basalt_correction(file: &Document) -> Result<ImuCorrection, Fault> {
    let numbers = |key: &str, n: usize| if file.has(key) { file.numbers(key, n) } else { Ok(vec![0.0; n]) };
    let a = numbers("/value0/calib_accel_bias", 9)?;
    let g = numbers("/value0/calib_gyro_bias", 12)?;
    for (key, values) in [("/value0/calib_accel_bias", &a[3..]), ("/value0/calib_gyro_bias", &g[3..])] {
        if values.iter().any(|v| v.abs() > AXES_MAX) {
            return Err(file.fault(key, "an entry of scale or misalignment is larger than a tenth"));
        }
    }
    let columns = |s: [f64; 9]| DMat3::IDENTITY + DMat3::from_cols_array(&s);
    Ok(ImuCorrection {
        gyro_scale: columns(std::array::from_fn(|i| g[3 + i])),
        accel_scale: columns([a[3], a[4], a[5], 0.0, a[6], a[7], 0.0, 0.0, a[8]]),
        gyro_bias: DVec3::new(g[0], g[1], g[2]),
        accel_bias: DVec3::new(a[0], a[1], a[2]),
    })
}

/// Largest deviation from a rotation: calibrated ones are printed rounded; more is a mistake.
const ROTATION_TOLERANCE: f64 = 1e-3;
/// Largest side of an image, pixels: that of every board. Buffers of this size are allocated.
const SIDE_MAX: f64 = 4096.0;

/// The camera, if its numbers make sense.
fn checked(file: &Document, at: &str, size: [f64; 2], f: [f64; 4], lens: Lens) -> Result<Camera, Fault> {
    let wrong = |what: &str| Err(file.fault(at, what));
    if size.iter().any(|s| !(1.0..=SIDE_MAX).contains(s) || s.fract() != 0.0) {
        // Basalt keeps the sizes beside the intrinsics.
        let key =
            if at.contains("intrinsics") { at.replace("intrinsics", "resolution") } else { format!("{at}/resolution") };
        return Err(file.fault(&key, "resolution must be two whole numbers from 1 to 4096"));
    }
    if !(f[0] > 0.0 && f[1] > 0.0) {
        return Err(file.fault(&format!("{at}/intrinsics"), "focal lengths fx and fy must be positive"));
    }
    if let Lens::DoubleSphere { xi, alpha } = lens {
        if !(0.0..=1.0).contains(&alpha) || xi.abs() >= 1.0 {
            return wrong("double sphere needs alpha in 0..1 and xi between -1 and 1");
        }
    }
    let [fx, fy, cx, cy] = f;
    let camera = Camera { width: size[0] as usize, height: size[1] as usize, fx, fy, cx, cy, lens };
    match camera.unproject(glam::DVec2::new(cx, cy)).and_then(|b| camera.project(b)) {
        Some(_) => Ok(camera),
        None => wrong("no direction is seen at the image's centre: check the distortion"),
    }
}

/// A rigid transform from 16 numbers, row by row.
fn rigid(m: &[f64]) -> Result<Pose, &'static str> {
    if (0..4).any(|i| (m[12 + i] - [0.0, 0.0, 0.0, 1.0][i]).abs() > 1e-9) {
        return Err("the last row must be 0 0 0 1");
    }
    let mut r = DMat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
    let error = (r.transpose() * r - DMat3::IDENTITY).to_cols_array();
    if error.iter().any(|e| e.abs() > ROTATION_TOLERANCE) || r.determinant() < 0.0 {
        return Err("the rotation is not orthonormal (to 1e-3) and right-handed");
    }
    for _ in 0..3 {
        // Newton's iteration towards the nearest rotation.
        r = (r + r.transpose().inverse()) * 0.5;
    }
    Ok(Pose::new(DQuat::from_mat3(&r), DVec3::new(m[3], m[7], m[11])))
}
