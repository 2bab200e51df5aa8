//! A seeded simulator: a textured room, a rig flying through it, its images and its inertial unit.
//!
//! Input is a `Scenario` (rig, path, seed); `Sim` gives images, exact depth, inertial samples and exact states at any
//! instant, and `write_euroc` writes them in the EuRoC ASL layout. Geometry is ray-cast analytically through the camera
//! models that the estimator inverts, so any error that remains downstream is the estimator's. Errors of the sensors
//! (`CameraErrors`, `ImuErrors`) are in their data and not in the calibration that is handed out. Read in this order:
//! `scenario` and `patrol` (paths), `spline` (motion), `room`, `furnish`, `building` and `person` (geometry), `texture` and `room::light` (appearance), `render`
//! (images), `imu`.

mod baro;
mod building;
mod furnish;
pub mod imu;
mod patrol;
mod person;
mod recording;
mod render;
mod room;
pub mod scenario;
pub mod spline;
mod texture;
mod way;
mod write;

pub use imu::{Bias, ImuErrors, GRAVITY};
pub use patrol::{Extent, RoomBox};
pub use render::Sensor;
pub use scenario::{euroc_rig, rig_named, CameraErrors, Flight, Light, Recording, Scenario, RIGS};
pub use write::write_euroc;

use crate::calibration::Calibration;
use crate::fault::{Fault, FaultKind};
use crate::source::AidReading;
use crate::types::{luma, Frames, ImuSample, Nanos, Pose, Span, TimedPose};
use glam::{DVec3, Vec3};
use patrol::Route;
use person::Person;
use render::{Exposure, Lens, Row, Rows, Scratch, View};
use room::Room;
use spline::Spline;

/// Stamp at which invented flights start.
const START: Nanos = Nanos(1_000_000_000);
/// Knot spacing of an invented flight and of a recorded one, s. The latter resolves vibration up to about 15 Hz.
const KNOT: f64 = 0.1;
const KNOT_RECORDED: f64 = 0.03;
/// Rounds in which a spline is fitted to a recorded flight.
const FIT_ROUNDS: usize = 6;
/// Left out at either end of a recorded flight, where the fit is loose, s.
const FIT_MARGIN: f64 = 0.15;
/// Room left around a recorded path: sideways, below, above, m.
const ROOM_SIDE: f64 = 1.7;
const ROOM_BELOW: f64 = 0.9;
const ROOM_ABOVE: f64 = 1.0;
/// Mean grey level the exposure meter steers to, how far it goes there, and its period.
const METER_LEVEL: f32 = 105.0;
const METER_STRENGTH: f32 = 0.6;
const METER_PERIOD: f64 = 0.5;

/// The truth at an instant; biases in rad/s and m/s².
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// `world_from_body`
    pub pose: Pose,
    /// Velocity in the world frame, m/s.
    pub v_world: DVec3,
    /// Bias of the gyro in the body frame, rad/s.
    pub gyro_bias: DVec3,
    /// Bias of the accelerometer in the body frame, m/s².
    pub accel_bias: DVec3,
}

/// A flight that can be rendered.
pub struct Sim {
    seed: u64,
    sensor: Sensor,
    light: Light,
    /// The calibration that is handed out, and the true one.
    calibration: Calibration,
    rig: Calibration,
    time_offset: Span,
    late: Vec<Span>,
    spline: Spline,
    /// Stamp of spline time 0.
    start: Nanos,
    stamps: Vec<Nanos>,
    imu: Vec<ImuSample>,
    aids: Vec<AidReading>,
    biases: Vec<Bias>,
    room: Room,
    /// That of a patrol, and whether the light of its rounds is exchanged.
    route: Option<Route>,
    other_light: bool,
    person: Option<Person>,
    lenses: Vec<Lens>,
    /// Logarithm of the gain every `METER_PERIOD` from the first frame.
    log_gain: Vec<f32>,
    scratch: Scratch,
    rows: Vec<Row>,
    /// Red, green and blue of the pixels of an image.
    colours: Vec<[u8; 3]>,
}

