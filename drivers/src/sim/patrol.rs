//! A patrol through a building: its floor plan, and a flight of two rounds that visits every room in each.
//!
//! A tour is a list of visits (room, door in, door out). Between doors the rig follows the middle of the corridors; in a room it
//! follows a ring at some distance from the walls, clockwise in the first round and the other way in the second, so that what it
//! saw from one heading it sees again from the opposite one. The corners of that polyline are rounded by smoothing it along
//! its length, which also slows the rig down in them; the heading is that of the path a little ahead, smoothed more, with a slow
//! sweep to both sides.

use super::way::{look, smooth, under_way, GATHER, REST};
use crate::types::{Pose, Span};
use glam::{DVec2, DVec3};
use std::f64::consts::TAU;

/// Height of rooms, m; width and height of doorways, m.
pub const HEIGHT: f64 = 3.0;
pub const DOOR: DVec2 = DVec2::new(1.3, 2.35);
/// Half of the longest time between two rounds in which the light changes, s.
const DUSK: f64 = 8.0;
/// Spacing of the points of a route, m.
const PITCH: f64 = 0.02;
/// Widths of the three box filters that round the corners of the path, and of those that smooth the heading, m.
const ROUND_OFF: f64 = 1.0;
const TURN_OFF: f64 = 1.9;
/// How far ahead the heading is taken from, m; sweep of the heading, rad, and its length, m.
const AHEAD: f64 = 0.8;
const SWEEP: f64 = 0.25;
const SWEEP_LENGTH: f64 = 8.7;
/// Height of the flight in either round, m.
const FLIES_AT: [f64; 2] = [1.25, 1.55];
/// Distance of the rings of either round from the walls, as a share of the ring's own, a ratio.
const RING: [f64; 2] = [1.15, 0.95];
/// Left of the path when the flight ends, m.
const UNFLOWN: f64 = 0.5;

/// A room or a part of a corridor: the box between its walls.
#[derive(Clone, Copy, Debug)]
pub struct RoomBox {
    /// Name in tables.
    pub name: &'static str,
    /// Corner of least coordinates, m.
    pub low: DVec3,
    /// Corner of largest coordinates, m.
    pub high: DVec3,
    /// Whether it is a part of a corridor.
    pub corridor: bool,
}

impl RoomBox {
    /// Whether a point is in it, or in the half of a wall's thickness around it.
    pub fn contains(&self, p: DVec3) -> bool {
        p.cmpge(self.low - HALF_WALL).all() && p.cmple(self.high + HALF_WALL).all()
    }
}

/// Half of the thickness of a wall, m.
const HALF_WALL: f64 = 0.1;

/// A doorway, or the open end of a part of a corridor where its boxes touch: the two boxes, and where along their wall.
#[derive(Clone, Copy, Debug)]
pub(super) struct Door {
    /// The two boxes.
    pub rooms: [usize; 2],
    /// Coordinate of its middle along the wall, m.
    pub at: f64,
}

impl Door {
    /// Axis of the wall's normal, x or y, and the box on its lower side.
    pub fn wall(&self, rooms: &[RoomBox]) -> (usize, [usize; 2]) {
        let [a, b] = self.rooms;
        let below = |a: usize, b: usize, axis: usize| rooms[a].high[axis] <= rooms[b].low[axis] + 1e-9;
        let axis = usize::from(!(below(a, b, 0) || below(b, a, 0)));
        (axis, if below(a, b, axis) { [a, b] } else { [b, a] })
    }
}

/// A visit: room, doors in and out.
type Visit = (usize, usize, usize);

/// How much of a patrol is flown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Extent {
    /// Two rooms and the corridor between them.
    Two,
    /// Twenty-four rooms on both sides of two corridors that are joined at their ends, 40 m x 25 m.
    Whole,
}

