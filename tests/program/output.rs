//! A whole output folder from a synthetic run: every file is there, complete, and says the same.
//! It stays in the build folder (`tmp/output`) to be looked at.

use glam::{DQuat, DVec3};
use std::path::{Path, PathBuf};
use stipple::map::{CurvePoint, Evaluation, Gaussian, Panel};
use stipple::output::html::{write_html, Evidence};
use stipple::output::metrics::{percentile, trajectory_error};
use stipple::output::panel::{panel, Picture};
use stipple::output::ply::write_ply;
use stipple::output::report::{KernelTime, Report};
use stipple::output::trajectory::{epoch_at, TumWriter};
use stipple::output::{atomically, OutputDir};
use stipple_drivers::{Nanos, Pose, TimedPose};

/// Repeatable numbers in -1..1.
fn noise(i: usize) -> f64 {
    let x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 31)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    ((x >> 11) as f64 / (1u64 << 53) as f64) * 2.0 - 1.0
}

fn flight(hz: f64, secs: f64) -> Vec<TimedPose> {
    let at = |i: usize| {
        let s = i as f64 / hz;
        let p = DVec3::new(2.2 * (0.31 * s).sin(), 1.6 * (0.47 * s).cos(), 1.2 + 0.5 * (0.23 * s).sin());
        TimedPose { t: Nanos(1_400_000_000 + (s * 1e9) as i64), pose: Pose::new(DQuat::from_rotation_z(0.2 * s), p) }
    };
    (0..(hz * secs) as usize).map(at).collect()
}

/// The flight from its own start, with slow drift and some noise.
fn estimate(truth: &[TimedPose]) -> Vec<TimedPose> {
    let start = truth[0].pose.inverse();
    let off = |i: usize| {
        let s = i as f64 / 20.0;
        let drift = DVec3::new(0.02 * (0.2 * s).sin(), 0.015 * (0.11 * s).cos(), 0.0006 * s);
        let jitter = DVec3::new(noise(3 * i), noise(3 * i + 1), noise(3 * i + 2)) * 0.001;
        Pose { q: DQuat::from_rotation_z(0.0003 * s), p: drift + jitter }
    };
    let moved = |(i, e): (usize, &TimedPose)| TimedPose { t: e.t, pose: start * off(i) * e.pose };
    truth.iter().step_by(10).enumerate().map(moved).collect()
}

/// A floor and a wall with stripes, seen slightly blurred and noisy.
fn picture(seed: usize) -> Picture {
    let (width, height) = (376, 240);
    let grey = |i: usize, soft: f64| {
        let (x, y) = ((i % width) as f64, (i / width) as f64);
        let d = depth(x, y) as f64;
        let stripes = (40.0 / d * (x * 0.05 + seed as f64)).sin() * (60.0 / d).cos();
        0.45 + 0.3 * (stripes * soft).tanh() / soft.tanh() - 0.0003 * y
    };
    let n = width * height;
    let observed: Vec<u8> = (0..n).map(|i| ((grey(i, 3.0) + 0.015 * noise(i)) * 255.0) as u8).collect();
    let rendered: Vec<f32> = (0..n).map(|i| grey(i, 1.2) as f32).collect();
    let mut depths: Vec<f32> = (0..n).map(|i| depth((i % width) as f64, (i / width) as f64)).collect();
    depths[..width * 20].fill(f32::NAN);
    let valid: Vec<u8> = (0..n).map(|i| (i % width > 12) as u8).collect();
    panel(&Panel { name: String::new(), width, height, observed, rendered, depth: depths, valid, psnr_db: Some(24.6) })
}

fn depth(x: f64, y: f64) -> f32 {
    let wall = 4.5 + 0.006 * x;
    if y > 130.0 {
        (120.0 / (y - 100.0)).min(wall) as f32
    } else {
        wall as f32
    }
}

