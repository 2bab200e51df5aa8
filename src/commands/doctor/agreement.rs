//! The gyro against camera 0: the offset of their clocks, the gyro's bias and the camera's attitude in the body, with
//! deviations.
//!
//! A camera's turn C from one frame to the next is the gyro's, integrated over the same interval in its own clock:
//! `C = E⁻¹ G(t₀ + d, t₁ + d; b) E`. Robust least squares over (d, b, E) at once, since each passes for another. (In turns, from
//! where the rates' magnitudes correlate, a third to a half of what a bias shifts that by is left: magnitudes of a gyro
//! 0.02 rad/s off correlate best 3 to 11 ms beside the truth on simulated flights.)
//!
//! Start: that offset, then the orthogonal matrix that takes one rate to the other (Wahba; Markley 1988), of either
//! handedness. The nearest of the 48 ways to name three axes and their signs is taken out of the gyro first, and named.
//!
//! Deviations are of the residuals as they are, neighbours being alike (Newey and West 1987), not of a noise that somebody
//! stated. Where nothing tells, a wide prior keeps them finite, and who reads them refuses.

use crate::math::so3::{exp, exp_matrix, log, right_jacobian, right_jacobian_inverse};
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Cholesky, Matrix3, SMatrix, SVector};
use stipple_drivers::{ImuSample, Nanos};

/// Offset, bias, attitude (right).
const DIM: usize = 7;
type Normal = SMatrix<f64, DIM, DIM>;
type Column = SVector<f64, DIM>;
type Rows = SMatrix<f64, 3, DIM>;

/// Offsets looked at for a start, and their step, s.
const OFFSET_MAX: f64 = 0.15;
const OFFSET_STEP: f64 = 0.001;
/// Samples further apart are not integrated across, s.
const GAP_MAX: f64 = 0.05;
/// Intervals from which deviations can be told.
const INTERVALS_MIN: usize = 12;
const ITERATIONS: usize = 30;
/// Tukey's width, in deviations of a residual's three parts.
const TUKEY: f64 = 6.0;
/// Median of the length of three normal deviates.
const CHI_MEDIAN: f64 = 1.538;
/// Of what is not seen, this much is known all the same: s, rad/s, rad.
const PRIOR: [f64; DIM] = [0.1, 0.5, 0.5, 0.5, 1.0, 1.0, 1.0];
/// The left hand must explain turns this much better than the right one to be believed, and the other way round: as a ratio
/// of deviations, which of 40 intervals vary by 6 %.
const HANDEDNESS: f64 = 1.3;
/// Axes are named wrongly where that leaves less than this of the attitude, rad: a mount is not 20 degrees off.
const NAMED: f64 = 0.35;

/// How camera 0 turned from one frame to the next, and the covariance of a small turn on the right, rad².
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    pub from: Nanos,
    pub to: Nanos,
    pub before_from_now: DQuat,
    pub covariance: DMat3,
}

impl Turn {
    fn rate(&self) -> DVec3 {
        log(self.before_from_now) / (self.to - self.from).secs()
    }
}

/// What the gyro and the camera say of each other.
#[derive(Clone, Copy, Debug)]
pub struct Agreement {
    pub intervals: usize,
    /// Of the gyro's clock over the camera's, beyond what the calibration says, s.
    pub offset_s: f64,
    pub offset_sigma_s: f64,
    /// rad/s, body.
    pub bias: DVec3,
    pub bias_sigma: DVec3,
    /// From where the calibration has camera 0 to where it is, rotation vector about its axes, rad.
    pub turned: DVec3,
    pub turned_covariance: DMat3,
    /// Signed names of the axes: `axes * reading` is in the body.
    pub axes: DMat3,
    /// Whether the turns can tell a left-handed gyro from a right-handed one.
    pub handed: bool,
    /// Mean product of the camera's rate with itself, its own axes, (rad/s)².
    pub excitation: DMat3,
    /// Of camera and gyro, 0 to 1.
    pub correlation: f64,
    /// What stays unexplained, rad/s.
    pub residual: f64,
}

/// The gyro's rate, linear between samples; s after the first.
struct Gyro {
    origin: Nanos,
    t: Vec<f64>,
    rate: Vec<DVec3>,
}

