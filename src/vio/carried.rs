//! Frames that are left to inertia: where the view hardly moves and odometry is sure, the next image says little that the last
//! did not. Their poses are the last estimate carried by the inertial samples since.
//!
//! The choice is the front end's, from what it knew of the frame before the last, so it is the same on one thread and on two.

use super::health::{self, Health};
use super::inertial::body_velocity_sigma;
use super::recovery::DeadReckoning;
use super::{Odometry, Update, Vio};
use stipple_drivers::Nanos;

/// A frame may be left out when the next is expected within this after the last tracked one, s: at 20 Hz one of two.
const APART_S: f64 = 0.11;
/// Quality from which odometry is sure.
const SURE: u8 = 60;

impl Update {
    /// Whether inertia may carry the frames after this one: nothing is wrong, and the estimate is good.
    pub fn is_sure(&self) -> bool {
        self.odometry.is_some() && self.quality >= SURE && self.health.0 & !Health::ZERO_VELOCITY.0 == 0
    }
}

/// Stamps that the choice depends on.
#[derive(Clone, Copy, Debug, Default)]
pub struct Schedule {
    /// The newest frame, and the newest that was tracked.
    newest: Option<Nanos>,
    tracked: Option<Nanos>,
}

impl Schedule {
    /// Whether the frame at `t` may be left out: the next one then comes soon enough after the last that was tracked.
    pub fn has_time(&mut self, t: Nanos) -> bool {
        let newest = self.newest.replace(t);
        let (Some(newest), Some(tracked)) = (newest, self.tracked) else { return false };
        let next = t + (t - newest);
        t > newest && (next - tracked).secs() <= APART_S
    }

    /// The frame at `t` is tracked.
    pub fn track(&mut self, t: Nanos) {
        self.tracked = Some(t);
    }
}

impl Vio {
    /// Whether a frame is newer than all before it.
    pub(super) fn admits(&mut self, t: Nanos) -> bool {
        let newer = self.stamp.is_none_or(|stamp| t > stamp);
        self.stamp = if newer { Some(t) } else { self.stamp };
        newer
    }

    /// What a frame leads to that is refused.
    pub(super) fn rejected(&mut self) -> Update {
        self.stats.frames_rejected += 1;
        self.tally.add(Health::FRAME_REJECTED, None);
        Update { epoch: self.epoch, health: Health::FRAME_REJECTED, ..Update::default() }
    }

    /// Carries the estimate to a frame at `t` that was not tracked. `last` is what the newest frame led to that was not refused:
    /// its landmarks remain; its health, with what the samples since suffered; and its quality, less what the velocity has
    /// become uncertain by. A frame that is not newer than the last is refused and counted.
    pub fn carry(&mut self, t: Nanos, last: &Update) -> Update {
        if !self.admits(t) {
            return self.rejected();
        }
        self.stats.frames_carried += 1;
        // A reset was told with its frame.
        let health = Health(last.health.0 & !Health::RESETS.0) | self.pending;
        let mut update = Update { epoch: self.epoch, health, keyframe: false, odometry: None, carried: false, ..*last };
        if let Some(newest) = self.estimator.newest() {
            let mut state = DeadReckoning::new(newest.t, &newest.now, &self.covariance.unwrap_or_default());
            state.advance(t, &self.imu, &self.estimator.model.noise);
            (update.odometry, update.carried) = (Some(Odometry::new(t, &state.motion)), true);
            update.covariance = self.covariance.and_then(|_| state.covariance());
            let sigma_v = update.covariance.map(|c| body_velocity_sigma(&c, &state.motion));
            update.quality = update.quality.min(health::quality(sigma_v, 1, 1.0));
        }
        self.dead_reckon(t, &mut update);
        self.tally.add(update.health, update.odometry.map(|_| update.quality));
        update
    }
}

#[cfg(test)]
mod tests {
    use super::super::inertial::Motion;
    use super::super::world::{Path, World, FRAME_SECS, RATE_HZ};
    use super::*;
    use crate::config::VioConfig;
    use crate::frontend::Tracks;
    use glam::DVec3;

    #[test]
    fn tracked_frames_are_a_tenth_of_a_second_apart() {
        let tracked = |rate_hz: f64| {
            let mut schedule = Schedule::default();
            let is_tracked = |t: &Nanos| {
                let left_out = schedule.has_time(*t);
                if !left_out {
                    schedule.track(*t);
                }
                !left_out
            };
            (0..120).map(|i| Nanos((f64::from(i) / rate_hz * 1e9) as i64)).filter(is_tracked).count()
        };
        assert_eq!([10.0, 20.0, 30.0, 60.0].map(tracked), [120, 60, 40, 20]);
    }

    /// Flies for 4 s, from 2 s on with every second frame left out; answers how far the error of each such frame's position is from
    /// that of the frame before, and by how much its deviation differs, m.
    fn carried() -> Vec<[f64; 2]> {
        let path = Path { rest: -1.0 };
        let mut world = World::new(path);
        let mut vio = Vio::new(&world.rig, &VioConfig::default());
        let (mut tracks, mut sample, mut last) = (Tracks::default(), 0, Update::default());
        let mut before: Option<(DVec3, f64)> = None;
        let mut found = vec![];
        for frame in 0..80 {
            let t = f64::from(frame) * FRAME_SECS + 0.0012;
            while f64::from(sample) / RATE_HZ < t + 1.0 / RATE_HZ {
                vio.on_imu(world.imu(f64::from(sample) / RATE_HZ));
                sample += 1;
            }
            world.tracks(t, &mut tracks);
            let left_out = frame > 40 && frame % 2 == 1;
            last = if left_out { vio.carry(tracks.t, &last) } else { vio.on_tracks(&tracks) };
            let (Some(o), Some(c)) = (&last.odometry, &last.covariance) else { continue };
            assert_eq!((o.t, last.carried), (tracks.t, left_out));
            let off = o.world_from_body.p - path.pose(t).p;
            let sigma = (c[0][0] + c[1][1] + c[2][2]).sqrt();
            if let (true, Some((off_before, sigma_before))) = (left_out, before) {
                found.push([(off - off_before).length(), sigma - sigma_before]);
            }
            before = Some((off, sigma));
        }
        assert_eq!(vio.stats().frames_carried, 20);
        found
    }

    /// At 1 m/s frames are 5 cm apart.
    #[test]
    fn inertia_carries_a_frame_within_two_millimetres() {
        let found = carried();
        assert_eq!(found.len(), 20);
        assert!(found.iter().all(|[off, sigma]| *off < 2e-3 && sigma.abs() < 2e-3), "{found:?}");
    }

    #[test]
    fn complaint_or_low_quality_is_not_sure() {
        let odometry = Some(Odometry::new(Nanos(0), &Motion::default()));
        let sure = Update { odometry, quality: SURE, ..Update::default() };
        let with = |health| Update { health, ..sure }.is_sure();
        assert_eq!([Health::default(), Health::ZERO_VELOCITY].map(with), [true; 2]);
        assert_eq!([Health::IMU_GAP, Health::IMU_GAP | Health::ZERO_VELOCITY].map(with), [false; 2]);
        assert!(!Update { quality: SURE - 1, ..sure }.is_sure() && !Update { odometry: None, ..sure }.is_sure());
    }
}