fn report(tracking: &[f64]) -> Report {
    let curve = |i: usize| {
        let t = i as f64 * 5.0;
        let psnr = 24.9 - 12.0 * (-t / 18.0).exp() + 0.15 * noise(i);
        CurvePoint {
            t_s: t,
            psnr_db: Some(psnr),
            psnr_heldout_db: (i > 1).then_some(psnr - 0.8 - 0.01 * t),
            splats: (48_000.0 * (1.0 - (-t / 25.0).exp())) as u64,
            iterations: (13.0 * t) as u64,
        }
    };
    let kernel = |(name, total_ms): (&str, f64)| KernelTime { name: name.into(), dispatches: 780, total_ms };
    let kernels = [
        ("raster_backward", 31_000.0),
        ("raster_forward", 17_500.0),
        ("ssim", 9_800.0),
        ("sort_scatter", 4_100.0),
        ("project_backward", 2_700.0),
        ("project", 1_900.0),
        ("bin_emit", 1_250.0),
        ("bin_count", 800.0),
        ("sort_histogram", 420.0),
        ("scan", 160.0),
    ];
    let counts = [("outliers", 1423), ("frames_overwritten", 3), ("imu_overflow", 0)];
    Report {
        dataset: Some("recordings/synthetic_flight".into()),
        board: Some("lavapipe".into()),
        pace: Some("recorded".into()),
        scale: Some(2),
        device: Some("synthetic device".into()),
        frames: Some(1200),
        frames_dropped: Some(3),
        keyframes: Some(118),
        anchors: Some(21),
        tracking_fps: Some(61.8),
        tracking_ms_p50: percentile(tracking, 0.5),
        tracking_ms_p99: percentile(tracking, 0.99),
        quality: Evaluation {
            psnr_db: Some(24.87),
            ssim: Some(0.812),
            psnr_heldout_db: Some(23.4),
            ssim_heldout: Some(0.774),
            ..Evaluation::default()
        },
        splats: Some(45_632),
        iterations: Some(780),
        iteration_ms_p50: Some(76.3),
        gpu_bytes: Some(61 << 20),
        rss_peak_bytes: Some(212 << 20),
        heap_after_seal: Some(0),
        wall_s: Some(60.8),
        vio_hash: Some("8f14e45fceea167a".into()),
        warnings: 2,
        curve: (0..13).map(curve).collect(),
        kernels: kernels.into_iter().map(kernel).collect(),
        counts: counts.into_iter().map(|(name, n)| (format!("count_{name}"), n)).collect(),
        ..Report::default()
    }
}

fn splats() -> impl ExactSizeIterator<Item = Gaussian> {
    (0..1000u16).map(|i| Gaussian {
        mean: [i as f32 * 0.01, 0.0, 1.0],
        log_scale: [-3.0; 3],
        quat_xyzw: [0.0, 0.0, 0.0, 1.0],
        opacity_logit: 1.0,
        colour: [i as f32 / 1000.0; 3],
    })
}

/// About 14 ms a frame, a slow one at every 97th and one bad hiccup.
fn tracking_ms(i: usize) -> f64 {
    let slow = if i % 97 == 0 { 16.0 } else { 0.0 };
    let hiccup = if i == 700 { 400.0 } else { 0.0 };
    14.0 + 2.5 * noise(i) + slow + hiccup
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("output")
}