/// What the gyro turns over an interval.
struct Integral {
    q: DQuat,
    d_bias: DMat3,
    d_offset: DVec3,
}

impl Gyro {
    fn new(imu: &[ImuSample], axes: &DMat3) -> Option<Gyro> {
        let origin = imu.first()?.t;
        let t = imu.iter().map(|s| (s.t - origin).secs()).collect();
        Some(Gyro { origin, t, rate: imu.iter().map(|s| *axes * s.gyro_body).collect() })
    }

    /// Instants and rates from `t0` to `t1`, both included; `None` where samples do not cover it.
    fn path(&self, t0: f64, t1: f64) -> Option<impl Iterator<Item = (f64, DVec3)> + '_> {
        let (first, last) = (self.t.partition_point(|t| *t <= t0), self.t.partition_point(|t| *t < t1));
        if first == 0 || last == self.t.len() || (first..=last).any(|i| self.t[i] - self.t[i - 1] > GAP_MAX) {
            return None;
        }
        let at = |t: f64, next: usize| {
            let s = (t - self.t[next - 1]) / (self.t[next] - self.t[next - 1]);
            (t, self.rate[next - 1].lerp(self.rate[next], s))
        };
        let between = (first..last).map(|i| (self.t[i], self.rate[i]));
        Some(std::iter::once(at(t0, first)).chain(between).chain(std::iter::once(at(t1, last))))
    }

    /// Over `turn`'s interval, `offset` later.
    fn integrate(&self, turn: &Turn, offset: f64, bias: DVec3) -> Option<Integral> {
        let [t0, t1] = [turn.from, turn.to].map(|t| (t - self.origin).secs() + offset);
        let mut path = self.path(t0, t1)?;
        let start = path.next()?;
        let (mut q, mut d_bias, mut before) = (DQuat::IDENTITY, DMat3::ZERO, start);
        for now in path {
            let dt = now.0 - before.0;
            let step = (0.5 * (before.1 + now.1) - bias) * dt;
            q *= exp(step);
            d_bias = exp_matrix(-step) * d_bias - right_jacobian(step) * dt;
            before = now;
        }
        let d_offset = (before.1 - bias) - q.conjugate() * (start.1 - bias);
        Some(Integral { q, d_bias, d_offset })
    }

    fn mean_rate(&self, turn: &Turn, offset: f64) -> Option<DVec3> {
        let dt = (turn.to - turn.from).secs();
        Some(log(self.integrate(turn, offset, DVec3::ZERO)?.q) / dt)
    }
}

#[derive(Clone, Copy, Debug)]
struct State {
    offset: f64,
    bias: DVec3,
    body_from_cam: DQuat,
}

impl State {
    fn moved(&self, step: &SVector<f64, DIM>) -> State {
        State {
            offset: self.offset + step[0],
            bias: self.bias + DVec3::new(step[1], step[2], step[3]),
            body_from_cam: self.body_from_cam * exp(DVec3::new(step[4], step[5], step[6])),
        }
    }
}

/// The predicted turn after the measured one, and its derivatives.
fn residual(turn: &Turn, gyro: &Gyro, x: &State) -> Option<(DVec3, Rows)> {
    let g = gyro.integrate(turn, x.offset, x.bias)?;
    let cam_from_body = x.body_from_cam.conjugate();
    let predicted = cam_from_body * g.q * x.body_from_cam;
    let r = log(turn.before_from_now.conjugate() * predicted);
    let j = right_jacobian_inverse(r);
    let e = j * DMat3::from_quat(cam_from_body);
    let (d_offset, d_bias) = (e * g.d_offset, e * g.d_bias);
    let d_attitude = j * (DMat3::IDENTITY - DMat3::from_quat(predicted.conjugate()));
    Some((
        r,
        Rows::from_fn(|i, k| match k {
            0 => d_offset[i],
            1..=3 => d_bias.col(k - 1)[i],
            _ => d_attitude.col(k - 4)[i],
        }),
    ))
}

struct Fit {
    state: State,
    covariance: Normal,
    /// Deviation of the residuals in those of their cameras.
    scale: f64,
    intervals: usize,
}

/// Of one interval, in deviations of its camera.
struct Line {
    r: SVector<f64, 3>,
    j: Rows,
    weight: f64,
}

