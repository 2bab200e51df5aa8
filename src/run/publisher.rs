//! States between frames: the newest that the estimator gave, carried by the inertial samples that came since, for the log.
//!
//! ```text
//! estimator -> newest update (the last wins) -> thread `imu`, per sample -> log
//! ```

use super::gate::{Clock, Stream};
use super::log::LogSender;
use crate::config::VioConfig;
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
    /// Replaces what was not taken yet. A frame that was refused replaces nothing.
    pub fn set(&self, update: &Update, imu_scale: [DVec3; 2]) {
        if !update.health.has(Health::FRAME_REJECTED) {
            *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some((*update, imu_scale));
        }
    }

    /// Takes it without waiting: where it is being replaced, it is there at the next sample.
    fn take(&self) -> Option<Given> {
        self.0.try_lock().ok()?.take()
    }
}

/// Carries states on a thread that has the inertial samples.
pub struct Publisher {
    pub newest: Newest,
    pub log: Option<LogSender>,
    predictor: Predictor,
    clock: Clock,
    period: Span,
    due: Option<Nanos>,
}

impl Publisher {
    /// A publisher of `rate_hz` states a second at most.
    pub fn new(calibration: &Calibration, vio: &VioConfig, rate_hz: f64) -> Publisher {
        Publisher {
            newest: Newest(Arc::default()),
            log: None,
            predictor: Predictor::new(calibration, vio),
            clock: Clock::default(),
            period: Span::from_secs(1.0 / rate_hz),
            due: None,
        }
    }

    /// Takes a sample, and logs the state at its stamp where one is due.
    pub fn on_imu(&mut self, sample: ImuSample) {
        let t = sample.t;
        let update = self.newest.take();
        if self.clock.went_back(Stream::Samples, t) {
            self.predictor.change_clock();
            self.due = None;
        } else if let Some((update, scale)) = update {
            self.predictor.set_scale(scale);
            self.predictor.on_update(&update);
        }
        self.predictor.on_imu(sample);
        if self.due.is_some_and(|due| t < due) {
            return;
        }
        // On a grid of periods, but for a gap of the samples.
        self.due = Some(self.due.map_or(t, |due| due.max(t - self.period)) + self.period);
        self.predictor.advance(t);
        if let Some((log, state)) = self.log.as_ref().zip(self.predictor.state_at(t)) {
            log.predicted((&state).into());
        }
    }
}
