//! What a finished flight leaves: the end of its log, the report, the files of DIR, a few lines of text.

use super::log::{read, Log};
use super::mapping::{Drawn, MapResult};
use super::memory::mib;
use super::tracking::{OdometryRun, Tracker};
use super::Flown;
use crate::loops::{Closure, Corrections, Loops};
use crate::mem;
use crate::output::html::{write_html, Evidence};
use crate::output::metrics::{percentile, trajectory_error};
use crate::output::panel::Picture;
use crate::output::report::{seconds_to, Convergence, ExtrinsicsFound, LoopClosed, Report, TimeOffsetFound, GOOD_DB};
use crate::output::trajectory::{epoch_at, TumWriter};
use crate::output::{atomically, OutputDir};
use crate::publish::event::EventId;
use crate::vio::Part;
use std::borrow::Cow;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;
use stipple_drivers::{host, Fault, Nanos, TimedPose};

/// What was flown, as the report names it.
pub struct Title {
    pub dataset: String,
    pub board: String,
    pub pace: &'static str,
    pub scale: u32,
    pub truth: Vec<TimedPose>,
    /// Counters of opening the recording.
    pub opened: Vec<(&'static str, u64)>,
}

impl fmt::Display for Title {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} on {}, {}", self.dataset, self.board, self.pace)
    }
}

/// Writes the end of a flight, by a fault if there was one, to its log and closes it: all that comes after may fail. Answers
/// the files.
pub fn close_log(log: Log, title: &Title, flown: &mut Flown, fault: Option<&Fault>) -> Vec<PathBuf> {
    let sender = log.sender();
    sender.counters(counted(flown, None, &title.opened));
    let why = match fault {
        Some(fault) => fault.to_string(),
        None if host::stop_asked_for().load(Relaxed) => "stopped by a signal".into(),
        None => "the sensors or the time asked for ended".into(),
    };
    sender.event(EventId::End, &why);
    let files = log.finish(&mut flown.source);
    flown.warnings.extend(sender.notice().map(str::to_string));
    files
}

/// Writes the trajectory: from memory where that holds every pose, else from the log, and past its end what memory has.
pub fn write_trajectory(
    whole: bool,
    (estimated, epochs): (&[TimedPose], &[(Nanos, u32)]),
    logged: &[PathBuf],
    (out, name): (&OutputDir, &str),
    corrections: &Corrections,
) -> Result<(), Fault> {
    let in_map = |pose: &TimedPose| TimedPose { t: pose.t, pose: corrections.in_map(pose.t, &pose.pose) };
    out.write(name, |w| {
        let mut file = TumWriter::begin(w)?;
        let last = if whole { None } else { read::write_trajectory(logged, &mut file, in_map, |_, _| {})? };
        let mut rest = estimated.iter().filter(|pose| last.is_none_or(|last| pose.t > last));
        rest.try_for_each(|pose| file.pose(epoch_at(epochs, pose.t), &in_map(pose)))
    })
}

