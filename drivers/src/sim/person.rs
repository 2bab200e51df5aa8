//! A person: a textured box of 0.6 x 0.4 x 1.8 m that moves where a rig flies. It crosses the view, then follows the rig in
//! front of its first camera, then comes so close that it fills half of the view, and leaves.
//!
//! Input is the path of the camera, output the room with the box where it is at an instant. It stands on the floor, turned
//! towards the camera, walks through furniture and casts no shadow. It holds still while an image is exposed, also under a
//! rolling shutter. All else of the room, its light and the exposure are those of the flight without it.

use super::room::Room;
use super::texture::{PLAID, PRINT};
use super::way::smooth;
use crate::types::Pose;
use glam::{DVec2, DVec3, Vec2, Vec3};

/// Half of its depth, width and height, m.
const HALF: Vec3 = Vec3::new(0.2, 0.3, 0.9);
/// Crossing: instant in front of where the camera then looks, s; time on either side of it, s; distance, m; speed to the
/// right, m/s.
const CROSSES_AT: f64 = 3.4;
const CROSSES_FOR: f64 = 1.4;
const CROSSES_AHEAD: f64 = 1.4;
const CROSSES_SPEED: f64 = 1.0;
/// Following: instant, s, and place ahead and to the left of the camera, m. 0.88 m ahead it is 400 px of EuRoC's 752 wide.
const FOLLOWS: [(f64, DVec2); 8] = [
    (4.8, DVec2::new(2.2, -2.6)),
    (5.6, DVec2::new(2.0, -0.2)),
    (6.4, DVec2::new(1.9, 0.1)),
    (7.2, DVec2::new(1.8, 0.2)),
    (7.8, DVec2::new(0.88, 0.25)),
    (8.7, DVec2::new(0.88, 0.2)),
    (9.5, DVec2::new(0.88, -0.2)),
    (10.3, DVec2::new(2.0, -2.6)),
];
/// Where it waits: no ray of the room comes here.
const AWAY: Vec3 = Vec3::new(0.0, 0.0, -1e3);

/// The box in a room.
pub struct Person {
    solid: usize,
}

impl Person {
    /// Adds the box to a room that is lit already.
    pub fn new(room: &mut Room, seed: u32) -> Person {
        room.add_block(AWAY, HALF, (1.0, 0.0), PRINT, PLAID, seed);
        // Front and sides differ in brightness as under lamps.
        [0.8, 0.7, 0.6, 0.75, 0.9, 0.4].into_iter().for_each(|light| room.light_map.add_even(light));
        Person { solid: room.solids.len() - 1 }
    }

    /// Moves the box to where it is `t` seconds after the start.
    pub fn step(&self, room: &mut Room, t: f64, world_from_cam: impl Fn(f64) -> Pose) {
        let at = |t: f64, DVec2 { x: ahead, y: left }: DVec2| {
            let cam = world_from_cam(t);
            let forward = (cam.q * DVec3::Z).truncate().normalize_or(DVec2::X);
            cam.p.truncate() + forward * ahead + forward.perp() * left
        };
        let place = if (t - CROSSES_AT).abs() < CROSSES_FOR {
            Some(at(CROSSES_AT, DVec2::new(CROSSES_AHEAD, CROSSES_SPEED * (CROSSES_AT - t))))
        } else {
            let leg = FOLLOWS.windows(2).find(|leg| (leg[0].0..leg[1].0).contains(&t));
            leg.map(|leg| at(t, leg[0].1.lerp(leg[1].1, smooth((t - leg[0].0) / (leg[1].0 - leg[0].0)))))
        };
        let Some(place) = place.map(|p| p.as_vec2()) else { return room.move_block(self.solid, AWAY, (1.0, 0.0)) };
        let to = (place - world_from_cam(t).p.truncate().as_vec2()).normalize_or(Vec2::X);
        room.move_block(self.solid, place.extend(room.low.z), (to.x, to.y));
    }
}