impl Sim {
    /// Makes a scenario ready; renders with as many threads as the machine has. A fault where the
    /// scenario makes no sense.
    pub fn new(scenario: &Scenario) -> Result<Sim, Fault> {
        Sim::with_threads(scenario, std::thread::available_parallelism().map_or(1, |n| n.get()))
    }

    /// Makes a scenario ready; the images do not depend on `threads`. A fault as of `new`.
    pub fn with_threads(scenario: &Scenario, threads: usize) -> Result<Sim, Fault> {
        check(scenario)?;
        let rig = scenario.rig();
        let mut calibration = rig.clone();
        for (camera, error) in calibration.cameras.iter_mut().zip(&scenario.camera_errors.extrinsics) {
            camera.body_from_cam = camera.body_from_cam * *error;
        }
        let plan = scenario.path.plan();
        let route = plan.map(Route::new);
        let (spline, start, first, last) = motion(scenario, &rig, route.as_ref())?;
        let first = (first + scenario.begin).min(last);
        let span = (first - start).secs()..(last - start).secs();
        let mut room = if let (Some(plan), Some(route)) = (plan, &route) {
            // Of the whole route, so that a shorter flight has the same furniture.
            let path: Vec<Vec3> = route.places().map(|p| p.as_vec3()).collect();
            building::build(plan, &path, scenario.seed, threads)
        } else {
            let (low, high) = bounds(scenario, &spline, span.clone());
            let path: Vec<Vec3> = sample_path(&spline, span).map(|p| p.as_vec3()).collect();
            furnish::furnish(low, high, &path, scenario.seed, threads)
        };
        let person = scenario.person.then(|| Person::new(&mut room, scenario.seed as u32));
        let recorded = match &scenario.path {
            Flight::Recorded(r) => r.imu.as_ref().map(|imu| (imu, &r.biases)),
            _ => None,
        };
        let (mut imu, biases) = match recorded {
            Some((imu, biases)) => {
                let within = imu.iter().filter(|s| s.t >= first && s.t <= last).copied().collect();
                (within, biases.clone())
            }
            None => {
                let ticks = imu::ticks(first, last, calibration.imu.rate_hz);
                let (noise, errors) = (&calibration.imu, &scenario.imu_errors);
                imu::simulate(&spline, start, &ticks, noise, errors, scenario.seed, |t| scenario.path.motors(t))
            }
        };
        imu.iter_mut().for_each(|s| *s = scenario.imu_errors.axes.undo(s));
        let aids = baro::simulate(&spline, start, &imu::ticks(first, last, baro::RATE_HZ), scenario.seed);
        let lenses: Vec<Lens> = calibration.cameras.iter().map(|c| Lens::new(&c.camera)).collect();
        let pixels = calibration.cameras.iter().map(|c| c.camera.width * c.camera.height).max().unwrap_or(0);
        let scratch = Scratch::new(&room, pixels, threads);
        let mut sim = Sim {
            seed: scenario.seed,
            sensor: scenario.sensor,
            light: scenario.light.clone(),
            calibration,
            rig,
            time_offset: scenario.camera_errors.time_offset,
            late: scenario.camera_errors.late.clone(),
            spline,
            start,
            stamps: imu::ticks(first, last, scenario.rate_hz),
            imu,
            aids,
            biases,
            room,
            route,
            other_light: scenario.other_light,
            person,
            lenses,
            log_gain: Vec::new(),
            scratch,
            rows: Vec::new(),
            colours: Vec::new(),
        };
        sim.log_gain = sim.metered();
        Ok(sim)
    }

    /// The calibration that is handed out.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// Readings of its barometer.
    pub fn aids(&self) -> &[AidReading] {
        &self.aids
    }

    /// All inertial samples of the run; they begin and end with the frames.
    pub fn imu(&self) -> &[ImuSample] {
        &self.imu
    }

    /// The number of frames.
    pub fn frame_count(&self) -> usize {
        self.stamps.len()
    }

    /// The stamp of frame `i`: mid-exposure of its middle row, by the cameras' clock.
    pub fn stamp(&self, i: usize) -> Nanos {
        self.stamps[i] - self.time_offset
    }

    /// The instant of frame `i` by the clock of inertial samples and truth.
    pub fn taken(&self, i: usize) -> Nanos {
        self.stamps[i]
    }

