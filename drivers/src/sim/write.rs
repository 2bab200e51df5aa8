//! Writes a simulated run as an EuRoC ASL folder (`mav0`), with ground truth.
//!
//! Beyond what EuRoC has there is `mav0/depth0`: exact depth of camera 0 as 16-bit PNG, mm (0 = none). Everything goes to a
//! sibling folder first, which is renamed when it is whole.

use super::Sim;
use crate::calibration::RigCamera;
use crate::euroc::{
    aid_row, camera_yaml, commas, imu_row, imu_yaml, png, png_16, transform_yaml, BARO_COLUMNS, IMAGE_COLUMNS,
    IMU_COLUMNS,
};
use crate::host::sync_folder_of;
use crate::types::{Frames, Pose};
use crate::{Fault, FaultKind};
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;

/// Writes all frames, the first `colours` cameras in colour; `progress` is told (frames written, frames in all). `dir` must
/// not exist or be empty; nothing is left behind on failure.
pub fn write_euroc(sim: &mut Sim, dir: &Path, colours: usize, progress: impl FnMut(usize, usize)) -> Result<(), Fault> {
    let frames = Frames::in_colour(sim.calibration(), colours);
    if fs::read_dir(dir).is_ok_and(|mut d| d.next().is_some()) || dir.is_file() {
        let (place, fix) = (dir.display().to_string(), "remove it or choose another folder");
        return Err(Fault::new(FaultKind::NoOutput, place, "exists and is not an empty folder", fix));
    }
    let name = dir.file_name().map_or_else(|| "out".into(), |n| n.to_string_lossy().into_owned());
    let partial = dir.with_file_name(format!(".{name}.partial-{}", std::process::id()));
    if let Some(parent) = dir.parent() {
        make_dir(parent)?;
    }
    // Made here, so that no link of somebody else lies in it.
    fs::create_dir(&partial).map_err(|e| cannot(&partial, e))?;
    let written = write_all(sim, &partial.join("mav0"), frames, progress)
        .and_then(|()| fs::rename(&partial, dir).map_err(|e| cannot(dir, e)));
    // Best effort: the first error is the one to report; and a run that is whole and in its place is written, though a folder
    // that one may write and not read cannot be synced.
    let _ = if written.is_err() { fs::remove_dir_all(&partial) } else { sync_folder_of(dir) };
    written
}

fn write_all(sim: &mut Sim, mav: &Path, frames: Frames, progress: impl FnMut(usize, usize)) -> Result<(), Fault> {
    let rig = sim.calibration().clone();
    for (k, camera) in rig.cameras.iter().enumerate() {
        let yaml = camera_yaml(camera, &format!("simulated cam{k}"), frame_rate(sim));
        put(&mav.join(format!("cam{k}")), "sensor.yaml", yaml)?;
        put(&mav.join(format!("cam{k}")), "data.csv", image_table(sim, camera))?;
        make_dir(&mav.join(format!("cam{k}/data")))?;
    }
    let about = "sensor_type: depth\ncomment: z in the frame of cam0, 16-bit, mm, 0 = none\n";
    let yaml = about.to_string() + &transform_yaml(&rig.cameras[0].body_from_cam);
    put(&mav.join("depth0"), "sensor.yaml", yaml)?;
    put(&mav.join("depth0"), "data.csv", image_table(sim, &rig.cameras[0]))?;
    make_dir(&mav.join("depth0/data"))?;
    put(&mav.join("imu0"), "sensor.yaml", imu_yaml(&rig.imu, "simulated"))?;
    put(&mav.join("imu0"), "data.csv", imu_table(sim))?;
    put(&mav.join("baro0"), "data.csv", baro_table(sim))?;
    let (truth, about) =
        (mav.join("state_groundtruth_estimate0"), "sensor_type: visual-inertial\ncomment: simulated, exact\n");
    put(&truth, "sensor.yaml", about.to_string() + &transform_yaml(&Pose::IDENTITY))?;
    put(&truth, "data.csv", truth_table(sim))?;
    put(mav, "body.yaml", "comment: Stipple simulator\n")?;
    write_images(sim, mav, frames, progress)
}