/// Floor plan and tours of a patrol.
pub(super) struct Plan {
    /// Rooms, then parts of corridors.
    pub rooms: &'static [RoomBox],
    /// What joins them.
    pub doors: &'static [Door],
    /// Where the flight begins, m.
    start: DVec2,
    /// Middles of the corridors along y that join those along x, m.
    links: [f64; 2],
    /// Distance of the ring of a room from its walls, m.
    ring: f64,
    rounds: [&'static [Visit]; 2],
    /// Length of the flight, s.
    pub seconds: f64,
}

const fn room(name: &'static str, low: [f64; 2], high: [f64; 2]) -> RoomBox {
    let (low, high) = (DVec3::new(low[0], low[1], 0.0), DVec3::new(high[0], high[1], HEIGHT));
    RoomBox { name, low, high, corridor: false }
}

const fn corridor(name: &'static str, low: [f64; 2], high: [f64; 2]) -> RoomBox {
    RoomBox { corridor: true, ..room(name, low, high) }
}

const fn door(a: usize, b: usize, at: f64) -> Door {
    Door { rooms: [a, b], at }
}

const WHOLE: Plan = Plan {
    rooms: &[
        room("room a1", [0.0, 0.0], [6.5, 5.2]),
        room("room a2", [6.7, 0.0], [13.2, 5.2]),
        room("room a3", [13.4, 0.0], [19.9, 5.2]),
        room("room a4", [20.1, 0.0], [26.6, 5.2]),
        room("room a5", [26.8, 0.0], [33.3, 5.2]),
        room("room a6", [33.5, 0.0], [40.0, 5.2]),
        room("room b1", [2.2, 7.6], [8.0, 12.4]),
        room("room b2", [8.2, 7.6], [14.0, 12.4]),
        room("room b3", [14.2, 7.6], [19.9, 12.4]),
        room("room b4", [20.1, 7.6], [25.9, 12.4]),
        room("room b5", [26.1, 7.6], [31.9, 12.4]),
        room("room b6", [32.1, 7.6], [37.8, 12.4]),
        room("room c1", [2.2, 12.6], [8.0, 17.4]),
        room("room c2", [8.2, 12.6], [14.0, 17.4]),
        room("room c3", [14.2, 12.6], [19.9, 17.4]),
        room("room c4", [20.1, 12.6], [25.9, 17.4]),
        room("room c5", [26.1, 12.6], [31.9, 17.4]),
        room("room c6", [32.1, 12.6], [37.8, 17.4]),
        room("room d1", [0.0, 19.8], [6.5, 25.0]),
        room("room d2", [6.7, 19.8], [13.2, 25.0]),
        room("room d3", [13.4, 19.8], [19.9, 25.0]),
        room("room d4", [20.1, 19.8], [26.6, 25.0]),
        room("room d5", [26.8, 19.8], [33.3, 25.0]),
        room("room d6", [33.5, 19.8], [40.0, 25.0]),
        corridor("corridor 1", [0.0, 5.4], [20.0, 7.4]),
        corridor("corridor 2", [20.0, 5.4], [40.0, 7.4]),
        corridor("corridor 3", [38.0, 7.4], [40.0, 17.6]),
        corridor("corridor 4", [20.0, 17.6], [40.0, 19.6]),
        corridor("corridor 5", [0.0, 17.6], [20.0, 19.6]),
        corridor("corridor 6", [0.0, 7.4], [2.0, 17.6]),
    ],
    doors: &[
        door(0, 24, 3.6),
        door(1, 24, 9.6),
        door(2, 24, 17.0),
        door(3, 25, 23.0),
        door(4, 25, 30.4),
        door(5, 25, 36.4),
        door(6, 24, 4.5),
        door(7, 24, 11.7),
        door(8, 24, 16.5),
        door(9, 25, 23.6),
        door(10, 25, 28.4),
        door(11, 25, 35.5),
        door(12, 28, 5.7),
        door(13, 28, 10.5),
        door(14, 28, 17.6),
        door(15, 27, 22.4),
        door(16, 27, 29.6),
        door(17, 27, 34.4),
        door(18, 28, 2.9),
        door(19, 28, 10.3),
        door(20, 28, 16.3),
        door(21, 27, 23.7),
        door(22, 27, 29.7),
        door(23, 27, 37.1),
        door(0, 1, 2.4),
        door(2, 3, 2.4),
        door(4, 5, 2.4),
        door(18, 19, 22.6),
        door(20, 21, 22.6),
        door(22, 23, 22.6),
        door(24, 25, 6.4),
        door(25, 26, 39.0),
        door(26, 27, 39.0),
        door(27, 28, 18.6),
        door(28, 29, 1.0),
        door(29, 24, 1.0),
    ],
    start: DVec2::new(1.0, 6.4),
    links: [1.0, 39.0],
    ring: 1.6,
    rounds: [
        &[
            (0, 0, 0),
            (6, 6, 6),
            (1, 1, 1),
            (7, 7, 7),
            (2, 2, 2),
            (8, 8, 8),
            (3, 3, 3),
            (9, 9, 9),
            (4, 4, 4),
            (10, 10, 10),
            (5, 5, 5),
            (11, 11, 11),
            (23, 23, 23),
            (17, 17, 17),
            (22, 22, 22),
            (16, 16, 16),
            (21, 21, 21),
            (15, 15, 15),
            (20, 20, 20),
            (14, 14, 14),
            (19, 19, 19),
            (13, 13, 13),
            (18, 18, 18),
            (12, 12, 12),
        ],
        &[
            (0, 0, 24),
            (1, 24, 1),
            (6, 6, 6),
            (7, 7, 7),
            (2, 2, 25),
            (3, 25, 3),
            (8, 8, 8),
            (9, 9, 9),
            (4, 4, 26),
            (5, 26, 5),
            (10, 10, 10),
            (11, 11, 11),
            (23, 23, 29),
            (22, 29, 22),
            (17, 17, 17),
            (16, 16, 16),
            (21, 21, 28),
            (20, 28, 20),
            (15, 15, 15),
            (14, 14, 14),
            (19, 19, 27),
            (18, 27, 18),
            (13, 13, 13),
            (12, 12, 12),
        ],
    ],
    seconds: 600.0,
};

const TWO: Plan = Plan {
    rooms: &[
        room("room a", [0.0, 0.0], [6.0, 5.0]),
        room("room b", [6.4, 7.6], [12.4, 12.6]),
        corridor("corridor", [0.0, 5.2], [12.4, 7.4]),
    ],
    doors: &[door(0, 2, 3.0), door(1, 2, 9.4)],
    start: DVec2::new(1.0, 6.3),
    links: [0.0; 2],
    ring: 1.6,
    rounds: [&[(0, 0, 0), (1, 1, 1)], &[(0, 0, 0), (1, 1, 1)]],
    seconds: 85.0,
};

impl Extent {
    pub(super) fn plan(self) -> &'static Plan {
        match self {
            Extent::Two => &TWO,
            Extent::Whole => &WHOLE,
        }
    }
}

