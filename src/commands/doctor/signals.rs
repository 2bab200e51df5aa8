//! What samples and images say by themselves: rates, light, noise, gravity, ranges.

use crate::commands::checks::Check;
use glam::DVec3;
use stipple_drivers::{Calibration, Frames, ImuSample, Nanos};

/// At rest: the gyro's deviation is below this, rad/s. A hand trembles with 0.05.
const REST: f64 = 0.03;
const REST_S: f64 = 1.0;
const GRAVITY: f64 = 9.81;

/// Rate and jitter of stamps: ok while both are within what a working sensor does.
///
/// `missing` is what the sensor's own thread counts: who looks may be behind and lose some more.
pub fn rate(name: &str, stamps: &[Nanos], missing: u64, expected_hz: Option<f64>) -> Check {
    let intervals: Vec<f64> = stamps.windows(2).map(|w| (w[1] - w[0]).secs()).collect();
    if intervals.len() < 10 {
        return Check::fail(format!("{name}: only {} arrived", stamps.len()), "check the cable and the log above");
    }
    let period = median(&intervals);
    let off: Vec<f64> = intervals.iter().map(|i| (i - period).abs()).collect();
    let (hz, jitter) = (1.0 / period, 1.4826 * median(&off));
    let what = format!("{name}: {hz:.1} Hz, jitter {:.3} ms, {missing} missing of {}", 1e3 * jitter, intervals.len());
    let away = expected_hz.map_or(0.0, |e| (hz / e - 1.0).abs());
    if away > 0.1 {
        let expected = expected_hz.unwrap_or(hz);
        return Check::fail(what, format!("{expected:.1} Hz is asked for: state the true rate, or set the sensor's"));
    }
    // A tenth of the interval moves a drone of 2 m/s by centimetres between frames.
    if jitter > 0.1 * period {
        return Check::warn(what, "stamps wander: take the driver's or the interrupt's, not the time of reading");
    }
    if missing > intervals.len() as u64 / 100 {
        return Check::warn(what, "more than one in a hundred is missing: check bandwidth, cable and CPU load");
    }
    Check::ok(what)
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// Brightness of one camera over all frames.
#[derive(Clone, Debug)]
pub struct Brightness {
    levels: [u64; 256],
}

impl Brightness {
    pub fn new() -> Brightness {
        Brightness { levels: [0; 256] }
    }

    pub fn add(&mut self, frames: &Frames, camera: usize) {
        // One pixel in eleven.
        frames.images[camera].pixels.iter().step_by(11).for_each(|px| self.levels[usize::from(*px)] += 1);
    }

    pub fn check(&self, camera: usize) -> Check {
        let all = self.levels.iter().sum::<u64>().max(1) as f64;
        let part = |range: std::ops::Range<usize>| self.levels[range].iter().sum::<u64>() as f64 / all;
        let mean = self.levels.iter().enumerate().map(|(v, n)| v as f64 * *n as f64).sum::<f64>() / all;
        let (dark, bright) = (part(0..8), part(250..256));
        let what = format!(
            "camera {camera}: mean level {mean:.0}, {:.1} % black, {:.1} % saturated",
            100.0 * dark,
            100.0 * bright
        );
        match () {
            _ if dark > 0.9 => Check::fail(what, "sees nothing: lens cap, light, camera.exposure_us"),
            _ if bright > 0.9 => Check::fail(what, "sees only white: shorten camera.exposure_us"),
            _ if bright > 0.15 => Check::warn(what, "shorten camera.exposure_us or lower the gain"),
            _ if dark > 0.5 || mean < 25.0 => Check::warn(what, "lengthen camera.exposure_us or add light"),
            _ => Check::ok(what),
        }
    }
}

/// The quietest second.
struct Rest {
    gyro: DVec3,
    accel: DVec3,
    gyro_sigma: f64,
    accel_sigma: f64,
}

fn rest(imu: &[ImuSample]) -> Option<Rest> {
    let mut best: Option<Rest> = None;
    let mut from = 0;
    for to in 0..imu.len() {
        while (imu[to].t - imu[from].t).secs() > REST_S {
            from += 1;
        }
        // Every twentieth window is enough.
        if to % 20 != 0 || (imu[to].t - imu[from].t).secs() < 0.95 * REST_S {
            continue;
        }
        let window = &imu[from..=to];
        let scale = 1.0 / window.len() as f64;
        let mean = |f: fn(&ImuSample) -> DVec3| window.iter().map(f).fold(DVec3::ZERO, |a, b| a + b) * scale;
        let (gyro, accel) = (mean(|s| s.gyro_body), mean(|s| s.accel_body));
        // Of one axis.
        let sigma = |f: fn(&ImuSample) -> DVec3, m: DVec3| {
            (window.iter().map(|s| (f(s) - m).length_squared()).sum::<f64>() * scale / 3.0).sqrt()
        };
        let (gyro_sigma, accel_sigma) = (sigma(|s| s.gyro_body, gyro), sigma(|s| s.accel_body, accel));
        if best.as_ref().is_none_or(|b| gyro_sigma < b.gyro_sigma) {
            best = Some(Rest { gyro, accel, gyro_sigma, accel_sigma });
        }
    }
    best.filter(|b| b.gyro_sigma < REST)
}

/// Noise, bias and gravity at rest, against the calibration.
pub fn inertia(imu: &[ImuSample], calibration: &Calibration) -> Vec<Check> {
    let Some(rest) = rest(imu) else {
        return vec![Check::warn(
            "inertial unit: never at rest for a second",
            "hold the rig still, then run this again",
        )];
    };
    let c = &calibration.imu;
    let root_rate = c.rate_hz.sqrt();
    let noise = |name: &str, unit: &str, sigma: f64, stated: f64| {
        let what = format!("{name} noise at rest: {sigma:.2e} {unit} a sample, calibrated {stated:.2e}");
        match sigma / stated {
            r if r < 5.0 && r > 0.2 => Check::ok(what),
            r if r <= 0.2 => Check::warn(what, "far below the calibration: is a filter on, or the unit stuck?"),
            _ => Check::warn(what, "far above the calibration: vibration, or state the true noise"),
        }
    };
    let mut checks = vec![
        noise("gyro", "rad/s", rest.gyro_sigma, c.gyro_noise * root_rate),
        noise("accelerometer", "m/s²", rest.accel_sigma, c.accel_noise * root_rate),
    ];
    let bias = rest.gyro.length();
    let what = format!("gyro at rest: {:.4} rad/s", bias);
    checks.push(match bias {
        b if b < 0.1 => Check::ok(what),
        b if b < 0.5 => Check::warn(what, "a large bias: let the unit warm up, or calibrate it"),
        _ => Check::fail(what, "no unit at rest reads this: check its scale and axes"),
    });
    let gravity = rest.accel.length();
    let what =
        format!("gravity: {gravity:.3} m/s² along ({:.2}, {:.2}, {:.2})", rest.accel.x, rest.accel.y, rest.accel.z);
    checks.push(match (gravity - GRAVITY).abs() {
        d if d < 0.3 => Check::ok(what),
        d if d < 1.0 => Check::warn(what, "calibrate the accelerometer's biases and scale"),
        _ => Check::fail(what, "not gravity: check the accelerometer's range, scale and unit (m/s², not g)"),
    });
    checks
}

/// Samples at the ends of the ranges.
pub fn saturation(imu: &[ImuSample]) -> Check {
    let n = imu.iter().filter(|s| s.saturated != [false; 2]).count();
    let peak = |f: fn(&ImuSample) -> DVec3| imu.iter().map(|s| f(s).abs().max_element()).fold(0.0, f64::max);
    let (w, a) = (peak(|s| s.gyro_body), peak(|s| s.accel_body));
    let what = format!("saturation: {n} of {} samples; peaks {w:.1} rad/s, {a:.1} m/s²", imu.len());
    match n {
        0 => Check::ok(what),
        _ => Check::warn(what, "widen imu.gyro_range_dps or imu.accel_range_g, or damp the mount"),
    }
}