#[test]
fn a_run_leaves_complete_files_that_agree() {
    let out = OutputDir::create(&folder()).unwrap();
    let truth = flight(200.0, 60.0);
    let estimated = estimate(&truth);
    let error = trajectory_error(&estimated, &truth).unwrap();
    assert!(error.ate_rmse_m > 0.005 && error.ate_rmse_m < 0.05, "{}", error.ate_rmse_m);

    let tracking: Vec<(Nanos, f64)> = estimated.iter().enumerate().map(|(i, e)| (e.t, tracking_ms(i))).collect();
    let values: Vec<f64> = tracking.iter().map(|m| m.1).collect();
    let report = Report {
        ate_rmse_m: Some(error.ate_rmse_m),
        rte_1s_m: error.rte_1s_m,
        rpe_deg: error.rpe_deg,
        ..report(&values)
    };
    let caption = |i: usize| format!("keyframe {} at {:.1} s, training view", 16 * i, 7.5 * i as f64);
    let pictures: Vec<(String, Picture)> = (0..8).map(|i| (caption(i), picture(i))).collect();
    let warnings = vec![
        "mav0/cam1/data.csv:214: image 1403636590213555456.png has no partner within 2 ms; the pair is skipped".into(),
        "mav0/imu0/data.csv:5120: 35 ms without inertial samples".into(),
    ];
    let epochs = [(Nanos(0), 0), (Nanos(30_000_000_000), 1)];
    let evidence = Evidence {
        estimated: &estimated,
        epochs: &epochs,
        truth: &truth,
        error: Some(&error),
        tracking_ms: &tracking,
        pictures: &pictures,
        warnings: &warnings,
    };

    out.write("trajectory.tum", |w| {
        let mut file = TumWriter::begin(w)?;
        estimated.iter().try_for_each(|pose| file.pose(epoch_at(&epochs, pose.t), pose))
    })
    .unwrap();
    out.write("map.ply", |w| write_ply(w, splats())).unwrap();
    out.replace_folder("renders", |dir| {
        let name = |i| dir.join(format!("{i:04}.png"));
        pictures.iter().enumerate().try_for_each(|(i, (_, p))| atomically(&name(i), |w| p.write_png(w)))
    })
    .unwrap();
    out.write("report.html", |w| write_html(w, &report, &evidence)).unwrap();
    out.write("report.json", |w| report.write_json(w)).unwrap();

    let read = |name: &str| std::fs::read(out.file(name)).unwrap();
    let json: serde_json::Value = serde_json::from_slice(&read("report.json")).unwrap();
    assert_eq!(
        (&json["splats"], &json["count_outliers"], &json["psnr_db"]),
        (&45_632.into(), &1423.into(), &24.87.into())
    );
    assert_eq!(json["curve"].as_array().unwrap().len(), report.curve.len());
    let mut map = Vec::new();
    write_ply(&mut map, splats()).unwrap();
    assert_eq!(read("map.ply"), map);
    assert_eq!(read("trajectory.tum").iter().filter(|b| **b == b'\n').count(), 2 + estimated.len(), "head and epoch");
    assert_eq!(std::fs::read_dir(out.file("renders")).unwrap().count(), 1 + 8, "the list of them, and they");
    let hidden = |e: std::io::Result<std::fs::DirEntry>| e.unwrap().file_name().to_string_lossy().starts_with('.');
    assert!(!std::fs::read_dir(out.path()).unwrap().any(hidden), "nothing half written is left");
    check_page(&String::from_utf8(read("report.html")).unwrap(), &report);
}

fn check_page(page: &str, report: &Report) {
    assert!(page.len() < 8 << 20, "{} bytes", page.len());
    let ate = format!("{:.4}", report.ate_rmse_m.unwrap());
    for figure in [ate.as_str(), "24.87", "45\u{202f}632", "76.3"] {
        assert!(page.contains(figure), "{figure}");
    }
    for title in
        ["PSNR", "Seen from above", "Position error after alignment", "GPU time by kernel", "imu0/data.csv:5120"]
    {
        assert!(page.contains(title), "{title}");
    }
    assert_eq!(page.matches("data:image/png;base64,").count(), 6, "bounded number of pictures");
    // With a neighbour that base64 does not have.
    assert!(!page.contains("NaN ") && !page.contains(" NaN") && !page.contains(">NaN"));
    for outside in ["http:", "https:", "<script", "<link", "@import", "url("] {
        assert!(!page.contains(outside), "{outside}");
    }
}