    /// The truth at an instant by the clock of inertial samples.
    pub fn truth_at(&self, t: Nanos) -> State {
        let m = self.spline.at((t - self.start).secs());
        let bias = imu::bias_at(&self.biases, t);
        State { pose: m.pose, v_world: m.v_world, gyro_bias: bias.gyro, accel_bias: bias.accel }
    }

    /// `world_from_body` at every inertial sample.
    pub fn truth(&self) -> Vec<TimedPose> {
        self.imu.iter().map(|s| TimedPose { t: s.t, pose: self.truth_at(s.t).pose }).collect()
    }

    /// Low and high corner of the room, m.
    pub fn room(&self) -> (DVec3, DVec3) {
        (self.room.low.as_dvec3(), self.room.high.as_dvec3())
    }

    /// Distance from a point to the nearest surface, m; not positive inside furniture or outside.
    pub fn clearance(&self, p_world: DVec3) -> f64 {
        self.room.clearance(p_world.as_vec3()) as f64
    }

    /// Renders all cameras at frame `i` into `out`, which must have the rig's shape; in colour as far as it has colours.
    pub fn render(&mut self, i: usize, out: &mut Frames) {
        let t = self.stamps[i];
        out.t = self.stamp(i);
        for camera in 0..self.lenses.len() {
            // Random streams of different images are unrelated, whatever the order of rendering.
            let run = texture::hash(self.seed as i32, (self.seed >> 32) as i32, 0x5354_5250);
            let stream = texture::hash(i as i32, camera as i32, run);
            self.expose(t, camera);
            let (rows, lens) = (Rows(&self.rows), &self.lenses[camera]);
            render::cast(&self.room, lens, rows, &mut self.scratch);
            let (view, sensor, pixels) = ((&self.room, lens, rows), self.sensor, &mut out.images[camera].pixels);
            let Some(planes) = out.colours.get_mut(camera) else {
                let exposure = Exposure { sensor, streams: [stream] };
                render::shade(view, &exposure, &mut self.scratch, pixels, |[grey]| grey);
                continue;
            };
            let exposure = Exposure { sensor, streams: [0, 1, 2].map(|c| texture::hash(c, 0, stream)) };
            self.colours.resize(pixels.len(), [0; 3]);
            render::shade(view, &exposure, &mut self.scratch, &mut self.colours, |rgb| rgb);
            for (i, rgb) in self.colours.iter().enumerate() {
                pixels[i] = luma(rgb[0], rgb[1], rgb[2]);
                planes.iter_mut().zip(rgb).for_each(|(plane, level)| plane.pixels[i] = *level);
            }
        }
    }

    /// Writes the depth (z in the camera frame, m; 0 = none) of frame `i`, row-major, `width * height` values.
    pub fn depth(&mut self, i: usize, camera: usize, out: &mut [f32]) {
        self.expose(self.stamps[i], camera);
        render::cast(&self.room, &self.lenses[camera], Rows(&self.rows), &mut self.scratch);
        render::depths(&self.lenses[camera], &self.scratch.hits, out);
    }

    /// Moves the person, and sets the views and exposures of a camera's rows, one for all under a global shutter, in the frame
    /// of `t`.
    fn expose(&mut self, t: Nanos, camera: usize) {
        let t = t + self.late.get(camera).copied().unwrap_or_default();
        if let Some(person) = &self.person {
            let (spline, first) = (&self.spline, (self.stamps[0] - self.start).secs());
            let camera = |t: f64| spline.at(first + t).pose * self.rig.cameras[0].body_from_cam;
            person.step(&mut self.room, (t - self.stamps[0]).secs(), camera);
        }
        self.light_up(t);
        let c = &self.rig.cameras[camera];
        let (rolls, n) = (c.readout.0 > 0, c.camera.height);
        let mut rows = std::mem::take(&mut self.rows);
        rows.clear();
        rows.extend((0..if rolls { n } else { 1 }).map(|y| {
            let t = if rolls { t + Span::from_secs(c.row_delay(y as f64)) } else { t };
            let (factor, offset) = self.light.at(t - self.stamps[0]);
            // Two sensors never respond quite alike.
            let gain = self.gain_at(t) * (1.0 + 0.03 * camera as f32) * factor as f32;
            Row { view: self.view(t, camera), gain, offset: offset as f32 }
        }));
        self.rows = rows;
    }