/// Measures a finished flight, writes DIR, and answers the report, and the first fault of a file that could not be written;
/// the others are tried. The trajectory comes first: no figure is worth it.
pub fn conclude(title: Title, mut flown: Flown, logged: &[PathBuf], out: &OutputDir) -> (Report, Option<Fault>) {
    let heap = mem::heap_after_seal();
    let mut report = Report {
        dataset: Some(title.dataset),
        board: Some(title.board),
        pace: Some(title.pace.into()),
        scale: Some(title.scale),
        keyframes: Some(flown.keyframes),
        wall_s: Some(flown.wall_s),
        energy_j: flown.energy.map(|energy| energy.joules),
        power_mean_w: flown.energy.map(|energy| energy.joules / energy.seconds),
        heap_after_seal: Some(heap),
        ..Report::default()
    };
    let estimated = track_figures(&mut report, &flown);
    let epochs = flown.tracker.odometry().map_or(vec![], |run| run.back.epochs.to_vec());
    let whole = |run: &OdometryRun| run.back.trajectory.is_whole() && !run.back.epochs.is_full();
    let whole = flown.tracker.odometry().is_none_or(whole);
    report.epochs = flown.tracker.odometry().map(|run| run.back.vio.epoch() + 1);
    report.loops = flown.loops.iter().flat_map(|loops| &loops.closures).map(closed).collect();
    let corrections = flown.loops.as_ref().map_or_else(Corrections::default, |loops| loops.corrections());
    let write = |name: &str, corrections: &Corrections| {
        write_trajectory(whole, (&estimated, &epochs), logged, (out, name), corrections)
    };
    let trajectory = write("trajectory.tum", &corrections);
    // Beside poses in the map, where places are recognised, those of the estimator alone.
    let odometry = flown.loops.as_ref().map_or(Ok(()), |_| write("odometry.tum", &Corrections::default()));
    let fault = trajectory.and(odometry).err().map(|fault| {
        let fix = "make room or mend the disk, then `stipple recover` with this folder writes what the log holds";
        Fault { fix: fix.into(), ..fault }
    });
    let error_of =
        |poses: &[TimedPose]| trajectory_error(poses, &title.truth).filter(|_| flown.tracker.odometry().is_some());
    report.odometry_ate_rmse_m = error_of(&estimated).filter(|_| flown.loops.is_some()).map(|e| e.ate_rmse_m);
    let in_map = |pose: &TimedPose| TimedPose { t: pose.t, pose: corrections.in_map(pose.t, &pose.pose) };
    let estimated: Vec<TimedPose> = estimated.iter().map(in_map).collect();
    let error = error_of(&estimated);
    if let Some(e) = &error {
        report.ate_rmse_m = Some(e.ate_rmse_m);
        report.rte_1s_m = e.rte_1s_m;
        report.rpe_deg = e.rpe_deg;
    }
    let map = flown.map.take().map(|map| map.conclude(out));
    if let Some(m) = &map {
        report.anchors = Some(m.anchors);
        report.iterations = Some(m.iterations);
        report.iteration_ms_p50 = m.iteration_ms_p50;
        report.iteration_ms_p99 = m.iteration_ms_p99;
        report.splats = Some(m.splats);
        report.gpu_bytes = Some(m.gpu_bytes);
        report.device = Some(m.device.clone());
        report.curve = m.curve.clone();
        for scored in &m.seams {
            let of_it = report.loops.iter_mut().find(|l| l.t_ns == scored.t_ns);
            of_it.into_iter().for_each(|l| l.map = Some(scored.scores));
        }
        report.seconds_to_25_db = seconds_to(&report.curve, GOOD_DB);
        report.kernels = m.kernels.clone();
        report.left_out.extend(m.left_out.clone());
        report.quality = m.quality.clone();
        report.heap_after_seal = Some(heap + m.heap_after_seal);
        report.map_rss_peak_bytes = Some(m.rss_peak_bytes).filter(|bytes| *bytes > 0);
        if let Some(why) = &m.failure {
            warn(&mut flown.warnings, format!("the map is incomplete: {why}"));
        }
    }
    flown.loops.iter().flat_map(|loops| place_warnings(loops)).for_each(|what| warn(&mut flown.warnings, what));
    if flown.tracker.odometry().is_some_and(|run| run.back.trajectory.is_empty()) {
        let why = "no frame got a pose, odometry never started: its health and the counters in report.json say why";
        warn(&mut flown.warnings, why.into());
    }
    if let Some(capture) = &flown.capture {
        (report.camera_cpu_ms, report.camera_kernel_ms) = capture.ms_a_frame().unzip();
        report.camera_copies = capture.copies(&flown.source);
    }
    flown.counters.lines_lost.add(super::status::lines_lost());
    report.set_counters(&counted(&flown, map.as_ref(), &title.opened));
    if let Some(run) = flown.tracker.odometry() {
        report.set_health(run.back.vio.health_frames());
    }
    (report.warnings, report.rss_peak_bytes) = (flown.warnings.len() as u64, host::rss_peak_bytes());
    let tracking_ms: &[(Nanos, f64)] = flown.tracker.odometry().map_or(&[], |run| &run.back.frame_ms);
    let (estimated, truth, error, warnings) = (&estimated[..], &title.truth[..], error.as_ref(), &flown.warnings[..]);
    let evidence = Evidence { estimated, epochs: &epochs, truth, error, tracking_ms, pictures: &[], warnings };
    let written = write_files(&report, &evidence, map.map_or(vec![], |m| m.drawn), out);
    (report, fault.or(written))
}

/// What a later run would miss: places that are not on the disk, or are in another frame than those of earlier runs.
fn place_warnings(loops: &Loops) -> impl Iterator<Item = String> {
    let n = loops.stats.places_unkept;
    let unkept = format!("places/: {n} places could not be written: a later run will not find itself there; check the folder and the disk");
    let apart = "no place of the earlier runs in this folder was recognised: trajectory.tum is in a frame of its own, not in that of their map";
    let is_apart = loops.stats.places_read > 0 && !loops.is_in_earlier_map();
    (n > 0).then_some(unkept).into_iter().chain(is_apart.then(|| apart.into()))
}