/// A flight as places along its length, and when it is where.
pub(super) struct Route {
    /// Every `PITCH` metres before corners were rounded: place, m, and heading, rad.
    points: Vec<(DVec3, f64)>,
    /// Metres before the rounding each second.
    speed: f64,
    /// Where the second round begins, m.
    second: f64,
}

impl Route {
    pub fn new(plan: &Plan) -> Route {
        let first = waypoints(plan, 0, plan.start);
        let last = first[first.len() - 1].truncate();
        let mut corners = first;
        let second = length(&corners);
        corners.extend(waypoints(plan, 1, last).into_iter().skip(1));
        let mut places = resampled(&corners);
        smoothed(&mut places, ROUND_OFF);
        let headings = headings(&places);
        let flown = (places.len() - 1) as f64 * PITCH - UNFLOWN;
        let speed = flown / under_way(plan.seconds - REST);
        Route { points: places.into_iter().zip(headings).collect(), speed, second }
    }

    /// The places that it passes, m.
    pub fn places(&self) -> impl Iterator<Item = DVec3> + '_ {
        self.points.iter().map(|p| p.0)
    }

    /// `world_from_cam0` so many seconds from the start.
    pub fn look(&self, t: f64) -> Pose {
        let s = self.speed * under_way(t - REST);
        let x = (s / PITCH).min((self.points.len() - 1) as f64);
        let k = (x as usize).min(self.points.len() - 2);
        let ((p0, h0), (p1, h1)) = (self.points[k], self.points[k + 1]);
        let (p, heading) = (p0.lerp(p1, x - k as f64), h0 + (x - k as f64) * (h1 - h0));
        let wave = |length: f64, phase: f64| (TAU * s / length + phase).sin();
        let (bob, pitch) = (0.1 * wave(11.3, 0.0), -0.05 + 0.07 * wave(7.1, 1.0));
        look(p + DVec3::Z * bob, heading + SWEEP * wave(SWEEP_LENGTH, 0.0), pitch, 0.035 * wave(5.9, 2.0))
    }

    /// When the second round begins, from the start.
    pub fn second_round(&self) -> Span {
        Span::from_secs(REST + 0.5 * GATHER + self.second / self.speed)
    }

    /// Share of the light of the second round, so long after the start, a ratio.
    pub fn late(&self, t: Span) -> f64 {
        smooth((t.secs() - self.second_round().secs()) / (2.0 * DUSK) + 0.5)
    }
}

/// The corners of a round that begins at `from`.
fn waypoints(plan: &Plan, round: usize, from: DVec2) -> Vec<DVec3> {
    let mut way = vec![from];
    // The last place in a corridor.
    let mut last = from;
    for &(room, enter, leave) in plan.rounds[round] {
        let inset = plan.ring * RING[round];
        let [entry, exit] = [enter, leave].map(|d| inside(plan, &plan.doors[d], room, inset));
        if let Some(place) = outside(plan, &plan.doors[enter]) {
            if (place.y - last.y).abs() > 1e-6 {
                let [near, far] = plan.links;
                let x = if (last.x - near).abs() < (last.x - far).abs() { near } else { far };
                way.extend([DVec2::new(x, last.y), DVec2::new(x, place.y)]);
            }
            way.push(place);
        }
        way.push(entry);
        ring(&plan.rooms[room], inset, [entry, exit], round == 1, &mut way);
        if let Some(place) = outside(plan, &plan.doors[leave]) {
            last = place;
            way.push(place);
        }
    }
    way.into_iter().map(|p| p.extend(FLIES_AT[round])).collect()
}