    /// Lights the room as it is at `t`.
    fn light_up(&mut self, t: Nanos) {
        let late = self.route.as_ref().map_or(0.0, |route| route.late(t - self.start) as f32);
        self.room.late = if self.other_light { 1.0 - late } else { late };
    }

    fn view(&self, t: Nanos, camera: usize) -> View {
        View::new(&self.room, &(self.truth_at(t).pose * self.rig.cameras[camera].body_from_cam))
    }

    /// The exposure that a meter on camera 0 would settle on through the run, smoothed.
    fn metered(&mut self) -> Vec<f32> {
        let n = ((self.last() - self.stamps[0]).secs() / METER_PERIOD).ceil() as usize + 1;
        let at = |k: usize| (self.stamps[0] + Span::from_secs(k as f64 * METER_PERIOD)).min(self.last());
        let mut light = Vec::with_capacity(n);
        for t in (0..n).map(at).collect::<Vec<_>>() {
            self.light_up(t);
            let Some(lens) = self.lenses.first() else { return vec![0.0] };
            light.push(render::meter(&self.room, lens, self.view(t, 0)).max(1e-3).ln());
        }
        let mean = light.iter().sum::<f32>() / n as f32;
        let smooth = |k: usize| (light[k.saturating_sub(1)] + 2.0 * light[k] + light[(k + 1).min(n - 1)]) / 4.0;
        (0..n).map(|k| METER_LEVEL.ln() - mean - METER_STRENGTH * (smooth(k) - mean)).collect()
    }

    fn gain_at(&self, t: Nanos) -> f32 {
        let x = ((t - self.stamps[0]).secs() / METER_PERIOD).max(0.0);
        let k = (x as usize).min(self.log_gain.len() - 1);
        let next = self.log_gain[(k + 1).min(self.log_gain.len() - 1)];
        (self.log_gain[k] + (x.fract() as f32) * (next - self.log_gain[k])).exp()
    }

    fn last(&self) -> Nanos {
        self.stamps[self.stamps.len() - 1]
    }
}

fn check(s: &Scenario) -> Result<(), Fault> {
    let wrong = |what: &str, fix: &str| Err(Fault::new(FaultKind::Config, format!("scenario {}", s.name), what, fix));
    if s.calibration.cameras.is_empty() {
        return wrong("the rig has no camera", "give a calibration with cameras");
    }
    let d = s.image_divisor;
    if d == 0 || s.calibration.cameras.iter().any(|c| c.camera.width / d < 16 || c.camera.height / d < 16) {
        return wrong("the image divisor leaves no image", "use 1, 2 or 4");
    }
    if !(s.rate_hz > 0.0 && s.calibration.imu.rate_hz > 0.0 && s.duration.0 > 0) {
        return wrong("rates and duration must be positive", "correct them");
    }
    Ok(())
}

/// The spline, the stamp of its time 0, and the first and last instant to simulate.
fn motion(
    scenario: &Scenario,
    rig: &Calibration,
    route: Option<&Route>,
) -> Result<(Spline, Nanos, Nanos, Nanos), Fault> {
    let Flight::Recorded(r) = &scenario.path else {
        let cam_from_body = rig.cameras[0].body_from_cam.inverse();
        let look = |t: f64| {
            let world_from_cam = route.map(|r| r.look(t)).or(scenario.path.look(t)).unwrap_or_default();
            Pose::new(world_from_cam.q * cam_from_body.q, world_from_cam.p)
        };
        let spline = Spline::sampled(scenario.duration.secs(), KNOT, look);
        return Ok((spline, START, START, START + scenario.duration));
    };
    let short = || {
        let fix = "give longer files that overlap in time";
        Fault::new(FaultKind::Data, format!("scenario {}", scenario.name), "less than half a second to simulate", fix)
    };
    let start = r.poses.first().ok_or_else(short)?.t;
    let samples: Vec<(f64, Pose)> = r.poses.iter().map(|p| ((p.t - start).secs(), p.pose)).collect();
    let end = samples[samples.len() - 1].0;
    let (mut first, mut last) = (start + Span::from_secs(FIT_MARGIN), start + Span::from_secs(end - FIT_MARGIN));
    if let Some(imu) = &r.imu {
        // Frames begin on an inertial sample, as on hardware that triggers both.
        first = imu.iter().map(|s| s.t).find(|t| *t >= first).ok_or_else(short)?;
        last = imu.last().map_or(last, |s| s.t.min(last));
    }
    last = last.min(first + scenario.duration);
    if (last - first).secs() < 0.5 {
        return Err(short());
    }
    Ok((Spline::fit(&samples, KNOT_RECORDED, FIT_ROUNDS), start, first, last))
}