fn lines(turns: &[Turn], gyro: &Gyro, x: &State) -> Vec<Line> {
    let line = |turn: &Turn| {
        let (r, j) = residual(turn, gyro, x)?;
        let l = Cholesky::new(Matrix3::from(turn.covariance.to_cols_array_2d()))?.l();
        let r = l.solve_lower_triangular(&SVector::from(r.to_array()))?;
        Some(Line { r, j: l.solve_lower_triangular(&j)?, weight: 1.0 })
    };
    turns.iter().filter_map(line).collect()
}

/// Weights lines by how far out they are; answers the deviation they have.
fn weigh(lines: &mut [Line]) -> f64 {
    let lengths: Vec<f64> = lines.iter().map(|l| l.r.norm()).collect();
    let scale = (median(&lengths) / CHI_MEDIAN).max(1e-12);
    for (line, d) in lines.iter_mut().zip(&lengths) {
        let u = (d / (TUKEY * scale)).min(1.0);
        line.weight = (1.0 - u * u).powi(2);
    }
    scale
}

/// Of the estimate, by the scores of lines in the order of time; the larger of what they say with their neighbours and alone.
fn covariance(lines: &[Line], inverse: &Normal, prior: &Normal, scale: f64) -> Normal {
    let n = lines.len();
    let scores: Vec<Column> = lines.iter().map(|l| l.j.transpose() * l.r * l.weight).collect();
    let lags = (n as f64).cbrt() as usize;
    let mut spread = prior * scale * scale;
    for (i, s) in scores.iter().enumerate() {
        spread += s * s.transpose();
        for lag in 1..=lags.min(i) {
            let c = s * scores[i - lag].transpose();
            spread += (c + c.transpose()) * (1.0 - lag as f64 / (lags + 1) as f64);
        }
    }
    let few = n as f64 / (n as f64 - DIM as f64 / 3.0);
    let squares: f64 = lines.iter().map(|l| l.weight * l.r.norm_squared()).sum();
    let alone = inverse * (squares / (3.0 * n as f64) * few);
    let together = inverse * spread * inverse * few;
    let wider = |i: usize| f64::max(1.0, alone[(i, i)] / together[(i, i)].max(1e-300)).sqrt();
    Normal::from_fn(|i, k| together[(i, k)] * wider(i) * wider(k))
}

fn fit(turns: &[Turn], gyro: &Gyro, start: State) -> Option<Fit> {
    let mut x = start;
    let mut found = None;
    for _ in 0..ITERATIONS {
        let mut all = lines(turns, gyro, &x);
        if all.len() < INTERVALS_MIN {
            return None;
        }
        let scale = weigh(&mut all);
        let known = Column::from(PRIOR).map(|s| (scale / s).powi(2));
        let prior = Normal::from_diagonal(&known);
        let away = Column::from([x.offset - start.offset, x.bias.x, x.bias.y, x.bias.z, 0.0, 0.0, 0.0]);
        let (mut a, mut g) = (prior, known.component_mul(&away));
        for line in &all {
            a += line.j.transpose() * line.j * line.weight;
            g += line.j.transpose() * line.r * line.weight;
        }
        let inverse = Cholesky::new(a)?.inverse();
        x = x.moved(&-(inverse * g));
        let covariance = covariance(&all, &inverse, &prior, scale);
        found = Some(Fit { state: x, covariance, scale, intervals: all.len() });
    }
    found.filter(|f| f.state.body_from_cam.is_finite() && f.state.offset.abs() < 2.0 * OFFSET_MAX)
}

/// The 48 ways to name three axes with their signs.
fn namings() -> impl Iterator<Item = DMat3> {
    const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    ORDERS.into_iter().flat_map(|order| {
        (0..8).map(move |signs| {
            let column = |k: usize| DVec3::AXES[order[k]] * if signs >> k & 1 == 1 { -1.0 } else { 1.0 };
            DMat3::from_cols(column(0), column(1), column(2))
        })
    })
}

/// How the axes are named, if `body_from_reading` is that and a small turn, and how large the turn is.
fn naming(body_from_reading: &DMat3) -> DMat3 {
    let hand = body_from_reading.determinant();
    let left = |p: &DMat3| log(DQuat::from_mat3(&(*body_from_reading * p.transpose()))).length();
    let same = namings().filter(|p| p.determinant() * hand > 0.0);
    let Some(nearest) = same.min_by(|a, b| left(a).total_cmp(&left(b))) else { return DMat3::IDENTITY };
    if hand > 0.0 && left(&nearest) > NAMED {
        DMat3::IDENTITY
    } else {
        nearest
    }
}

