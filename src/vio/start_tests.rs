//! Starts in motion with one camera on the synthetic world.

use super::world::{room, stream, Path, World, FRAME_SECS};
use super::*;
use nalgebra::{SMatrix, SVector};

/// Where a motion is at a time, s.
type PoseAt = fn(f64) -> Pose;

/// A motion in the world, its tracks and samples, and how it is seen.
struct Flight {
    world: World,
    pose: fn(f64) -> Pose,
    t: f64,
    config: VioConfig,
}

/// The first state of a start: seconds it took, its motion and covariance, and the true pose and velocity.
struct First {
    secs: f64,
    motion: Motion,
    covariance: Covariance,
    truth: Motion,
}

impl Flight {
    fn new(pose: fn(f64) -> Pose, seed: u64) -> Flight {
        let mut noise = stream(seed, 1);
        let points = room(1500, &mut noise);
        let mut world = World::seen_from(pose, points, noise);
        // Biases as the estimator expects them.
        let (mut config, mut of) = (VioConfig::default(), stream(seed, 2));
        world.gyro_bias = of.vector() * 0.03;
        world.accel_bias = of.vector() * config.accel_bias_sigma;
        (config.observation_sigma_px, config.gyro_noise_scale, config.accel_noise_scale) = (0.3, 1.0, 1.0);
        Flight { world, pose, t: 0.0, config }
    }

    /// Flies from `t` to the first state, for at most three seconds; `spoil` may change what the camera sees.
    fn start(mut self, spoil: impl Fn(&mut Tracks)) -> Option<First> {
        let mut rig = self.world.rig.clone();
        rig.cameras.truncate(1);
        let mut vio = Vio::new(&rig, &self.config);
        let mut tracks = Tracks::default();
        let mut sample = (self.t * rig.imu.rate_hz) as usize;
        for frame in 0..60 {
            let t = self.t + f64::from(frame) * FRAME_SECS + 0.0012;
            while (sample as f64) / rig.imu.rate_hz < t + 1.0 / rig.imu.rate_hz {
                vio.on_imu(self.world.imu(sample as f64 / rig.imu.rate_hz));
                sample += 1;
            }
            let (gyro, accel) = (self.world.gyro_bias, self.world.accel_bias);
            self.world.tracks(t, &mut tracks);
            tracks.cameras[1].clear();
            spoil(&mut tracks);
            let Some(o) = vio.on_tracks(&tracks).odometry else { continue };
            const H: f64 = 1e-5;
            let v = ((self.pose)(t + H).p - (self.pose)(t - H).p) / (2.0 * H);
            let truth = Motion { pose: (self.pose)(t), v, bg: gyro, ba: accel };
            let (motion, covariance) = (Motion::from(&o), *vio.covariance()?);
            return Some(First { secs: t - self.t, motion, covariance, truth });
        }
        None
    }
}

impl First {
    /// Errors of velocity and of up, both in the body, which do not depend on where the world's axes are, and of the biases; and
    /// their derivatives to the errors of the motion.
    fn error(&self) -> (SVector<f64, 12>, SMatrix<f64, 12, 15>) {
        let seen = |m: &Motion| [m.pose.q.conjugate() * m.v, m.pose.q.conjugate() * DVec3::Z, m.bg, m.ba];
        let all = |m: &Motion| SVector::<f64, 12>::from_iterator(seen(m).into_iter().flat_map(|x| x.to_array()));
        const H: f64 = 1e-6;
        let mut j = SMatrix::<f64, 12, 15>::zeros();
        for i in 0..15 {
            let mut d = [0.0; 15];
            d[i] = H;
            j.set_column(i, &((all(&self.motion.plus(&d)) - all(&self.motion)) / H));
        }
        (all(&self.motion) - all(&self.truth), j)
    }

