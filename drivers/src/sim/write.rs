//! Writes a simulated run as an EuRoC ASL folder (`mav0`), with ground truth.
//!
//! Beyond what EuRoC has there is `mav0/depth0`: exact depth of camera 0 as 16-bit PNG, mm (0 =
//! none). Everything goes to a sibling folder first and is renamed when whole.

use super::Sim;
use crate::calibration::RigCamera;
use crate::euroc::{camera_yaml, commas, imu_yaml, transform_yaml, IMAGE_COLUMNS, IMU_COLUMNS};
use crate::fault::{Fault, FaultKind};
use crate::types::{Frames, Pose};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

/// Writes all frames; `progress` is told (frames written, frames in all). `dir` must not exist or
/// be empty; nothing is left behind on failure.
pub fn write_euroc(sim: &mut Sim, dir: &Path, progress: impl FnMut(usize, usize)) -> Result<(), Fault> {
    let frames = Frames::for_rig(sim.calibration());
    write_shaped(sim, dir, frames, progress)
}

/// As `write_euroc`, with images in colour.
pub fn write_euroc_colour(sim: &mut Sim, dir: &Path, progress: impl FnMut(usize, usize)) -> Result<(), Fault> {
    let frames = Frames::in_colour(sim.calibration(), sim.calibration().cameras.len());
    write_shaped(sim, dir, frames, progress)
}

/// Images are made and written as `frames` is shaped.
fn write_shaped(sim: &mut Sim, dir: &Path, frames: Frames, progress: impl FnMut(usize, usize)) -> Result<(), Fault> {
    if fs::read_dir(dir).is_ok_and(|mut d| d.next().is_some()) || dir.is_file() {
        let fix = "remove it or choose another folder";
        return Err(Fault::new(
            FaultKind::NoOutput,
            dir.display().to_string(),
            "exists and is not an empty folder",
            fix,
        ));
    }
    let name = dir.file_name().map_or_else(|| "out".into(), |n| n.to_string_lossy().into_owned());
    let partial = dir.with_file_name(format!(".{name}.partial-{}", std::process::id()));
    let written = write_all(sim, &partial.join("mav0"), frames, progress)
        .and_then(|()| fs::rename(&partial, dir).map_err(|e| cannot(dir, &e.to_string())));
    if written.is_err() {
        // best effort: the first error is the one to report
        let _ = fs::remove_dir_all(&partial);
    }
    written
}

fn write_all(sim: &mut Sim, mav: &Path, frames: Frames, progress: impl FnMut(usize, usize)) -> Result<(), Fault> {
    let rig = sim.calibration().clone();
    for (k, camera) in rig.cameras.iter().enumerate() {
        let folder = mav.join(format!("cam{k}"));
        make_dir(&folder.join("data"))?;
        put(&folder.join("sensor.yaml"), &camera_yaml(camera, &format!("simulated cam{k}"), frame_rate(sim)))?;
        put(&folder.join("data.csv"), &image_table(sim, camera))?;
    }
    make_dir(&mav.join("depth0").join("data"))?;
    put(&mav.join("depth0").join("data.csv"), &image_table(sim, &rig.cameras[0]))?;
    let about = format!(
        "sensor_type: depth\ncomment: z in the frame of cam0, 16-bit, mm, 0 = none\n{}",
        transform_yaml(&rig.cameras[0].body_from_cam)
    );
    put(&mav.join("depth0").join("sensor.yaml"), &about)?;
    make_dir(&mav.join("imu0"))?;
    put(&mav.join("imu0").join("sensor.yaml"), &imu_yaml(&rig.imu, "simulated"))?;
    put(&mav.join("imu0").join("data.csv"), &imu_table(sim))?;
    let truth = mav.join("state_groundtruth_estimate0");
    make_dir(&truth)?;
    let about = format!("sensor_type: visual-inertial\ncomment: simulated, exact\n{}", transform_yaml(&Pose::IDENTITY));
    put(&truth.join("sensor.yaml"), &about)?;
    put(&truth.join("data.csv"), &truth_table(sim))?;
    put(&mav.join("body.yaml"), "comment: Stipple simulator\n")?;
    write_images(sim, mav, frames, progress)
}