/// The point of a room's ring in front of one of its doors.
fn inside(plan: &Plan, door: &Door, room: usize, inset: f64) -> DVec2 {
    let (axis, [below, _]) = door.wall(plan.rooms);
    let r = &plan.rooms[room];
    let mut p = DVec2::splat(door.at);
    p[axis] = if below == room { r.high[axis] - inset } else { r.low[axis] + inset };
    p
}

/// The point in the middle of the corridor in front of a door; `None` of a door between rooms.
fn outside(plan: &Plan, door: &Door) -> Option<DVec2> {
    let (axis, _) = door.wall(plan.rooms);
    let c = door.rooms.into_iter().map(|r| &plan.rooms[r]).find(|r| r.corridor)?;
    let mut p = DVec2::splat(door.at);
    p[axis] = 0.5 * (c.low[axis] + c.high[axis]);
    Some(p)
}

/// Adds the corners of a room's ring from one of its points to another, or once round, and the last point.
fn ring(room: &RoomBox, inset: f64, [from, to]: [DVec2; 2], left_about: bool, way: &mut Vec<DVec2>) {
    let (low, high) = (room.low.truncate() + inset, room.high.truncate() - inset);
    let e = high - low;
    let corners = [low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)];
    let at = [0.0, e.x, e.x + e.y, 2.0 * e.x + e.y];
    let around = 2.0 * (e.x + e.y);
    // Place along the ring, left about from the lower left corner.
    let place = |p: DVec2| match p {
        p if p.y - low.y < 1e-9 => p.x - low.x,
        p if high.x - p.x < 1e-9 => at[1] + p.y - low.y,
        p if high.y - p.y < 1e-9 => at[2] + high.x - p.x,
        p => at[3] + high.y - p.y,
    };
    let ahead = |x: f64| if left_about { x - place(from) } else { place(from) - x }.rem_euclid(around);
    let reach = if from == to { around } else { ahead(place(to)) };
    let mut passed: Vec<(f64, DVec2)> = (0..4).map(|k| (ahead(at[k]), corners[k])).filter(|c| c.0 < reach).collect();
    passed.sort_by(|a, b| a.0.total_cmp(&b.0));
    way.extend(passed.into_iter().map(|c| c.1));
    way.push(to);
}

fn length(corners: &[DVec3]) -> f64 {
    corners.windows(2).map(|w| w[0].distance(w[1])).sum()
}

/// Points every `PITCH` metres of a polyline.
fn resampled(corners: &[DVec3]) -> Vec<DVec3> {
    let (mut points, mut left) = (vec![], 0.0);
    for w in corners.windows(2) {
        let reach = w[0].distance(w[1]);
        let mut s = left;
        while s < reach {
            points.push(w[0].lerp(w[1], s / reach));
            s += PITCH;
        }
        left = s - reach;
    }
    points
}

/// Smooths a sequence of points by three box filters of `width` metres; its ends count as going on.
fn smoothed(points: &mut [DVec3], width: f64) {
    let half = (0.5 * width / PITCH).round() as usize;
    let n = points.len();
    for _ in 0..3 {
        let old = points.to_vec();
        let at = |k: isize| old[k.clamp(0, n as isize - 1) as usize];
        let first = -(half as isize);
        let mut sum: DVec3 = (first..=half as isize).map(at).sum();
        for (k, point) in points.iter_mut().enumerate() {
            *point = sum / (2 * half + 1) as f64;
            sum += at((k + half + 1) as isize) - at(k as isize - half as isize);
        }
    }
}

/// Heading at each point, rad, without jumps.
fn headings(places: &[DVec3]) -> Vec<f64> {
    let ahead = (AHEAD / PITCH) as usize;
    let mut last = 0.0;
    let mut headings: Vec<DVec3> = (0..places.len())
        .map(|k| {
            let way = (places[(k + ahead).min(places.len() - 1)] - places[k.min(places.len() - 1 - ahead)]).truncate();
            last += DVec2::from_angle(last).angle_to(way);
            DVec3::X * last
        })
        .collect();
    smoothed(&mut headings, TURN_OFF);
    headings.into_iter().map(|h| h.x).collect()
}