/// `None` of too little to say anything.
pub fn agreement(turns: &[Turn], imu: &[ImuSample], calibrated: DQuat) -> Option<Agreement> {
    let raw = Gyro::new(imu, &DMat3::IDENTITY)?;
    let pairs_at = |offset: f64| -> Vec<(DVec3, DVec3)> {
        turns.iter().filter_map(|t| Some((t.rate(), raw.mean_rate(t, offset)?))).collect()
    };
    let offset = best_offset(|o| {
        let lengths =
            pairs_at(o).iter().map(|p| (DVec3::X * p.0.length(), DVec3::X * p.1.length())).collect::<Vec<_>>();
        correlation(&lengths)
    })?;
    let pairs = pairs_at(offset);
    let fits = [1.0, -1.0].map(|hand| {
        let cam_from_reading = orthogonal(&pairs, hand)?;
        let axes = naming(&(DMat3::from_quat(calibrated) * cam_from_reading));
        let body_from_cam = DQuat::from_mat3(&(axes * cam_from_reading.transpose())).normalize();
        let gyro = Gyro::new(imu, &axes)?;
        let fit = fit(turns, &gyro, State { offset, bias: DVec3::ZERO, body_from_cam })?;
        Some((fit, axes, gyro))
    });
    let ratio = match &fits {
        [Some(right), Some(left)] => left.0.scale / right.0.scale,
        _ => 1.0,
    };
    let [right, left] = fits;
    let (fit, axes, gyro) = if ratio < 1.0 / HANDEDNESS { left? } else { right? };
    let (x, c) = (fit.state, &fit.covariance);
    let sigma = |i: usize| c[(i, i)].sqrt();
    let agree: Vec<(DVec3, DVec3)> = turns
        .iter()
        .filter_map(|t| Some((t.rate(), x.body_from_cam.conjugate() * gyro.mean_rate(t, x.offset)?)))
        .collect();
    let misses: Vec<f64> =
        agree.iter().map(|p| (p.0 - (p.1 - x.body_from_cam.conjugate() * x.bias)).length()).collect();
    let product = |w: DVec3| DMat3::from_cols(w * w.x, w * w.y, w * w.z);
    let excitation = agree.iter().fold(DMat3::ZERO, |sum, p| sum + product(p.0)) * (1.0 / agree.len() as f64);
    Some(Agreement {
        intervals: fit.intervals,
        offset_s: x.offset,
        offset_sigma_s: sigma(0),
        bias: x.bias,
        bias_sigma: DVec3::new(sigma(1), sigma(2), sigma(3)),
        turned: log(calibrated.conjugate() * x.body_from_cam),
        turned_covariance: DMat3::from_cols_array(&std::array::from_fn(|i| c[(4 + i % 3, 4 + i / 3)])),
        axes,
        handed: !(1.0 / HANDEDNESS..HANDEDNESS).contains(&ratio),
        excitation,
        correlation: correlation(&agree),
        residual: median(&misses),
    })
}

fn means(pairs: &[(DVec3, DVec3)]) -> (DVec3, DVec3) {
    let sum = pairs.iter().fold((DVec3::ZERO, DVec3::ZERO), |s, p| (s.0 + p.0, s.1 + p.1));
    (sum.0 / pairs.len() as f64, sum.1 / pairs.len() as f64)
}

/// The matrix of determinant `hand` that takes second to first best, means aside.
fn orthogonal(pairs: &[(DVec3, DVec3)], hand: f64) -> Option<DMat3> {
    let (cam, body) = means(pairs);
    let mut h = Matrix3::<f64>::zeros();
    for (c, b) in pairs {
        let (c, b) = (*c - cam, *b - body);
        h += nalgebra::Vector3::from(c.to_array()) * nalgebra::RowVector3::from(b.to_array());
    }
    let svd = h.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    // The least singular value is the last.
    let sign = Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, hand * (u * v_t).determinant().signum()));
    Some(DMat3::from_cols_array_2d(&(u * sign * v_t).into()))
}

