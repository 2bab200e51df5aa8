//! Calibration files: EuRoC sensor.yaml (`T_BS` = body_from_cam), Kalibr camchain.yaml (`T_cam_imu`
//! = cam_from_body) with imu_config.yaml beside it, Basalt json (`T_imu_cam` = body_from_cam). The body is
//! the inertial unit. Distortion: none, Brown with four coefficients, Kannala-Brandt, double sphere; any
//! other model is refused, since a wrong lens looks like noise to an estimator.

use super::findings::Findings;
use super::CAMERAS_MAX;
use crate::camera::{Calibration, Camera, ImuCalibration, Lens, RigCamera};
use crate::types::Pose;
use crate::{Exit, Fault};
use glam::{DMat3, DQuat, DVec3};
use std::path::{Path, PathBuf};

mod document;
use document::Document;

/// Noise of a consumer MEMS unit (BMI160 with the white noise doubled and the walks times ten, as
/// TUM-VI recommends for estimators), taken where a recording does not say.
pub const IMU_DEFAULTS: ImuCalibration =
    ImuCalibration { rate_hz: 200.0, gyro_noise: 1.6e-4, gyro_walk: 2.2e-5, accel_noise: 2.8e-3, accel_walk: 8.6e-4 };

/// Reads a Kalibr camchain.yaml, a Basalt json, or a EuRoC `mav0` folder.
pub fn read_calibration(path: &Path) -> Result<Calibration, Fault> {
    read(path, &mut Findings::default())
}

pub fn read(path: &Path, findings: &mut Findings) -> Result<Calibration, Fault> {
    let calibration = if path.is_dir() {
        euroc(path, findings)?
    } else {
        let file = Document::read(path)?;
        if file.has("/value0") {
            basalt(&file, findings)?
        } else if file.has("/cam0") {
            kalibr(&file, findings)?
        } else {
            let what = "neither a Kalibr camchain (no key cam0) nor a Basalt calibration (no key value0)";
            return Err(file.fault("", what));
        }
    };
    let baseline = calibration.cameras[1].body_from_cam.p - calibration.cameras[0].body_from_cam.p;
    if baseline.length() < 1e-6 {
        let what = "cameras 0 and 1 are at the same place (zero baseline): stereo has no depth";
        return Err(Fault::new(Exit::Config, path.display().to_string(), what, "correct their extrinsics"));
    }
    Ok(calibration)
}

/// The calibration that a recording carries: sensor.yaml in its folders, else a Kalibr camchain.
pub fn of_recording(home: &Path, mav0: &Path, findings: &mut Findings) -> Result<Calibration, Fault> {
    if sensor_yaml(mav0, "cam0").is_file() {
        return read(mav0, findings);
    }
    let candidates = ["camchain.yaml", "dso/camchain.yaml"];
    match candidates.iter().map(|name| home.join(name)).find(|path| path.is_file()) {
        Some(path) => read(&path, findings),
        None => {
            let fix = "add it, or name one with replay.calibration";
            let what = "no calibration: neither cam0/sensor.yaml in it nor camchain.yaml beside it";
            Err(Fault::new(Exit::NoInput, mav0.display().to_string(), what, fix))
        }
    }
}

fn sensor_yaml(mav0: &Path, sensor: &str) -> PathBuf {
    mav0.join(sensor).join("sensor.yaml")
}

fn euroc(mav0: &Path, findings: &mut Findings) -> Result<Calibration, Fault> {
    let mut cameras = Vec::new();
    for k in 0..CAMERAS_MAX {
        let path = sensor_yaml(mav0, &format!("cam{k}"));
        if k >= 2 && !path.is_file() {
            break;
        }
        let file = Document::read(&path)?;
        let camera = yaml_camera(&file, "", "distortion_coefficients")?;
        cameras.push(RigCamera { camera, body_from_cam: file.transform("/T_BS/data")? });
    }
    let imu = yaml_imu(&sensor_yaml(mav0, "imu0"), "rate_hz", findings)?;
    Ok(Calibration { cameras, imu })
}

fn kalibr(file: &Document, findings: &mut Findings) -> Result<Calibration, Fault> {
    let mut cameras: Vec<RigCamera> = Vec::new();
    for k in 0..CAMERAS_MAX {
        let at = format!("/cam{k}");
        if k >= 2 && !file.has(&at) {
            break;
        }
        let own = format!("{at}/T_cam_imu");
        let chained = format!("{at}/T_cn_cnm1");
        let body_from_cam = match cameras.last() {
            // camera-only chains give the first camera's pose and the steps between cameras
            Some(previous) if !file.has(&own) && file.has(&chained) => {
                previous.body_from_cam * file.transform(&chained)?.inverse()
            }
            _ => file.transform(&own)?.inverse(),
        };
        if file.has(&format!("{at}/timeshift_cam_imu")) && file.number(&format!("{at}/timeshift_cam_imu"))? != 0.0 {
            let what = format!("cam{k}.timeshift_cam_imu is not applied");
            findings.warn(|c| &mut c.calibration_notes, &file.path, file.line(&at), what);
        }
        cameras.push(RigCamera { camera: yaml_camera(file, &at, "distortion_coeffs")?, body_from_cam });
    }
    let imu = yaml_imu(&file.path.with_file_name("imu_config.yaml"), "update_rate", findings)?;
    Ok(Calibration { cameras, imu })
}