fn write_images(
    sim: &mut Sim,
    mav: &Path,
    mut frames: Frames,
    mut progress: impl FnMut(usize, usize),
) -> Result<(), Fault> {
    let (width, height) = (frames.images[0].width, frames.images[0].height);
    let mut depth = vec![0.0; width * height];
    let mut millimetres = vec![0u8; 2 * width * height];
    let count = sim.frame_count();
    for i in 0..count {
        sim.render(i, &mut frames);
        let name = |camera: usize| format!("{}.png", sim.calibration().cameras[camera].from_imu_clock(frames.t).0);
        for (k, image) in frames.images.iter().enumerate() {
            let path = mav.join(format!("cam{k}")).join("data").join(name(k));
            let size = (image.width, image.height);
            match frames.colours.get(k) {
                None => write_png(&path, size, (png::ColorType::Grayscale, png::BitDepth::Eight), &image.pixels)?,
                Some([r, g, b]) => {
                    let rgb: Vec<u8> =
                        (0..image.pixels.len()).flat_map(|i| [r.pixels[i], g.pixels[i], b.pixels[i]]).collect();
                    write_png(&path, size, (png::ColorType::Rgb, png::BitDepth::Eight), &rgb)?;
                }
            }
        }
        let path = mav.join("depth0").join("data").join(name(0));
        sim.depth(i, 0, &mut depth);
        for (out, z) in millimetres.chunks_exact_mut(2).zip(&depth) {
            out.copy_from_slice(&((z * 1000.0).round().min(65535.0) as u16).to_be_bytes());
        }
        write_png(&path, (width, height), (png::ColorType::Grayscale, png::BitDepth::Sixteen), &millimetres)?;
        progress(i + 1, count);
    }
    Ok(())
}

fn write_png(
    path: &Path,
    (width, height): (usize, usize),
    (colour, depth): (png::ColorType, png::BitDepth),
    data: &[u8],
) -> Result<(), Fault> {
    let file = fs::File::create(path).map_err(|e| cannot(path, &e.to_string()))?;
    let mut encoder = png::Encoder::new(std::io::BufWriter::new(file), width as u32, height as u32);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(|e| cannot(path, &e.to_string()))?;
    writer.write_image_data(data).map_err(|e| cannot(path, &e.to_string()))?;
    writer.finish().map_err(|e| cannot(path, &e.to_string()))
}

fn frame_rate(sim: &Sim) -> f64 {
    let n = sim.frame_count();
    if n < 2 {
        return 0.0;
    }
    ((n - 1) as f64 / (sim.stamp(n - 1) - sim.stamp(0)).secs() * 1e6).round() / 1e6
}

/// By the camera's own clock.
fn image_table(sim: &Sim, camera: &RigCamera) -> String {
    let mut s = IMAGE_COLUMNS.to_string();
    for i in 0..sim.frame_count() {
        let t = camera.from_imu_clock(sim.stamp(i)).0;
        line(&mut s, format_args!("{t},{t}.png"));
    }
    s
}

fn imu_table(sim: &Sim) -> String {
    let mut s = IMU_COLUMNS.to_string();
    for m in sim.imu() {
        line(&mut s, format_args!("{},{},{}", m.t.0, commas(m.gyro_body), commas(m.accel_body)));
    }
    s
}

fn truth_table(sim: &Sim) -> String {
    let mut s = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], \
                 v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], \
                 b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], \
                 b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
        .to_string();
    for m in sim.imu() {
        let x = sim.truth_at(m.t);
        let q = x.pose.q;
        let q = format!("{:.9},{:.9},{:.9},{:.9}", q.w, q.x, q.y, q.z);
        let (p, v) = (commas(x.pose.p), commas(x.v_world));
        line(&mut s, format_args!("{},{p},{q},{v},{},{}", m.t.0, commas(x.gyro_bias), commas(x.accel_bias)));
    }
    s
}

fn line(s: &mut String, row: std::fmt::Arguments<'_>) {
    writeln!(s, "{row}").expect("writing to a String cannot fail");
}

fn make_dir(path: &Path) -> Result<(), Fault> {
    fs::create_dir_all(path).map_err(|e| cannot(path, &e.to_string()))
}

fn put(path: &Path, text: &str) -> Result<(), Fault> {
    fs::write(path, text).map_err(|e| cannot(path, &e.to_string()))
}

fn cannot(path: &Path, what: &str) -> Fault {
    Fault::new(FaultKind::NoOutput, path.display().to_string(), what, "check that the folder is writable and has room")
}
