//! States between frames: the newest that the estimator gave, carried by the inertial samples that came since, for the log and
//! for an autopilot.
//!
//! ```text
//! estimator -> newest update (the last wins) -> thread `imu`, per sample -> log, autopilot
//! ```

use super::gate::{Clock, Stream};
use super::log::LogSender;
use crate::config::Board;
use crate::publish::{self, Feeds, Source};
use crate::vio::{Health, Predictor, Update};
use glam::DVec3;
use std::sync::{Arc, Mutex, PoisonError};
use stipple_drivers::{Calibration, ImuSample, Nanos, Span};

/// What the estimator gave, and its factors, less one, on the readings of gyro and accelerometer.
type Given = (Update, [DVec3; 2]);

/// What it gave last.
#[derive(Clone)]
pub struct Newest(Arc<Mutex<Option<Given>>>);

impl Newest {
    /// Replaces what was not taken yet. A frame that was refused or left to inertia replaces nothing.
    pub fn set(&self, update: &Update, imu_scale: [DVec3; 2]) {
        if !update.health.has(Health::FRAME_REJECTED) && !update.carried {
            *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some((*update, imu_scale));
        }
    }

    /// Takes it without waiting: where it is being replaced, it is there at the next sample.
    fn take(&self) -> Option<Given> {
        self.0.try_lock().ok()?.take()
    }
}

/// Carries states on a thread that has the inertial samples.
pub struct Carrier {
    pub newest: Newest,
    pub log: Option<LogSender>,
    pub feeds: Feeds,
    predictor: Predictor,
    clock: Clock,
    /// Schedules of the log and of the autopilot.
    schedules: [Schedule; 2],
}

/// When states are due.
struct Schedule {
    /// `None`: never.
    period: Option<Span>,
    due: Option<Nanos>,
}

impl Schedule {
    fn new(rate_hz: f64) -> Schedule {
        Schedule { period: (rate_hz > 0.0).then(|| Span::from_secs(1.0 / rate_hz)), due: None }
    }

    /// Whether one is due at `t`; the next one then is a period later, on a grid but for a gap of the samples.
    fn takes(&mut self, t: Nanos) -> bool {
        let Some(period) = self.period.filter(|_| self.due.is_none_or(|due| t >= due)) else { return false };
        self.due = Some(self.due.map_or(t, |due| due.max(t - period)) + period);
        true
    }
}

/// States that an autopilot is offered in the place of frames that do not come, Hz.
const FILL_HZ: f64 = 30.0;

impl Carrier {
    /// Whether a board asks for states between frames.
    pub fn is_wanted(board: &Board) -> bool {
        board.log.predicted_hz > 0.0 || board.mavlink.address().is_some()
    }

    /// A carrier for the log at the board's rate, and for its autopilot.
    pub fn new(calibration: &Calibration, board: &Board) -> Carrier {
        let feed_hz = if board.mavlink.address().is_some() { FILL_HZ } else { 0.0 };
        Carrier {
            newest: Newest(Arc::default()),
            log: None,
            feeds: Feeds::default(),
            predictor: Predictor::new(calibration, &board.vio),
            clock: Clock::default(),
            schedules: [board.log.predicted_hz, feed_hz].map(Schedule::new),
        }
    }

    /// Takes a sample, and hands over the state at its stamp where one is due.
    pub fn on_imu(&mut self, sample: ImuSample) {
        let t = sample.t;
        let update = self.newest.take();
        if self.clock.went_back(Stream::Samples, t) {
            self.predictor.change_clock();
            self.schedules.iter_mut().for_each(|schedule| schedule.due = None);
        } else if let Some((update, scale)) = update {
            self.predictor.set_scale(scale);
            self.predictor.on_update(&update);
        }
        self.predictor.on_imu(sample);
        let [logs, feeds] = self.schedules.each_mut().map(|schedule| schedule.takes(t));
        if !logs && !feeds {
            return;
        }
        self.predictor.advance(t);
        let Some(state) = self.predictor.state_at(t) else { return };
        if let Some(log) = self.log.as_ref().filter(|_| logs) {
            log.predicted((&state).into());
        }
        if feeds {
            self.feeds.state(publish::State {
                odometry: state.odometry,
                rate: sample.gyro_body - state.odometry.gyro_bias,
                covariance: state.covariance,
                epoch: state.epoch,
                quality: state.quality,
                health: state.health,
                source: Source::Carried,
            });
        }
    }
}
