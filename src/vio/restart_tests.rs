//! Restarts on the synthetic world: before anything was trusted, and with a unit whose scale is estimated.

use super::world::{Path, World, FRAME_SECS, RATE_HZ};
use super::*;

const PATH: Path = Path { rest: -1.0 };

/// A flight in motion whose accelerometer reads `1 / accel_scale` of what it should.
struct Pilot {
    world: World,
    vio: Vio,
    accel_scale: f64,
    frame: usize,
    sample: usize,
}

impl Pilot {
    fn new(config: &VioConfig, accel_scale: f64) -> Pilot {
        let world = World::new(PATH);
        let vio = Vio::new(&world.rig, config);
        Pilot { world, vio, accel_scale, frame: 0, sample: 0 }
    }

    /// The next frame, seen or black.
    fn next(&mut self, is_seen: bool) -> Update {
        let t = self.frame as f64 * FRAME_SECS + 0.0012;
        while (self.sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            let mut s = self.world.imu(self.sample as f64 / RATE_HZ);
            s.accel_body /= self.accel_scale;
            self.vio.on_imu(s);
            self.sample += 1;
        }
        let mut tracks = Tracks::default();
        self.world.tracks(t, &mut tracks);
        if !is_seen {
            tracks.cameras.iter_mut().for_each(|c| c.clear());
        }
        self.frame += 1;
        self.vio.on_tracks(&tracks)
    }

    /// Loses all frames and samples of so many frames.
    fn lose(&mut self, frames: usize) {
        self.frame += frames;
        self.sample += (frames as f64 * FRAME_SECS * RATE_HZ).round() as usize;
    }

    /// The first state of the next start, and its covariance.
    fn start(&mut self) -> (Odometry, Covariance) {
        let state = |u: Update| u.odometry.zip(u.covariance);
        (0..40).find_map(|_| state(self.next(true))).expect("it starts within two seconds")
    }
}

/// By how much the motion from one state to another is off, m.
fn error_m(from: &Odometry, to: &Odometry) -> f64 {
    let truth = |o: &Odometry| PATH.pose(o.t.0 as f64 * 1e-9);
    let world_from_truth = from.world_from_body * truth(from).inverse();
    (to.world_from_body.p - (world_from_truth * truth(to)).p).length()
}

fn sigma_p(c: &Covariance) -> f64 {
    c[0][0].max(c[1][1]).max(c[2][2]).sqrt()
}

#[test]
fn restart_before_anything_was_trusted_is_as_uncertain_as_the_way_since() {
    let mut pilot = Pilot::new(&VioConfig::default(), 1.0);
    let (first, _) = pilot.start();
    (0..5).for_each(|_| _ = pilot.next(true));
    assert!(!pilot.vio.monitor.is_trusted());
    pilot.vio.reset();
    let (again, covariance) = pilot.start();
    let (error, sigma) = (error_m(&first, &again), sigma_p(&covariance));
    eprintln!("{error:.2} m after {:.2} s, stated {sigma:.2} m", (again.t - first.t).secs());
    assert!(error > 0.1 && error < 3.0 * sigma && sigma < 1.5);
}

/// The last sample before the hole, held for a hundred seconds, led some kilometres away.
#[test]
fn restart_after_a_hole_of_the_samples_is_where_it_was_and_as_uncertain_as_the_way_since() {
    let mut pilot = Pilot::new(&VioConfig::default(), 1.0);
    let known = (0..60).filter_map(|_| pilot.next(true).odometry).last().expect("it flies");
    pilot.lose(2000);
    let update = pilot.next(true);
    assert!(update.health.has(Health::FRAME_GAP_RESET) && update.dead_reckoned.is_none(), "{update:?}");
    let (again, covariance) = pilot.start();
    let (error, sigma) = (error_m(&known, &again), sigma_p(&covariance));
    eprintln!("{error:.2} m off, stated {sigma:.2} m");
    assert!(again.world_from_body.p.distance(known.world_from_body.p) < 0.2);
    assert!(error < 3.0 * sigma && sigma > 10.0);
}

/// The frame comes before the samples do, and before the start: nothing is known but where it was.
#[test]
fn nothing_is_dead_reckoned_across_a_gap_of_the_samples() {
    let mut pilot = Pilot::new(&VioConfig::default(), 1.0);
    (0..60).for_each(|_| _ = pilot.next(true));
    pilot.vio.reset();
    let before = pilot.next(false);
    assert!(before.dead_reckoned.is_some());
    let mut tracks = Tracks::default();
    pilot.world.tracks(before.dead_reckoned.map_or(0.0, |o| o.t.0 as f64 * 1e-9) + 60.0, &mut tracks);
    assert!(pilot.vio.clone().on_tracks(&tracks).dead_reckoned.is_none());
    pilot.lose(1200);
    let after = pilot.next(false);
    assert!(after.dead_reckoned.is_none() && after.epoch == before.epoch + 1, "{after:?}");
}

#[test]
fn restart_after_a_lie_is_suspect_until_it_is_trusted_whatever_resets_it_meanwhile() {
    let mut pilot = Pilot::new(&VioConfig::default(), 1.0);
    (0..60).for_each(|_| _ = pilot.next(true));
    pilot.vio.reset_for(Reset::Disagreement);
    pilot.start();
    pilot.vio.reset_for(Reset::FrameGap);
    pilot.start();
    assert!(pilot.next(true).quality <= QUALITY_SUSPECT);
    let last = (0..40).map(|_| pilot.next(true)).last().expect("frames");
    assert!(last.quality > QUALITY_SUSPECT, "{last:?}");
}

#[test]
fn dead_reckoning_uses_the_estimated_scale() {
    const SCALE: f64 = 1.02;
    let config = VioConfig { estimate_imu_scale: true, ..VioConfig::default() };
    let mut pilot = Pilot::new(&config, SCALE);
    let known = (0..600).filter_map(|_| pilot.next(true).odometry).last().expect("it flies");
    let [_, accel] = pilot.vio.known().imu_scale;
    assert!((accel - (SCALE - 1.0)).abs().max_element() < 0.006, "{accel}");
    pilot.vio.reset();
    let mut last = None;
    for _ in 0..30 {
        let update = pilot.next(false);
        let (o, c) = update.dead_reckoned.zip(update.covariance).expect("it was trusted");
        last = Some((error_m(&known, &o), sigma_p(&c)));
    }
    let (error, sigma) = last.expect("frames without a start");
    eprintln!("dead reckoned {error:.3} m off, stated {sigma:.3} m");
    assert!(error < 3.0 * sigma);
}