fn warn(warnings: &mut Vec<String>, what: String) {
    super::status::print_err(format_args!("stipple: warning: {what}"));
    warnings.push(what);
}

/// Every counter of a run, each under one name.
fn counted(flown: &Flown, map: Option<&MapResult>, opened: &[(&'static str, u64)]) -> Vec<(Cow<'static, str>, u64)> {
    let owned = |list: &[(&'static str, u64)]| list.iter().map(|(name, n)| ((*name).into(), *n)).collect::<Vec<_>>();
    let mut all = owned(&flown.counters.list());
    let mapper = map.map_or(vec![], |m| m.counters.iter().map(|(name, n)| (name.clone().into(), *n)).collect());
    let loops = flown.loops.as_ref().map_or(vec![], |loops| loops.stats.list());
    let others = [owned(opened), owned(&flown.source), owned(&flown.tracker.counters()), owned(&loops), mapper];
    for (name, n) in others.into_iter().flatten() {
        match all.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => *sum += n,
            None => all.push((name, n)),
        }
    }
    all
}

/// A closure as the report has it.
fn closed(c: &Closure) -> LoopClosed {
    let ([moved_m, moved_rad], corners) = (c.moved, c.inliers as u64);
    let (p_m, yaw_rad) = (c.measured.p.to_array(), c.measured.yaw);
    let (t_ns, with_ns, joins) = (c.t.0, c.with.0, c.joins.is_some());
    LoopClosed { t_ns, with_ns, corners, p_m, yaw_rad, moved_m, moved_rad, joins, earlier: c.earlier, map: None }
}

/// Fills in the tracking figures; answers the trajectory.
fn track_figures(report: &mut Report, flown: &Flown) -> Vec<TimedPose> {
    let c = &flown.counters;
    let lost =
        [&c.frames_overwritten, &c.frames_unreadable, &c.frames_not_newer, &c.frames_timestamp_jump, &c.frames_frozen];
    let dropped = lost.iter().map(|counter| counter.get()).sum();
    report.frames_dropped = Some(dropped);
    report.frames = Some((flown.frames as u64).saturating_sub(dropped));
    let run = match &flown.tracker {
        Tracker::Table(table) => return table.poses.clone(),
        Tracker::Observer(_) => return vec![],
        Tracker::Odometry(run) => run,
    };
    let ms: Vec<f64> = run.back.frame_ms.iter().map(|(_, ms)| *ms).collect();
    report.tracking_threads = Some(run.threads);
    report.tracking_fps = run.fps();
    report.tracking_cpu_ms = run.cpu_ms();
    let percentiles = |ms: &[f64]| (percentile(ms, 0.5), percentile(ms, 0.99));
    (report.tracking_ms_p50, report.tracking_ms_p99) = percentiles(&ms);
    (report.frontend_ms_p50, report.frontend_ms_p99) = percentiles(&run.front.ms);
    (report.estimator_ms_p50, report.estimator_ms_p99) = percentiles(&run.back.ms);
    if let Some(rig) = run.back.vio.rig() {
        let three = |v: &[f64], at: usize| std::array::from_fn(|i| v[at + i]);
        let late = rig.time_offsets.iter().enumerate().filter_map(|(camera, found)| {
            let [offset_s, offset_sigma_s] = (*found)?;
            Some(TimeOffsetFound { camera, offset_s, offset_sigma_s })
        });
        report.time_offsets = late.collect();
        let found = rig.extrinsics.iter().enumerate().filter_map(|(camera, e)| {
            let [v, s] = (*e)?;
            Some(ExtrinsicsFound {
                camera,
                p_m: three(&v, 0),
                p_sigma_m: three(&s, 0),
                theta_rad: three(&v, 3),
                theta_sigma_rad: three(&s, 3),
            })
        });
        report.extrinsics = found.collect();
        let judged = run.back.vio.rig_parts().map(|judged| {
            let (part, camera) = match judged.part {
                Part::TimeOffset(c) => ("time_offset", Some(c)),
                Part::Extrinsics(c) => ("extrinsics", Some(c)),
                Part::GyroScale => ("gyro_scale", None),
                Part::AccelScale => ("accel_scale", None),
            };
            let (converged, sigma_left) = (judged.doubt.is_none(), judged.left);
            Convergence { part: part.into(), camera, converged, sigma_left }
        });
        report.convergence = judged.collect();
        if let Some([v, s]) = rig.imu_scale {
            (report.gyro_scale, report.gyro_scale_sigma) = (Some(three(&v, 0)), Some(three(&s, 0)));
            (report.accel_scale, report.accel_scale_sigma) = (Some(three(&v, 3)), Some(three(&s, 3)));
        }
    }
    (report.height_bias_m, report.height_bias_sigma_m) = run.back.vio.height_bias().map(|[b, s]| (b, s)).unzip();
    report.left_out.push(run.left_out());
    report.estimator_bytes = Some(run.bytes);
    if let Some((least, median, under)) = run.back.vio.quality_summary() {
        (report.quality_min, report.quality_p50) = (Some(least.into()), Some(median.into()));
        report.quality_under_50 = Some(under);
    }
    report.vio_hash = Some(format!("{:016x}", run.back.vio.hash()));
    run.back.trajectory.to_vec()
}

/// Writes the files of DIR, and answers the first fault; `evidence` is without its pictures.
fn write_files(report: &Report, evidence: &Evidence, drawn: Vec<Drawn>, out: &OutputDir) -> Option<Fault> {
    let write = |dir: &Path| {
        drawn.iter().try_for_each(|d| atomically(&dir.join(format!("{}.png", d.name)), |w| d.picture.write_png(w)))
    };
    let renders = if drawn.is_empty() { Ok(()) } else { out.replace_folder("renders", write) };
    let pictures: Vec<(String, Picture)> = drawn.into_iter().map(|d| (d.caption, d.picture)).collect();
    let evidence = Evidence { pictures: &pictures, ..*evidence };
    let page = out.write("report.html", |w| write_html(w, report, &evidence));
    // Last: whoever finds report.json finds what could be written of all that it speaks of.
    let figures = out.write("report.json", |w| report.write_json(w));
    [renders, page, figures].into_iter().find_map(Result::err)
}

/// Lines of figures for a person to read.
pub fn lines(r: &Report, out: &OutputDir) -> String {
    let or_dash = |v: Option<f64>, digits: usize, unit: &str| {
        v.map_or_else(|| "-".to_string(), |v| format!("{v:.digits$} {unit}"))
    };
    let count = |v: Option<u64>| v.map_or_else(|| "-".to_string(), |v| v.to_string());
    let bytes = |v: Option<u64>| or_dash(v.map(mib), 1, "MiB");
    let counted = |name: &str| r.counted().find(|(n, _)| *n == name).map_or(0, |(_, n)| n);
    format!(
        "trajectory  ATE {}, 1 s: {} {}\n\
         tracking    {} frames ({} dropped), {} a frame, {} at the 99th percentile\n\
         odometry    {} frames/s on {} threads, {} of CPU a frame, {}, quality {}, hash {}\n\
         loops       {} closed; {} of {} keyframes that looked for a place recognised one; {} epochs joined\n\
         map         {} keyframes, {} anchors, {} Gaussians, {} iterations of {}\n\
         quality     {} PSNR, {} SSIM; held out {} ({} with the exposure fitted, {} with the pose too)\n\
         memory      GPU {}, resident {}, {} heap allocations after the seal\n\
         report      {}",
        or_dash(r.ate_rmse_m, 4, "m"),
        or_dash(r.rte_1s_m, 4, "m"),
        or_dash(r.rpe_deg, 2, "deg"),
        count(r.frames),
        count(r.frames_dropped),
        or_dash(r.tracking_ms_p50, 1, "ms"),
        or_dash(r.tracking_ms_p99, 1, "ms"),
        r.tracking_fps.map_or_else(|| "-".to_string(), |v| format!("{v:.0}")),
        count(r.tracking_threads.map(u64::from)),
        or_dash(r.tracking_cpu_ms, 1, "ms"),
        bytes(r.estimator_bytes),
        count(r.quality_p50.map(u64::from)),
        r.vio_hash.as_deref().unwrap_or("-"),
        counted("loops_closed"),
        counted("loops_recognised"),
        counted("loop_queries"),
        counted("epochs_joined"),
        count(r.keyframes),
        count(r.anchors),
        count(r.splats),
        count(r.iterations),
        or_dash(r.iteration_ms_p50, 1, "ms"),
        or_dash(r.quality.psnr_db, 2, "dB"),
        r.quality.ssim.map_or_else(|| "-".to_string(), |v| format!("{v:.3}")),
        or_dash(r.quality.psnr_heldout_db, 2, "dB"),
        or_dash(r.quality.psnr_heldout_fitted_db, 2, "dB"),
        or_dash(r.quality.psnr_heldout_aligned_db, 2, "dB"),
        bytes(r.gpu_bytes),
        bytes(r.rss_peak_bytes),
        count(r.heap_after_seal),
        out.file("report.html").display(),
    )
}
