//! When samples were taken, by the host's clock: an estimate of the period and phase of a free-running sensor.
//!
//! A read of n samples between two instants says that the newest was taken less than a period before the first instant and
//! not after the second. A Kalman filter of (stamp of the newest sample, period) takes the middle of that interval as a
//! measurement whose deviation is that of the interval, and is then clamped into it: the interval is a fact. A data-ready
//! edge is a measurement of deviation `EDGE_SIGMA`. A late read makes its interval wider and so weighs less.
//!
//! Two promises hold whatever comes in: stamps grow strictly, and none is later than the read that brought the sample,
//! unless the stamp before was already.

use crate::types::{Nanos, Span};

/// Latency of an interrupt on a loaded kernel, ns; measured tails are longer, which costs nothing at these rates.
const EDGE_SIGMA: f64 = 20e3;
/// MEMS oscillators are trimmed to a few percent; the filter starts from this uncertainty of the period.
const PERIOD_SIGMA: f64 = 0.03;
/// The period is kept within these multiples of the nominal one (LSM6DSOX: ±15 % over temperature).
const PERIOD_WITHIN: (f64, f64) = (0.7, 1.4);
/// Random walk of the period, relative, per root second: a degree a minute at 30 ppm/K is half of it.
const WANDER: f64 = 1e-6;
/// Jitter of the sensor's own clock from sample to sample, ns.
const JITTER: f64 = 1e3;
/// Periods by which a read may disagree with the prediction before the estimate starts anew.
const SLIP_PERIODS: f64 = 3.0;
/// Periods by which the prediction may leave the interval of a read before samples must have been lost.
const SLIP_MIN: f64 = 0.1;

/// The line on which the samples lie: sample number to instant. Durations are in ns.
#[derive(Clone, Debug)]
pub struct Timeline {
    nominal: f64,
    /// Instant that `newest` is relative to: a double cannot hold both.
    anchor: i64,
    /// The newest sample.
    newest: f64,
    period: f64,
    /// Variances of `newest` and `period`, and their covariance.
    var: [f64; 3],
    started: bool,
    /// The stamp that was given last.
    last: Option<i64>,
}

impl Timeline {
    /// A line that knows the nominal period and no sample yet.
    pub fn new(nominal: Span) -> Timeline {
        let nominal = nominal.0.max(1) as f64;
        let var = [0.0, (PERIOD_SIGMA * nominal).powi(2), 0.0];
        Timeline { nominal, anchor: 0, newest: 0.0, period: nominal, var, started: false, last: None }
    }

    /// The period, as estimated so far.
    pub fn period(&self) -> Span {
        Span(self.period.round() as i64)
    }

    /// Forgets the phase and keeps the period: the sensor was reset.
    pub fn forget_phase(&mut self) {
        self.started = false;
    }

    /// Takes a read between two instants that brought `n` samples; `edge` is when the newest was ready, where an edge told.
    /// False where the line had slipped and starts anew.
    pub fn advance(&mut self, n: usize, before: Nanos, after: Nanos, edge: Option<Nanos>) -> bool {
        let after = after.max(before);
        if !self.started {
            if n > 0 {
                self.begin(before, after, edge);
            }
            return true;
        }
        let moved = before.0.saturating_sub(self.anchor);
        (self.anchor, self.newest) = (before.0, self.newest - moved as f64);
        self.predict(n as f64);
        let (low, high) = (-self.period, (after - before).0 as f64);
        let slip = SLIP_PERIODS * self.period + 4.0 * self.var[0].sqrt();
        if self.newest < low - slip || self.newest > high + slip {
            if n > 0 {
                self.begin(before, after, edge);
            }
            return n == 0;
        }
        match edge {
            Some(t) => self.measure((t - before).0 as f64, EDGE_SIGMA.powi(2)),
            None if n > 0 => self.measure(0.5 * (low + high), (high - low).powi(2) / 12.0),
            // The same sample again is no new measurement, but it is still the newest.
            None => {}
        }
        self.clamp(high);
        true
    }

    /// Clamps the newest sample into the interval. A line that leaves it a little is wrong in its period as the covariances
    /// say; one that leaves it far has lost a sample, or got one twice, which says nothing about the period.
    fn clamp(&mut self, high: f64) {
        let outside = self.newest.clamp(-self.period, high) - self.newest;
        if outside.abs() > SLIP_MIN * self.period + 4.0 * self.var[0].sqrt() {
            self.newest += outside.signum() * self.period;
        } else if outside != 0.0 {
            self.shift_period(outside * self.var[2] / self.var[0].max(1.0));
        }
        self.newest = self.newest.clamp(-self.period, high);
    }