/// The camera keys that EuRoC and Kalibr share.
fn yaml_camera(file: &Document, at: &str, coefficients: &str) -> Result<Camera, Fault> {
    let key = |name: &str| format!("{at}/{name}");
    let numbers = |name: &str, n: usize| file.numbers(&key(name), n);
    let size = numbers("resolution", 2)?;
    let (model, distortion) = (file.text(&key("camera_model"))?, file.text(&key("distortion_model"))?);
    let (f, lens) = match (model, distortion) {
        ("pinhole", "none") => (numbers("intrinsics", 4)?, Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 }),
        ("pinhole", "radtan" | "radial-tangential") => {
            let d = numbers(coefficients, 4)?;
            (numbers("intrinsics", 4)?, Lens::Radtan { k1: d[0], k2: d[1], p1: d[2], p2: d[3] })
        }
        ("pinhole", "equidistant") => {
            let d = numbers(coefficients, 4)?;
            (numbers("intrinsics", 4)?, Lens::KannalaBrandt { k: [d[0], d[1], d[2], d[3]] })
        }
        ("ds", "none") => {
            let v = numbers("intrinsics", 6)?;
            (v[2..].to_vec(), Lens::DoubleSphere { xi: v[0], alpha: v[1] })
        }
        _ => {
            let what = format!(
                "lens {model} with {distortion} is not known (pinhole with none, radtan or equidistant; ds with none)"
            );
            return Err(file.fault(&key("distortion_model"), &what));
        }
    };
    checked(file, at, [size[0], size[1]], [f[0], f[1], f[2], f[3]], lens)
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
    let positive = |name: &str| file.positive(&format!("{at}/{name}"));
    Ok(ImuCalibration {
        rate_hz: positive(rate)?,
        gyro_noise: positive("gyroscope_noise_density")?,
        gyro_walk: positive("gyroscope_random_walk")?,
        accel_noise: positive("accelerometer_noise_density")?,
        accel_walk: positive("accelerometer_random_walk")?,
    })
}

fn basalt(file: &Document, findings: &mut Findings) -> Result<Calibration, Fault> {
    let mut cameras = Vec::new();
    for k in 0..CAMERAS_MAX {
        let (at, pose) = (format!("/value0/intrinsics/{k}"), format!("/value0/T_imu_cam/{k}"));
        if k >= 2 && !file.has(&at) {
            break;
        }
        let size = file.numbers(&format!("/value0/resolution/{k}"), 2)?;
        let number = |name: &str| file.number(&format!("{at}/intrinsics/{name}"));
        let lens = match file.text(&format!("{at}/camera_type"))? {
            "pinhole" => Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 },
            "kb4" => Lens::KannalaBrandt { k: [number("k1")?, number("k2")?, number("k3")?, number("k4")?] },
            "ds" => Lens::DoubleSphere { xi: number("xi")?, alpha: number("alpha")? },
            other => {
                let what = format!("camera type {other} is not known (pinhole, kb4, ds)");
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
        cameras.push(RigCamera { camera: checked(file, &at, [size[0], size[1]], f, lens)?, body_from_cam });
    }
    // after the bias, which is estimated, come scale and misalignment of the axes
    for key in ["/value0/calib_accel_bias", "/value0/calib_gyro_bias"] {
        if file.has(key) && file.all_numbers(key)?.iter().skip(3).any(|v| *v != 0.0) {
            let what = format!("scale and misalignment in {} are not applied", &key[8..]);
            findings.warn(|c| &mut c.calibration_notes, &file.path, file.line(key), what);
        }
    }
    let noise = |name: &str| file.positive(&format!("/value0/{name}/0"));
    let imu = ImuCalibration {
        rate_hz: file.positive("/value0/imu_update_rate")?,
        gyro_noise: noise("gyro_noise_std")?,
        gyro_walk: noise("gyro_bias_std")?,
        accel_noise: noise("accel_noise_std")?,
        accel_walk: noise("accel_bias_std")?,
    };
    Ok(Calibration { cameras, imu })
}

/// Calibrated rotations are printed rounded; more than this is a mistake.
const ROTATION_TOLERANCE: f64 = 1e-3;
/// A size that no camera has would buy buffers of that size.
const SIDE_MAX: f64 = 16384.0;

fn checked(file: &Document, at: &str, size: [f64; 2], f: [f64; 4], lens: Lens) -> Result<Camera, Fault> {
    let wrong = |what: &str| Err(file.fault(at, what));
    if size.iter().any(|s| !(1.0..=SIDE_MAX).contains(s) || s.fract() != 0.0) {
        return wrong("resolution must be two whole numbers from 1 to 16384");
    }
    if !(f[0] > 0.0 && f[1] > 0.0) {
        return wrong("focal lengths fx and fy must be positive");
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
        None => wrong("the lens maps nothing to its own centre: check the distortion"),
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
        r = (r + r.transpose().inverse()) * 0.5; // Newton towards the nearest rotation
    }
    Ok(Pose::new(DQuat::from_mat3(&r), DVec3::new(m[3], m[7], m[11])))
}