fn write_images(
    sim: &mut Sim,
    mav: &Path,
    mut frames: Frames,
    mut progress: impl FnMut(usize, usize),
) -> Result<(), Fault> {
    let size = (frames.images[0].width, frames.images[0].height);
    let mut depth = vec![0.0; size.0 * size.1];
    let mut millimetres = vec![0u8; 2 * depth.len()];
    let create = |path: &Path| File::create(path).map(BufWriter::new).map_err(|e| cannot(path, e));
    let count = sim.frame_count();
    for i in 0..count {
        sim.render(i, &mut frames);
        let name = |camera: usize| format!("{}.png", sim.calibration().cameras[camera].from_imu_clock(frames.t).0);
        for (k, image) in frames.images.iter().enumerate() {
            let path = mav.join(format!("cam{k}/data")).join(name(k));
            png(create(&path)?, image, frames.colours.get(k)).map_err(|e| cannot(&path, e))?;
        }
        let path = mav.join("depth0/data").join(name(0));
        sim.depth(i, 0, &mut depth);
        for (out, z) in millimetres.chunks_exact_mut(2).zip(&depth) {
            out.copy_from_slice(&((z * 1000.0).round().min(65535.0) as u16).to_be_bytes());
        }
        png_16(create(&path)?, size, &millimetres).map_err(|e| cannot(&path, e))?;
        progress(i + 1, count);
    }
    Ok(())
}

fn frame_rate(sim: &Sim) -> f64 {
    let n = sim.frame_count();
    if n < 2 {
        return 0.0;
    }
    ((n - 1) as f64 / (sim.stamp(n - 1) - sim.stamp(0)).secs() * 1e6).round() / 1e6
}

/// The images of a camera, stamped by its own clock.
fn image_table(sim: &Sim, camera: &RigCamera) -> String {
    let stamps = (0..sim.frame_count()).map(|i| camera.from_imu_clock(sim.stamp(i)).0);
    stamps.fold(IMAGE_COLUMNS.to_string(), |table, t| table + &format!("{t},{t}.png\n"))
}

fn imu_table(sim: &Sim) -> Vec<u8> {
    let mut table = IMU_COLUMNS.as_bytes().to_vec();
    sim.imu().iter().for_each(|sample| imu_row(&mut table, sample).expect(IN_MEMORY));
    table
}

fn baro_table(sim: &Sim) -> Vec<u8> {
    let mut table = BARO_COLUMNS.as_bytes().to_vec();
    sim.aids().iter().for_each(|reading| aid_row(&mut table, reading).expect(IN_MEMORY));
    table
}

fn truth_table(sim: &Sim) -> Vec<u8> {
    let mut table =
        b"#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], \
                      v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], \
                      b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], \
                      b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
            .to_vec();
    for m in sim.imu() {
        let x = sim.truth_at(m.t);
        let q = x.pose.q;
        let q = format!("{:.9},{:.9},{:.9},{:.9}", q.w, q.x, q.y, q.z);
        let [p, v, gyro, accel] = [x.pose.p, x.v_world, x.gyro_bias, x.accel_bias].map(commas);
        writeln!(table, "{},{p},{q},{v},{gyro},{accel}", m.t.0).expect(IN_MEMORY);
    }
    table
}

const IN_MEMORY: &str = "writing to memory cannot fail";

fn make_dir(path: &Path) -> Result<(), Fault> {
    fs::create_dir_all(path).map_err(|e| cannot(path, e))
}

/// Writes a file into a folder, which is made where it is missing.
fn put(folder: &Path, name: &str, content: impl AsRef<[u8]>) -> Result<(), Fault> {
    make_dir(folder)?;
    let path = folder.join(name);
    fs::write(&path, content).map_err(|e| cannot(&path, e))
}

fn cannot(path: &Path, what: impl ToString) -> Fault {
    let fix = "check that the folder is writable and has room";
    Fault::new(FaultKind::NoOutput, path.display().to_string(), what.to_string(), fix)
}