    fn shift_period(&mut self, by: f64) {
        let (low, high) = PERIOD_WITHIN;
        self.period = (self.period + by).clamp(low * self.nominal, high * self.nominal);
    }

    fn begin(&mut self, before: Nanos, after: Nanos, edge: Option<Nanos>) {
        self.anchor = before.0;
        let width = self.period + (after - before).0 as f64;
        let (newest, var) = match edge {
            Some(t) => ((t - before).0 as f64, EDGE_SIGMA.powi(2)),
            None => (width * 0.5 - self.period, width * width / 12.0),
        };
        (self.newest, self.var[0], self.var[2]) = (newest, var, 0.0);
        self.started = true;
    }

    fn predict(&mut self, n: f64) {
        let [x, p, c] = self.var;
        let seconds = n * self.period * 1e-9;
        self.newest += n * self.period;
        self.var = [
            x + 2.0 * n * c + n * n * p + n * JITTER * JITTER,
            p + (WANDER * self.period).powi(2) * seconds,
            c + n * p,
        ];
    }

    fn measure(&mut self, newest: f64, variance: f64) {
        let [x, p, c] = self.var;
        let (gain_x, gain_p) = (x / (x + variance), c / (x + variance));
        let error = newest - self.newest;
        self.newest += gain_x * error;
        self.shift_period(gain_p * error);
        self.var = [(1.0 - gain_x) * x, (p - gain_p * c).max(0.0), (1.0 - gain_x) * c];
    }

    /// The stamp of the sample that is `back` before the newest of the last read; `edge` is its own edge, where there is one.
    /// Stamps must be asked for in the order of the samples.
    pub fn stamp(&mut self, back: usize, after: Nanos, edge: Option<Nanos>) -> Nanos {
        let on_line = self.anchor.saturating_add((self.newest - back as f64 * self.period).round() as i64);
        let t = edge.map_or(on_line, |t| t.0).min(after.0);
        let t = self.last.map_or(t, |last| t.max(last.saturating_add(1)));
        self.last = Some(t);
        Nanos(t)
    }