    /// Squared error of velocity, tilt and biases in deviations: eleven dimensions, up having but two.
    fn nees(&self) -> f64 {
        let (e, j) = self.error();
        let p = SMatrix::<f64, 15, 15>::from_fn(|a, b| self.covariance[a][b]);
        let eigen = (j * p * j.transpose()).symmetric_eigen();
        // Up has unit length: its own direction is no error.
        let least = eigen.eigenvalues.imin();
        (0..12)
            .filter(|i| *i != least)
            .map(|i| eigen.eigenvectors.column(i).dot(&e).powi(2) / eigen.eigenvalues[i])
            .sum()
    }

    fn speed_error(&self) -> f64 {
        let (e, _) = self.error();
        e.fixed_rows::<3>(0).norm()
    }

    fn tilt_error(&self) -> f64 {
        let (e, _) = self.error();
        e.fixed_rows::<3>(3).norm()
    }

    fn sigma_v(&self) -> f64 {
        body_velocity_sigma(&self.covariance, &self.motion)
    }
}

fn room_path(t: f64) -> Pose {
    Path { rest: -1.0 }.pose(t)
}

#[test]
fn covariance_of_a_start_in_motion_is_its_error() {
    let (mut sum, mut worst) = (0.0, 0.0f64);
    let n = 50;
    for seed in 0..n {
        let first = Flight { t: 0.83 * seed as f64, ..Flight::new(room_path, seed) }.start(|_| {}).expect("it starts");
        let (nees, v) = (first.nees(), first.truth.v.length());
        eprintln!(
            "{seed}: after {:.2} s, speed {v:.3}, off by {:.4} of {:.4} m/s, tilt by {:.4}, NEES {nees:.1}",
            first.secs,
            first.speed_error(),
            first.sigma_v(),
            first.tilt_error()
        );
        sum += nees;
        worst = worst.max(first.speed_error() / v);
    }
    let mean = sum / n as f64;
    eprintln!("mean NEES {mean:.1} of 11, speed off by {worst:.3} of itself at worst");
    // Wrong views that pass as right ones, and a scale that is not quite linear, make it more than eleven.
    assert!(mean < 20.0 && worst < 0.25);
}

/// Motions that do not tell how far things are: the start says so, and is not put off for long.
#[test]
fn motion_that_does_not_tell_its_speed_claims_none() {
    let straight = |t: f64| Pose::new(glam::DQuat::IDENTITY, DVec3::new(1.2 * t - 2.0, 0.3 * t, 0.0));
    let turning = |t: f64| Pose::new(glam::DQuat::from_rotation_z(0.5 * t), DVec3::ZERO);
    let hovering =
        |t: f64| Pose::new(glam::DQuat::from_rotation_x(0.03 * (4.0 * t).sin()), DVec3::Z * 0.06 * (5.0 * t).sin());
    let flights: [(&str, PoseAt); 3] = [("straight", straight), ("turning", turning), ("hovering", hovering)];
    for (name, pose) in flights {
        for seed in 0..10 {
            let first = Flight::new(pose, 100 + seed).start(|_| {}).expect("it starts");
            let (off, sigma) = (first.speed_error(), first.sigma_v());
            eprintln!("{name}: after {:.2} s, off by {off:.4} of {sigma:.4} m/s", first.secs);
            assert!(off < 4.0 * sigma && first.secs < 1.7);
        }
    }
}

/// A fifth of the tracks follow something that moves by itself.
#[test]
fn start_in_motion_bears_a_fifth_of_wrong_tracks() {
    let mut good = 0;
    for seed in 0..10 {
        let since = std::cell::Cell::new(0.0f32);
        let first = Flight { t: 0.83 * seed as f64, ..Flight::new(room_path, seed) }.start(|tracks| {
            since.set(since.get() + 3.0);
            tracks.cameras[0].iter_mut().filter(|t| t.id % 5 == 0).for_each(|t| t.px[0] += since.get());
        });
        let first = first.expect("it starts");
        let (off, sigma, v) = (first.speed_error(), first.sigma_v(), first.truth.v.length());
        eprintln!("{seed}: after {:.2} s, speed {v:.3}, off by {off:.4} of {sigma:.4} m/s", first.secs);
        good += usize::from(off < 0.1 * v);
    }
    assert!(good >= 8, "{good} of 10");
}
