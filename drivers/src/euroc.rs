//! The files of an EuRoC ASL folder, as the simulator and the recorder write them: calibration, tables, images.

use crate::calibration::{ImuCalibration, RigCamera};
use crate::camera::Lens;
use crate::source::{Aid, AidReading};
use crate::types::{Colour, Image, ImuSample, Pose};
use glam::{DMat3, DVec3};
use png::{BitDepth, ColorType, EncodingError};
use std::io::{self, Write};

/// Headline of the table of images.
pub const IMAGE_COLUMNS: &str = "#timestamp [ns],filename\n";
/// Headline of the table of inertial samples.
pub const IMU_COLUMNS: &str = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],\
                               a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n";

/// Key of a calibration that says where its figures of noise come from, and its two values.
pub const NOISE_SOURCE: &str = "noise_source";
/// Figures of a data sheet, or of another unit: what holds without the key.
pub const DATASHEET: &str = "datasheet";
/// Figures that were measured on this unit.
pub const MEASURED: &str = "measured";
/// Headline of the table of a barometer.
pub const BARO_COLUMNS: &str = "#timestamp [ns],pressure [Pa]\n";

/// The sensor.yaml of a camera.
pub fn camera_yaml(c: &RigCamera, comment: &str, rate_hz: f64) -> String {
    let m = &c.camera;
    let pinhole = format!("[{}, {}, {}, {}]", m.fx, m.fy, m.cx, m.cy);
    let (model, intrinsics, distortion, coefficients) = match m.lens {
        Lens::Radtan { k1, k2, p1, p2 } => {
            ("pinhole", pinhole, "radial-tangential", format!("[{k1}, {k2}, {p1}, {p2}]"))
        }
        Lens::Rational { k: [k1, k2, k3, k4, k5, k6], p1, p2, .. } => {
            let k = format!("[{k1}, {k2}, {p1}, {p2}, {k3}, {k4}, {k5}, {k6}]");
            ("pinhole", pinhole, "rational_polynomial", k)
        }
        Lens::KannalaBrandt { k: [a, b, c, d] } => ("pinhole", pinhole, "equidistant", format!("[{a}, {b}, {c}, {d}]")),
        Lens::DoubleSphere { xi, alpha } => {
            let intrinsics = format!("[{xi}, {alpha}, {}, {}, {}, {}]", m.fx, m.fy, m.cx, m.cy);
            ("ds", intrinsics, "none", "[]".to_string())
        }
    };
    let stated = |key: &str, ns: i64| if ns == 0 { String::new() } else { format!("{key}: {}\n", ns as f64 * 1e-9) };
    format!(
        "sensor_type: camera\ncomment: {comment}\n{}rate_hz: {rate_hz}\nresolution: [{}, {}]\n\
         camera_model: {model}\nintrinsics: {intrinsics}\ndistortion_model: {distortion}\n\
         distortion_coefficients: {coefficients}\n{}{}",
        transform_yaml(&c.body_from_cam),
        m.width,
        m.height,
        stated("readout_time", c.readout.0),
        stated("timeshift_cam_imu", c.time_offset.0),
    )
}

/// The sensor.yaml of the inertial unit.
pub fn imu_yaml(m: &ImuCalibration, comment: &str) -> String {
    let source = if m.measured { format!("{NOISE_SOURCE}: {MEASURED}\n") } else { String::new() };
    format!(
        "sensor_type: imu\ncomment: {comment}\n{}rate_hz: {}\ngyroscope_noise_density: {:e}\n\
         gyroscope_random_walk: {:e}\naccelerometer_noise_density: {:e}\naccelerometer_random_walk: {:e}\n{source}",
        transform_yaml(&Pose::IDENTITY),
        m.rate_hz,
        m.gyro_noise,
        m.gyro_walk,
        m.accel_noise,
        m.accel_walk
    )
}

/// The key `T_BS` of a sensor.yaml.
pub fn transform_yaml(body_from_sensor: &Pose) -> String {
    let r = DMat3::from_quat(body_from_sensor.q);
    let mut s = "T_BS:\n  cols: 4\n  rows: 4\n  data: [".to_string();
    for i in 0..3 {
        let (a, p) = (r.row(i), body_from_sensor.p[i]);
        s += &format!("{:.15}, {:.15}, {:.15}, {:.15},\n         ", a.x, a.y, a.z, p);
    }
    s + "0.0, 0.0, 0.0, 1.0]\n"
}

/// Writes a row of imu0/data.csv.
pub fn imu_row(out: &mut impl Write, s: &ImuSample) -> io::Result<()> {
    writeln!(out, "{},{},{}", s.t.0, commas(s.gyro_body), commas(s.accel_body))
}

/// Writes a row of baro0/data.csv: a tenth of a millipascal is a hundredth of a millimetre of height.
pub fn aid_row(out: &mut impl Write, reading: &AidReading) -> io::Result<()> {
    let Aid::Pressure(pa) = reading.value;
    writeln!(out, "{},{pa:.4}", reading.t.0)
}

/// The three numbers of a row.
pub fn commas(v: DVec3) -> String {
    format!("{:.9},{:.9},{:.9}", v.x, v.y, v.z)
}

/// Writes an image as PNG: 8-bit grey, or RGB of three planes.
pub fn png(out: impl Write, image: &Image, colour: Option<&Colour>) -> Result<(), EncodingError> {
    let size = (image.width, image.height);
    match colour {
        None => encode(out, size, ColorType::Grayscale, BitDepth::Eight, &image.pixels),
        Some([r, g, b]) => {
            let rgb: Vec<u8> = (0..image.pixels.len()).flat_map(|i| [r.pixels[i], g.pixels[i], b.pixels[i]]).collect();
            encode(out, size, ColorType::Rgb, BitDepth::Eight, &rgb)
        }
    }
}

/// Writes a 16-bit grey image of big-endian `words` as PNG.
pub fn png_16(out: impl Write, size: (usize, usize), words: &[u8]) -> Result<(), EncodingError> {
    encode(out, size, ColorType::Grayscale, BitDepth::Sixteen, words)
}

fn encode(
    out: impl Write,
    (width, height): (usize, usize),
    colour: ColorType,
    depth: BitDepth,
    data: &[u8],
) -> Result<(), EncodingError> {
    let mut encoder = png::Encoder::new(out, width as u32, height as u32);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(data)?;
    writer.finish()
}