    /// Sample rate by the host's clock, Hz, as estimated so far.
    pub fn rate_hz(&self) -> f64 {
        1e9 / self.period
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A sensor whose sample i is taken at `first + i * period`; instants ns.
    struct Sensor {
        period: f64,
        first: f64,
        given: usize,
    }

    impl Sensor {
        /// Samples that are ready at an instant and were not given before.
        fn ready(&mut self, t: f64) -> usize {
            let ready = ((t - self.first) / self.period).floor().max(-1.0) as i64 + 1;
            let n = ready as usize - self.given;
            self.given += n;
            n
        }

        fn newest(&self) -> f64 {
            self.first + (self.given as f64 - 1.0) * self.period
        }
    }

    /// Reads a 200 Hz sensor of some drift every 20 ms or so; answers the line, and the largest stamp error of the
    /// second half, ns.
    fn run(drift_ppm: f64, seconds: f64, edges: bool, seed: u64) -> (Timeline, f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut sensor = Sensor { period: 5e6 / (1.0 + drift_ppm * 1e-6), first: 7.7e6, given: 0 };
        let mut line = Timeline::new(Span(5_000_000));
        let (mut t, mut worst) = (1e6, 0f64);
        while t < seconds * 1e9 {
            t += 20e6 + rng.random_range(0.0..3e6);
            let (before, latch) = (t, t + rng.random_range(0.0..1e5));
            t += 1e5;
            let n = sensor.ready(latch);
            let latency = rng.random_range(0.0..40e3);
            let edge = edges.then(|| Nanos((sensor.newest() + latency) as i64));
            assert!(line.advance(n, Nanos(before as i64), Nanos(t as i64), edge));
            for back in (0..n).rev() {
                let stamp = line.stamp(back, Nanos(t as i64), None).0 as f64;
                if t > seconds * 0.5e9 {
                    worst = worst.max((stamp - sensor.newest() + back as f64 * sensor.period).abs());
                }
            }
        }
        (line, worst)
    }

    /// Deviation of the estimated rate from the nominal one, 1e-6.
    fn drift_ppm(line: &Timeline) -> f64 {
        (line.nominal / line.period - 1.0) * 1e6
    }

    #[test]
    fn drift_is_recovered_within_10_ppm_polled_and_1_ppm_with_edges() {
        for (seed, drift) in [-28_000.0, -900.0, -30.0, 0.0, 45.0, 2_500.0, 31_000.0].into_iter().enumerate() {
            let (polled, worst) = run(drift, 60.0, false, seed as u64);
            assert!((drift_ppm(&polled) - drift).abs() < 10.0, "{drift}: {:?}", drift_ppm(&polled));
            assert!(worst < 0.2e6, "{drift}: {worst} ns");
            let (edged, worst) = run(drift, 60.0, true, seed as u64);
            assert!((drift_ppm(&edged) - drift).abs() < 1.0, "{drift}: {:?}", drift_ppm(&edged));
            assert!(worst < 40e3, "{drift}: {worst} ns");
        }
    }

    #[test]
    fn a_clock_that_changes_is_followed() {
        let mut line = Timeline::new(Span(5_000_000));
        let mut sensor = Sensor { period: 5e6, first: 0.0, given: 0 };
        for read in 1..6000 {
            // 100 ppm in the middle of two minutes, as after a cold start.
            if read == 3000 {
                let newest = sensor.newest();
                sensor = Sensor { period: 5e6 * (1.0 - 100e-6), first: newest + 5e6, given: 0 };
            }
            let t = read as f64 * 20.3e6;
            let n = sensor.ready(t);
            assert!(line.advance(n, Nanos(t as i64), Nanos(t as i64 + 100_000), None));
        }
        assert!((drift_ppm(&line) - 100.0).abs() < 20.0, "{:?}", drift_ppm(&line));
    }

    #[test]
    fn lost_samples_move_the_line_and_do_not_break_it() {
        let mut line = Timeline::new(Span(5_000_000));
        let mut last = 0;
        for read in 0..500i64 {
            let t = read * 20_000_000 + 2_000_000;
            // Two samples are lost at read 300.
            let n = if read == 300 { 2 } else { 4 };
            assert!(line.advance(n, Nanos(t), Nanos(t + 100_000), None));
            for back in (0..n).rev() {
                last = line.stamp(back, Nanos(t + 100_000), None).0;
            }
            assert!(last > t - 5_200_000 && last <= t + 100_000, "read {read}: {last} of {t}");
        }
    }

    #[test]
    fn a_jump_of_the_clock_starts_the_line_anew() {
        let mut line = Timeline::new(Span(5_000_000));
        assert!(line.advance(4, Nanos(0), Nanos(100), None));
        assert!(!line.advance(4, Nanos(3_600_000_000_000), Nanos(3_600_000_000_100), None));
        let t = line.stamp(0, Nanos(3_600_000_000_100), None);
        assert!((Nanos(3_600_000_000_100) - t).0 < 5_000_101);
        assert!(!line.advance(4, Nanos(-5), Nanos(-5), None), "backwards too");
        assert!(line.stamp(0, Nanos(-5), None) > t, "stamps never go back");
    }

    #[derive(Clone, Debug)]
    enum Event {
        Read { n: usize, pause: i64, width: i64, edge: Option<i64> },
        Lose,
        Jump(i64),
    }

    fn event() -> impl Strategy<Value = Event> {
        let edge = proptest::option::of(prop_oneof![-10_000_000..10_000_000i64, any::<i64>()]);
        prop_oneof![
            8 => (0usize..300, 0..50_000_000i64, 0..5_000_000i64, edge)
                .prop_map(|(n, pause, width, edge)| Event::Read { n, pause, width, edge }),
            1 => Just(Event::Lose),
            1 => any::<i64>().prop_map(Event::Jump),
        ]
    }

    proptest! {
        #[test]
        fn stamps_grow_strictly_whatever_comes(
            events in proptest::collection::vec(event(), 1..60),
            nominal in prop_oneof![Just(5_000_000i64), any::<i64>()],
        ) {
            let mut line = Timeline::new(Span(nominal));
            let (mut now, mut last) = (0i64, None);
            for event in events {
                match event {
                    Event::Lose => line.forget_phase(),
                    Event::Jump(t) => now = t,
                    Event::Read { n, pause, width, edge } => {
                        let before = now.saturating_add(pause);
                        now = before.saturating_add(width);
                        let edge = edge.map(|e| Nanos(before.saturating_add(e)));
                        line.advance(n, Nanos(before), Nanos(now), edge);
                        for back in (0..n).rev() {
                            let t = line.stamp(back, Nanos(now), edge.filter(|_| back == 0)).0;
                            if let Some(last) = last {
                                prop_assert!(t > last || last == i64::MAX, "{t} after {last}");
                                prop_assert!(t <= now || t == last + 1, "{t} is after its read at {now}");
                            }
                            last = Some(t);
                        }
                        prop_assert!(line.rate_hz().is_finite());
                    }
                }
            }
        }
    }
}
