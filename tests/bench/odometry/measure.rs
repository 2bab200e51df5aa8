//! One flight with one setting: error against its truth, and the time of each stage.

use crate::inputs::Flight;
use std::time::Instant;
use stipple::config::Board;
use stipple::counters::Counters;
use stipple::output::metrics::{percentile, trajectory_error};
use stipple::run::tracking::{FramePacket, OdometryRun};
use stipple_drivers::host::thread_cpu;
use stipple_drivers::Fault;

/// Figures of one flight; `None` is not measured: no error without a trajectory.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    pub ate_m: Option<f64>,
    pub rte_1s_m: Option<f64>,
    pub rpe_deg: Option<f64>,
    /// Wall time of a tracked frame in each stage, ms.
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
    /// Frames of these that were left to inertia.
    pub carried: u64,
    pub keyframes: u64,
    pub resets: u64,
    /// Solver iterations a frame.
    pub iterations_per_frame: f64,
    pub hash: u64,
}

pub fn measure(flight: &Flight, board: &Board) -> Result<Figures, Fault> {
    let n = flight.frames.len();
    let OdometryRun { mut front, mut back, .. } = OdometryRun::new(&flight.calibration, board, n)?;
    let (mut packet, counters) = (FramePacket::for_rig(&flight.calibration, 0), Counters::default());
    let (start, mut keyframes) = (back.answer(), 0);
    let (mut answer, mut next) = (start.clone(), start);
    let mut samples = flight.imu.iter();
    let (start, cpu) = (Instant::now(), thread_cpu());
    for frames in &flight.frames {
        packet.clear();
        // Up to the first sample at or past the frame, as `stipple replay` in lockstep.
        for sample in samples.by_ref() {
            packet.push_imu(*sample, &counters);
            if sample.t >= frames.t {
                break;
            }
        }
        packet.frames = frames.clone();
        front.track(&mut packet, &answer);
        back.estimate(&mut packet);
        (answer, next) = (next, back.answer());
        keyframes += u64::from(packet.tracked.as_ref().is_some_and(|tracked| tracked.keyframe));
    }
    let wall = start.elapsed().as_secs_f64();
    let cpu = (thread_cpu() - cpu).total_s();
    let error = trajectory_error(&back.trajectory, &flight.truth);
    let (of, stats) = (n.max(1) as f64, back.vio.stats());
    let rank = |ms: &[f64], p: f64| percentile(ms, p).unwrap_or(0.0);
    Ok(Figures {
        ate_m: error.as_ref().map(|e| e.ate_rmse_m),
        rte_1s_m: error.as_ref().and_then(|e| e.rte_1s_m),
        rpe_deg: error.as_ref().and_then(|e| e.rpe_deg),
        frontend_ms_p50: rank(&front.ms, 0.5),
        frontend_ms_p99: rank(&front.ms, 0.99),
        estimator_ms_p50: rank(&back.ms, 0.5),
        estimator_ms_p99: rank(&back.ms, 0.99),
        cpu_ms_per_frame: cpu * 1e3 / of,
        fps_one_thread: n as f64 / wall.max(1e-9),
        tracked: back.trajectory.len(),
        carried: stats.frames_carried,
        keyframes,
        resets: stats.resets,
        iterations_per_frame: stats.solver_iterations as f64 / of,
        hash: back.vio.hash(),
    })
}