/// Of vectors, means aside.
fn correlation(pairs: &[(DVec3, DVec3)]) -> f64 {
    let (a, b) = means(pairs);
    let (aa, bb, ab) = pairs.iter().fold((1e-12, 1e-12, 0.0), |s, p| {
        let (x, y) = (p.0 - a, p.1 - b);
        (s.0 + x.length_squared(), s.1 + y.length_squared(), s.2 + x.dot(y))
    });
    ab / f64::sqrt(aa * bb)
}

fn best_offset(score: impl Fn(f64) -> f64) -> Option<f64> {
    let steps = (OFFSET_MAX / OFFSET_STEP) as i32;
    let offsets = (-steps..=steps).map(|k| f64::from(k) * OFFSET_STEP);
    let scored = offsets.map(|o| (o, score(o)));
    scored.filter(|(_, s)| s.is_finite()).max_by(|a, b| a.1.total_cmp(&b.1)).map(|(o, _)| o)
}

pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::world::stream;

    const BIAS: DVec3 = DVec3::new(0.02, -0.01, 0.03);
    const SECONDS: f64 = 7.0;

    fn calibrated() -> DQuat {
        DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0)
    }

    fn tumbling(t: f64) -> DVec3 {
        DVec3::new((2.1 * t).sin(), 0.7 * (3.3 * t + 1.0).sin(), 0.9 * (1.7 * t).cos() * (0.6 * t).sin())
    }

    /// A rig whose body turns at `rate`, and what its sensors make of it.
    struct Rig {
        rate: fn(f64) -> DVec3,
        body_from_cam: DQuat,
        /// Of the gyro's clock over the camera's, s.
        offset: f64,
        /// `axes * reading` is in the body.
        axes: DMat3,
        /// Of a camera's attitude, rad, shared by the two intervals that meet there; and of one interval's turn.
        shared: f64,
        alone: f64,
        /// One interval in so many follows something else.
        wrong: usize,
        seed: u64,
    }

    impl Rig {
        fn new() -> Rig {
            let (rate, body_from_cam, axes) = (tumbling as fn(f64) -> DVec3, calibrated(), DMat3::IDENTITY);
            Rig { rate, body_from_cam, offset: 0.0, axes, shared: 1e-4, alone: 1e-4, wrong: usize::MAX, seed: 1 }
        }

        fn sense(&self) -> (Vec<Turn>, Vec<ImuSample>) {
            let mut noise = stream(self.seed, 0x6472);
            let mut normal = || noise.vector();
            let stamp = |t: f64| Nanos(7_000_000_000 + (t * 1e9).round() as i64);
            let sample = |i: usize| {
                let t = i as f64 * 0.005;
                let read = self.axes.transpose() * ((self.rate)(t - self.offset) + BIAS);
                ImuSample { t: stamp(t), gyro_body: read, accel_body: DVec3::ZERO, ..ImuSample::default() }
            };
            let mut imu: Vec<ImuSample> = (0..(SECONDS / 0.005) as usize).map(sample).collect();
            imu.iter_mut().for_each(|s| s.gyro_body += normal() * 2.4e-3);
            let mut before = normal() * self.shared;
            let turn = |i: usize| {
                let from = 0.2 + 0.05 * i as f64;
                let step = |k: usize| exp((self.rate)(from + (k as f64 + 0.5) * 5e-4) * 5e-4);
                let g = (0..100).fold(DQuat::IDENTITY, |q, k| q * step(k));
                let now = normal() * self.shared;
                let error = now - before + normal() * self.alone;
                before = now;
                let gross = if i % self.wrong == self.wrong / 2 { DVec3::new(0.02, -0.01, 0.015) } else { DVec3::ZERO };
                let true_turn = self.body_from_cam.conjugate() * g * self.body_from_cam;
                Turn {
                    from: stamp(from),
                    to: stamp(from + 0.05),
                    before_from_now: true_turn * exp(error + gross),
                    covariance: DMat3::IDENTITY * 1e-8,
                }
            };
            ((0..(20.0 * (SECONDS - 0.4)) as usize).map(turn).collect(), imu)
        }

        fn found(&self) -> Option<Agreement> {
            let (turns, imu) = self.sense();
            agreement(&turns, &imu, calibrated())
        }
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let (turns, imu) = Rig::new().sense();
        let gyro = Gyro::new(&imu, &DMat3::IDENTITY).unwrap();
        let x =
            State { offset: 0.0013, bias: BIAS * 0.5, body_from_cam: calibrated() * exp(DVec3::new(0.1, -0.2, 0.3)) };
        for turn in turns.iter().step_by(17) {
            let (_, j) = residual(turn, &gyro, &x).unwrap();
            for k in 0..DIM {
                let mut h = Column::zeros();
                h[k] = 2e-5;
                let at = |h: Column| residual(turn, &gyro, &x.moved(&h)).unwrap().0;
                let numeric = (at(h) - at(-h)) / 4e-5;
                let analytic = DVec3::new(j[(0, k)], j[(1, k)], j[(2, k)]);
                // The rate is linear between samples; over the step its turn with the axis is left out.
                assert!((numeric - analytic).length() < 2e-4 * (1.0 + analytic.length()), "{k}: {numeric} {analytic}");
            }
        }
    }

    #[test]
    fn offsets_are_found_whatever_the_bias_and_extrinsics() {
        let turned = DVec3::new(0.02, 0.05, -0.04);
        for offset in [-0.02, -0.003, 0.0, 0.007] {
            let rig = Rig { offset, body_from_cam: calibrated() * exp(turned), ..Rig::new() };
            let a = rig.found().unwrap();
            assert!((a.offset_s - offset).abs() < 4.0 * a.offset_sigma_s && a.offset_sigma_s < 3e-4, "{offset}: {a:?}");
            assert!((a.turned - turned).length() < 2e-3 && (a.bias - BIAS).length() < 1e-3, "{offset}: {a:?}");
            assert!(a.axes == DMat3::IDENTITY && a.handed && a.correlation > 0.99, "{a:?}");
        }
    }

    #[test]
    fn what_follows_something_else_is_left_out() {
        let a = Rig { offset: 0.007, wrong: 6, ..Rig::new() }.found().unwrap();
        assert!((a.offset_s - 0.007).abs() < 5e-4 && a.turned.length() < 3e-3, "{a:?}");
    }

    #[test]
    fn axes_exchanged_and_turned_round_are_named() {
        for axes in namings() {
            let a = Rig { axes, offset: -0.004, ..Rig::new() }.found().unwrap();
            assert!(a.axes == axes && a.handed && a.turned.length() < 3e-3, "{axes}: {a:?}");
            assert!((a.offset_s + 0.004).abs() < 1e-3, "{a:?}");
        }
    }

    #[test]
    fn errors_are_as_large_as_stated() {
        for (shared, alone) in [(0.0, 2e-4), (2e-4, 1e-5)] {
            let (mut squares, n) = ([0.0; DIM], 40);
            for seed in 0..n {
                let a = Rig { shared, alone, seed, ..Rig::new() }.found().unwrap();
                squares[0] += (a.offset_s / a.offset_sigma_s).powi(2);
                for k in 0..3 {
                    squares[1 + k] += ((a.bias - BIAS)[k] / a.bias_sigma[k]).powi(2);
                    squares[4 + k] += a.turned[k].powi(2) / a.turned_covariance.col(k)[k];
                }
            }
            let over: Vec<f64> = squares.iter().map(|s| (s / n as f64).sqrt()).collect();
            // Alternating errors cancel, which neighbours alone do not tell in full: too wide, never too narrow.
            let low = if shared > 0.0 { 0.2 } else { 0.7 };
            assert!(over.iter().all(|o| (low..1.35).contains(o)), "{shared} {alone}: {over:.2?}");
        }
    }

    #[test]
    fn what_the_motion_does_not_tell_is_not_said() {
        let about_z: fn(f64) -> DVec3 = |t| DVec3::Z * (2.0 * t).sin();
        let a = Rig { rate: about_z, body_from_cam: DQuat::IDENTITY, ..Rig::new() }.found();
        assert!(a.is_none_or(|a| a.turned_covariance.z_axis.z.sqrt() > 0.1 && !a.handed), "{a:?}");
        let steady: fn(f64) -> DVec3 = |_| DVec3::new(0.5, 0.3, 0.2);
        let a = Rig { rate: steady, ..Rig::new() }.found();
        assert!(a.is_none_or(|a| a.offset_sigma_s > 5e-3), "{a:?}");
    }
}
