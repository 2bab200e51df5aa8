//! One flight with one setting: error against its truth, and the time of each stage.

use crate::inputs::Flight;
use std::time::Instant;
use stipple::config::Board;
use stipple::frontend::{Frontend, Prediction, Rejected};
use stipple::output::metrics::{percentile, trajectory_error};
use stipple::vio::{Predictor, Vio};
use stipple_drivers::host::thread_cpu;
use stipple_drivers::{Fault, TimedPose};

/// Figures of one flight; `None` is not measured: no error without a trajectory.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    pub ate_m: Option<f64>,
    pub rte_1s_m: Option<f64>,
    pub rpe_deg: Option<f64>,
    /// Wall time of a frame in each stage, ms.
    pub frontend_ms_p50: f64,
    pub frontend_ms_p99: f64,
    pub estimator_ms_p50: f64,
    pub estimator_ms_p99: f64,
    /// CPU time of the thread, inertial samples included: what other programs take is not in it.
    pub cpu_ms_per_frame: f64,
    /// Frames a second by the wall clock.
    pub fps_one_thread: f64,
    /// Frames that gave a pose.
    pub tracked: usize,
    pub keyframes: u64,
    pub resets: u64,
    /// Solver iterations a frame.
    pub iterations_per_frame: f64,
    pub hash: u64,
}

pub fn measure(flight: &Flight, board: &Board) -> Result<Figures, Fault> {
    let mut frontend = Frontend::new(&flight.calibration, &board.frontend)?;
    let mut vio = Vio::new(&flight.calibration, &board.vio);
    let mut predictor = Predictor::new(&flight.calibration, &board.vio);
    let (mut before, mut rejected, mut keyframes) = (None, Rejected::default(), 0);
    let n = flight.frames.len();
    let mut trajectory: Vec<TimedPose> = Vec::with_capacity(n);
    let (mut frontend_ms, mut estimator_ms) = (Vec::with_capacity(n), Vec::with_capacity(n));
    let mut samples = flight.imu.iter();
    let (start, cpu) = (Instant::now(), thread_cpu());
    for frames in &flight.frames {
        // Up to the first sample at or past the frame, as `stipple replay` in lockstep.
        for sample in samples.by_ref() {
            vio.on_imu(*sample);
            predictor.on_imu(*sample);
            if sample.t >= frames.t {
                break;
            }
        }
        let begun = Instant::now();
        let prediction = Prediction { prev_from_now: predictor.motion_to(frames.t, before.as_ref()) };
        frontend.reject(&rejected);
        (before, rejected) = (vio.odometry(), vio.take_rejected());
        let tracks = frontend.track(frames, &prediction);
        let tracked = Instant::now();
        let update = vio.on_tracks(tracks);
        estimator_ms.push(tracked.elapsed().as_secs_f64() * 1e3);
        frontend_ms.push((tracked - begun).as_secs_f64() * 1e3);
        keyframes += u64::from(update.keyframe);
        if let Some(o) = update.odometry {
            trajectory.push(TimedPose { t: o.t, pose: o.world_from_body });
        }
    }
    let wall = start.elapsed().as_secs_f64();
    let cpu = (thread_cpu() - cpu).total_s();
    let error = trajectory_error(&trajectory, &flight.truth);
    let (of, stats) = (n.max(1) as f64, vio.stats());
    let rank = |ms: &[f64], p: f64| percentile(ms, p).unwrap_or(0.0);
    Ok(Figures {
        ate_m: error.as_ref().map(|e| e.ate_rmse_m),
        rte_1s_m: error.as_ref().and_then(|e| e.rte_1s_m),
        rpe_deg: error.as_ref().and_then(|e| e.rpe_deg),
        frontend_ms_p50: rank(&frontend_ms, 0.5),
        frontend_ms_p99: rank(&frontend_ms, 0.99),
        estimator_ms_p50: rank(&estimator_ms, 0.5),
        estimator_ms_p99: rank(&estimator_ms, 0.99),
        cpu_ms_per_frame: cpu * 1e3 / of,
        fps_one_thread: n as f64 / wall.max(1e-9),
        tracked: trajectory.len(),
        keyframes,
        resets: stats.resets,
        iterations_per_frame: stats.solver_iterations as f64 / of,
        hash: vio.hash(),
    })
}