fn sample_path(spline: &Spline, span: std::ops::Range<f64>) -> impl Iterator<Item = DVec3> + '_ {
    const STEP: f64 = 0.05;
    let n = ((span.end - span.start) / STEP).ceil() as usize;
    (0..=n).map(move |k| spline.at(span.start + k as f64 * STEP).pose.p)
}

/// The corners of the room: fixed for invented flights, around the path of a recorded one.
fn bounds(scenario: &Scenario, spline: &Spline, span: std::ops::Range<f64>) -> (Vec3, Vec3) {
    if !matches!(scenario.path, Flight::Recorded(_)) {
        return (Vec3::new(-4.0, -3.0, 0.0), Vec3::new(4.0, 3.0, 3.5));
    }
    let start = spline.at(span.start).pose.p;
    let (mut low, mut high) = (start, start);
    for p in sample_path(spline, span) {
        (low, high) = (low.min(p), high.max(p));
    }
    let (mut low, mut high) =
        (low - DVec3::new(ROOM_SIDE, ROOM_SIDE, ROOM_BELOW), high + DVec3::new(ROOM_SIDE, ROOM_SIDE, ROOM_ABOVE));
    let grow = (DVec3::new(6.0, 5.0, 3.0) - (high - low)).max(DVec3::ZERO);
    low -= 0.5 * grow.with_z(0.0);
    high += grow * DVec3::new(0.5, 0.5, 1.0);
    (low.as_vec3(), high.as_vec3())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::camera::Camera;
    use glam::{DQuat, DVec2};
    use std::collections::BTreeMap;

    /// A point seen by camera 0 at its stated depth projects into camera 1 where camera 1 sees the
    /// same surface at the same distance, or something nearer.
    #[test]
    fn both_cameras_see_the_same_points() {
        let mut sim = Sim::with_threads(&Scenario::named("demo").unwrap(), 2).unwrap();
        let rig = sim.calibration.clone();
        let (c0, c1) = (rig.cameras[0], rig.cameras[1]);
        let mut depth = vec![0.0; c0.camera.width * c0.camera.height];
        let cam1_from_cam0 = c1.body_from_cam.inverse() * c0.body_from_cam;
        for frame in [0, 77, 150] {
            sim.depth(frame, 0, &mut depth);
            let world_from_cam1 = sim.truth_at(sim.stamp(frame)).pose * c1.body_from_cam;
            let (mut seen, mut hidden) = (0, 0);
            for i in (0..depth.len()).step_by(37) {
                let (x, y) = (i % c0.camera.width, i / c0.camera.width);
                let b = c0.camera.unproject(DVec2::new(x as f64, y as f64)).unwrap();
                let p = cam1_from_cam0.transform(b * (depth[i] as f64 / b.z));
                let Some(px) = c1.camera.project(p).filter(|px| c1.camera.contains(*px, 0.0)) else { continue };
                let d = (world_from_cam1.q * c1.camera.unproject(px).unwrap()).as_vec3();
                let (t, _) = sim.room.nearest(world_from_cam1.p.as_vec3(), d);
                let error = t as f64 - p.length();
                // at the rim of a ball a ray that misses it by a micrometre goes on to the wall
                if error.abs() < 2e-4 {
                    seen += 1;
                } else {
                    hidden += 1;
                    assert!(error < 0.0 || hidden < 20, "{error} behind at frame {frame}, pixel {x} {y}");
                }
            }
            assert!(seen > 500 && hidden * 10 < seen, "frame {frame}: {seen} seen, {hidden} hidden");
        }
    }

    /// The tiles' lists of solids leave nothing out: a pixel sees what a test of all solids says.
    #[test]
    fn tile_lists_lose_no_solid() {
        for (name, frames) in [
            ("circle", [0, 60, 120, 180]),
            ("patrol-two", [52, 165, 385, 612]),
            ("patrol", [65, 420, 2904, 3875]),
            ("twins", [58, 412, 648, 1002]),
            ("doors", [44, 265, 486, 795]),
        ] {
            let mut sim = Sim::with_threads(&Scenario::named(name).unwrap(), 3).unwrap();
            for frame in frames {
                let view = sim.view(sim.stamp(frame), 1);
                let rows = [Row { view, gain: 1.0, offset: 0.0 }];
                render::cast(&sim.room, &sim.lenses[1], Rows(&rows), &mut sim.scratch);
                let camera = sim.calibration.cameras[1].camera;
                for i in (0..camera.width * camera.height).step_by(11) {
                    let px = DVec2::new((i % camera.width) as f64, (i / camera.width) as f64);
                    let d = view.turn * camera.unproject(px).unwrap().as_vec3();
                    let (t, face) = sim.room.nearest(view.origin, d);
                    let hit = sim.scratch.hits[i];
                    assert!(hit.face == face || (hit.distance - t).abs() < 1e-4, "{name} {frame} pixel {px}");
                }
            }
        }
    }

    /// A row of a rolling image is that row of an image taken whole at the row's own time.
    #[test]
    fn rolling_rows_see_what_is_there_at_their_time() {
        let mut scenario = Scenario::named("aggressive").unwrap();
        scenario.calibration.cameras.iter_mut().for_each(|c| c.readout = Span(30_000_000));
        let mut sim = Sim::with_threads(&scenario, 3).unwrap();
        let camera = sim.rig.cameras[1];
        for frame in [60, 110, 160] {
            let t = sim.taken(frame);
            sim.expose(t, 1);
            render::cast(&sim.room, &sim.lenses[1], Rows(&sim.rows), &mut sim.scratch);
            let rolled: Vec<_> = sim.scratch.hits.iter().map(|h| (h.face, h.distance)).collect();
            for y in [0, 100, 239, 240, 479] {
                let view = sim.view(t + Span::from_secs(camera.row_delay(y as f64)), 1);
                let whole = [Row { view, gain: 1.0, offset: 0.0 }];
                render::cast(&sim.room, &sim.lenses[1], Rows(&whole), &mut sim.scratch);
                for i in y * 752..(y + 1) * 752 {
                    let h = sim.scratch.hits[i];
                    assert_eq!(rolled[i], (h.face, h.distance), "frame {frame} row {y}");
                }
            }
        }
        assert!((camera.row_delay(0.0) + 0.015).abs() < 1e-12 && (camera.row_delay(479.0) - 0.015).abs() < 1e-12);
    }

    /// Surfaces of places that look the same are equal exactly, and so are images from corresponding poses, but for rounding
    /// and for what is seen of other places. Another seed gives other surfaces.
    #[test]
    fn places_that_look_the_same_give_the_same_images() {
        // Cells of a place and of one that looks the same: a room and its doorway; a bay, its niche and the doorway between.
        let cases: [(&str, [&[usize]; 2]); 2] = [("twins", [&[0, 6], &[1, 7]]), ("doors", [&[1, 9, 21], &[5, 13, 25]])];
        for (name, places) in cases {
            let scenario = Scenario { image_divisor: 4, ..Scenario::named(name).unwrap() };
            let [mut sim, other] =
                [1, 2].map(|seed| Sim::with_threads(&Scenario { seed, ..scenario.clone() }, 2).unwrap());
            let plan = scenario.path.plan().unwrap();
            for (k, r) in plan.rooms.iter().enumerate() {
                assert!(surfaces(&sim.room, k) == surfaces(&sim.room, plan.like(k)), "{name}: {}", r.name);
                assert!(surfaces(&sim.room, k) != surfaces(&other.room, k), "{name}: {}", r.name);
            }
            sim.sensor = Sensor { read_noise: 0.0, shot_noise: 0.0, ..sim.sensor };
            let [faces, like] = places.map(|cells| cells.iter().flat_map(|c| sim.room.faces_of(*c)));
            let twin_of: BTreeMap<usize, usize> = faces.zip(like).collect();
            let [here, there] = places.map(|cells| plan.rooms[cells[0]]);
            let poses: Vec<Pose> =
                sim.stamps.iter().map(|t| sim.truth_at(*t).pose * sim.rig.cameras[0].body_from_cam).collect();
            let (mut seen, mut off) = (0, 0);
            for pose in poses.into_iter().filter(|pose| here.contains(pose.p)).step_by(9) {
                let moved = Pose::new(pose.q, pose.p + there.low - here.low);
                let [own, twin] = [pose, moved].map(|pose| shot(&mut sim, &pose));
                for (x, y) in own.into_iter().zip(twin) {
                    let Some(face) = twin_of.get(&(x.0 as usize)) else { continue };
                    seen += 1;
                    off += usize::from(*face != y.0 as usize || x.1.abs_diff(y.1) > 1);
                }
            }
            println!("{name}: {off} of {seen} pixels differ");
            assert!(seen > 30_000 && off * 1000 < seen, "{name}: {off} of {seen}");
        }
    }

    /// Pattern and light of every surface of a cell and of its furniture, at the same points of each.
    fn surfaces(room: &Room, cell: usize) -> Vec<f32> {
        let points = |f: usize| (0..200).map(move |k| (f, glam::vec2((k % 20) as f32 + 0.3, (k / 20) as f32 + 0.6)));
        let levels = |(f, at): (usize, glam::Vec2)| {
            let face = &room.faces[f];
            let (at, footprint) = (at * face.size / 20.0, glam::Vec2::splat(0.002));
            let spot = texture::Spot { at, footprint, size: face.size };
            [texture::albedo(face.material, face.seed, spot), room.light(f, at)]
        };
        room.faces_of(cell).flat_map(points).flat_map(levels).collect()
    }

    /// Face and grey level of every pixel of camera 0 there; `NOTHING` in place of the face at its edges.
    fn shot(sim: &mut Sim, world_from_cam: &Pose) -> Vec<(u32, u8)> {
        let Camera { width, height, .. } = sim.rig.cameras[0].camera;
        let rows = [Row { view: View::new(&sim.room, world_from_cam), gain: 120.0, offset: 0.0 }];
        let exposure = Exposure { sensor: sim.sensor, streams: [0] };
        let mut pixels = vec![0; width * height];
        render::cast(&sim.room, &sim.lenses[0], Rows(&rows), &mut sim.scratch);
        let seen = (&sim.room, &sim.lenses[0], Rows(&rows));
        render::shade(seen, &exposure, &mut sim.scratch, &mut pixels, |[grey]| grey);
        let hits = &sim.scratch.hits;
        let inside = |i: usize| {
            let around = [i.wrapping_sub(1), i + 1, i.wrapping_sub(width), i + width];
            around.into_iter().all(|j| hits.get(j).is_none_or(|h| h.face == hits[i].face))
        };
        (0..pixels.len()).map(|i| (if inside(i) { hits[i].face } else { room::NOTHING }, pixels[i])).collect()
    }

    #[test]
    fn furniture_keeps_clear_of_the_path() {
        for name in Scenario::names() {
            let sim = Sim::new(&Scenario::named(name).unwrap()).unwrap();
            for s in sim.truth() {
                assert!(sim.clearance(s.pose.p) > furnish::KEEP_CLEAR as f64 - 0.05, "{name} at {:?}", s.t);
            }
        }
    }

    #[test]
    fn a_view_does_not_depend_on_the_heading_s_representation() {
        let room = Sim::new(&Scenario::named("static").unwrap()).unwrap().room;
        let q = DQuat::from_rotation_y(0.7);
        let (a, b) = (View::new(&room, &Pose::new(q, DVec3::X)), View::new(&room, &Pose::new(-q, DVec3::X)));
        assert!((a.turn * Vec3::Z - b.turn * Vec3::Z).length() < 1e-6);
    }
}
