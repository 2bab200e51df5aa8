//! A patrol through a building: its floor plan, and a flight of two rounds that visits every room in each.
//!
//! A tour is a list of visits (room, door in, door out). Between doors the rig follows the middle of the corridors; in a room it
//! follows a ring at some distance from the walls, clockwise in the first round and the other way in the second, so that what it
//! saw from one heading it sees again from the opposite one. The corners of that polyline are rounded by smoothing it along
//! its length, which also slows the rig down in them; the heading is that of the path a little ahead, smoothed more, with a slow
//! sweep to both sides.
//!
//! Two plans, `TWINS` and `DOORS`, have places that look exactly the same, so that false loop closures between them can be
//! tested. There the second round is flown like the first and in the same light.

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

/// What a patrol flies through.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Extent {
    /// Two rooms and the corridor between them.
    Two,
    /// Eight rooms and two corridors, 40 m x 25 m.
    Whole,
    /// Two rooms that look the same, 8 m apart, and a corridor whose parts do not; the rooms are visited in turn.
    Twins,
    /// A corridor of eight bays that look the same, each with a door and a niche behind it, between two rooms; forth and back.
    Doors,
}

/// Floor plan and tours of a patrol.
pub(super) struct Plan {
    /// Rooms, then parts of corridors.
    pub rooms: &'static [RoomBox],
    /// What joins them; the first of the two of a door is not the corridor, where only one is.
    pub doors: &'static [Door],
    /// The room that each looks exactly like: as large, and open on the same sides. Beyond the list, itself.
    pub like: &'static [usize],
    /// Whether the second round is flown the other way about, higher and in other light.
    pub varied: bool,
    /// Where the flight begins, m.
    start: DVec2,
    /// Where corridors of different directions meet, m.
    junction: DVec2,
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
        room("room a", [0.0, 0.0], [9.8, 10.8]),
        room("room b", [10.0, 0.0], [19.8, 10.8]),
        room("room c", [20.0, 0.0], [29.8, 10.8]),
        room("room d", [30.0, 0.0], [40.0, 10.8]),
        room("room e", [31.0, 13.6], [40.0, 25.0]),
        room("room f", [21.8, 13.6], [30.8, 25.0]),
        room("room g", [9.6, 13.6], [19.0, 25.0]),
        room("room h", [0.0, 13.6], [9.4, 25.0]),
        corridor("corridor 1", [0.0, 11.0], [10.0, 13.4]),
        corridor("corridor 2", [10.0, 11.0], [19.2, 13.4]),
        corridor("crossing", [19.2, 11.0], [21.6, 13.4]),
        corridor("corridor 3", [21.6, 11.0], [31.0, 13.4]),
        corridor("corridor 4", [31.0, 11.0], [40.0, 13.4]),
        corridor("corridor 5", [19.2, 13.4], [21.6, 25.0]),
    ],
    doors: &[
        door(0, 8, 4.5),
        door(1, 9, 14.0),
        door(2, 11, 26.0),
        door(3, 12, 35.0),
        door(4, 12, 36.5),
        door(5, 13, 20.0),
        door(6, 13, 17.5),
        door(7, 8, 5.5),
        door(0, 1, 5.0),
        door(2, 3, 6.0),
        door(6, 7, 20.0),
        door(8, 9, 12.2),
        door(9, 10, 12.2),
        door(10, 11, 12.2),
        door(11, 12, 12.2),
        door(10, 13, 20.4),
    ],
    start: DVec2::new(1.5, 12.2),
    junction: DVec2::new(20.4, 12.2),
    ring: 2.3,
    like: &[],
    varied: true,
    rounds: [
        &[(0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4), (5, 5, 5), (6, 6, 6), (7, 7, 7)],
        &[(0, 0, 8), (1, 8, 1), (2, 2, 9), (3, 9, 3), (4, 4, 4), (5, 5, 5), (6, 6, 10), (7, 10, 7)],
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
    junction: DVec2::ZERO,
    ring: 1.6,
    like: &[],
    varied: true,
    rounds: [&[(0, 0, 0), (1, 1, 1)], &[(0, 0, 0), (1, 1, 1)]],
    seconds: 85.0,
};

const TWINS: Plan = Plan {
    rooms: &[
        room("room a", [0.0, 0.0], [6.0, 5.0]),
        room("room b", [14.0, 0.0], [20.0, 5.0]),
        corridor("entry", [-4.0, 5.2], [0.5, 8.4]),
        corridor("corridor 1", [0.5, 5.2], [8.0, 7.4]),
        corridor("corridor 2", [8.0, 5.2], [12.5, 7.4]),
        corridor("corridor 3", [12.5, 5.2], [20.0, 7.4]),
    ],
    doors: &[door(0, 3, 3.0), door(1, 5, 17.0), door(2, 3, 6.3), door(3, 4, 6.3), door(4, 5, 6.3)],
    start: DVec2::new(-2.0, 6.3),
    junction: DVec2::ZERO,
    ring: 1.6,
    like: &[0, 0],
    varied: false,
    rounds: [&[(0, 0, 0), (1, 1, 1)], &[(0, 0, 0), (1, 1, 1)]],
    seconds: 112.0,
};

/// Flown from the first bay to the room in the east, back to the one in the west, and to the first bay again. The bays are made
/// like the third, which of the second to the seventh has the most texture with seeds 1 to 5, and the niches like the one
/// behind its door.
const DOORS: Plan = Plan {
    rooms: &[
        corridor("bay 1", [0.0, 0.0], [3.0, 2.4]),
        corridor("bay 2", [3.0, 0.0], [6.0, 2.4]),
        corridor("bay 3", [6.0, 0.0], [9.0, 2.4]),
        corridor("bay 4", [9.0, 0.0], [12.0, 2.4]),
        corridor("bay 5", [12.0, 0.0], [15.0, 2.4]),
        corridor("bay 6", [15.0, 0.0], [18.0, 2.4]),
        corridor("bay 7", [18.0, 0.0], [21.0, 2.4]),
        corridor("bay 8", [21.0, 0.0], [24.0, 2.4]),
        room("niche 1", [0.2, 2.6], [2.8, 4.6]),
        room("niche 2", [3.2, 2.6], [5.8, 4.6]),
        room("niche 3", [6.2, 2.6], [8.8, 4.6]),
        room("niche 4", [9.2, 2.6], [11.8, 4.6]),
        room("niche 5", [12.2, 2.6], [14.8, 4.6]),
        room("niche 6", [15.2, 2.6], [17.8, 4.6]),
        room("niche 7", [18.2, 2.6], [20.8, 4.6]),
        room("niche 8", [21.2, 2.6], [23.8, 4.6]),
        room("room west", [-6.2, -1.3], [-0.2, 3.7]),
        room("room east", [24.2, -1.3], [30.2, 3.7]),
    ],
    doors: &[
        door(16, 0, 1.2),
        door(17, 7, 1.2),
        door(0, 1, 1.2),
        door(1, 2, 1.2),
        door(2, 3, 1.2),
        door(3, 4, 1.2),
        door(4, 5, 1.2),
        door(5, 6, 1.2),
        door(6, 7, 1.2),
        door(8, 0, 1.5),
        door(9, 1, 4.5),
        door(10, 2, 7.5),
        door(11, 3, 10.5),
        door(12, 4, 13.5),
        door(13, 5, 16.5),
        door(14, 6, 19.5),
        door(15, 7, 22.5),
    ],
    start: DVec2::new(1.0, 1.2),
    // A door at the end of a corridor counts as a turn of it; the flight turns to both in the last bay.
    junction: DVec2::new(22.5, 1.2),
    ring: 1.6,
    like: &[2, 2, 2, 2, 2, 2, 2, 2, 10, 10, 10, 10, 10, 10, 10, 10],
    varied: false,
    rounds: [&[(17, 1, 1)], &[(16, 0, 0)]],
    seconds: 84.0,
};

impl Plan {
    /// The room that a room looks exactly like, or itself.
    pub fn like(&self, room: usize) -> usize {
        self.like.get(room).copied().unwrap_or(room)
    }
}

impl Extent {
    pub(super) fn plan(self) -> &'static Plan {
        match self {
            Extent::Two => &TWO,
            Extent::Whole => &WHOLE,
            Extent::Twins => &TWINS,
            Extent::Doors => &DOORS,
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
    // Which corridor it is in: one along x or one along y.
    let mut along = 0;
    let manner = if plan.varied { round } else { 0 };
    for &(room, enter, leave) in plan.rounds[round] {
        let inset = plan.ring * RING[manner];
        let [entry, exit] = [enter, leave].map(|d| inside(plan, &plan.doors[d], room, inset));
        if let Some((place, axis)) = outside(plan, &plan.doors[enter]) {
            if axis != along {
                way.push(plan.junction);
            }
            (along, _) = (axis, way.push(place));
        }
        way.push(entry);
        ring(&plan.rooms[room], inset, [entry, exit], manner == 1, &mut way);
        if let Some((place, axis)) = outside(plan, &plan.doors[leave]) {
            (along, _) = (axis, way.push(place));
        }
    }
    way.into_iter().map(|p| p.extend(FLIES_AT[manner])).collect()
}

/// The point of a room's ring in front of one of its doors.
fn inside(plan: &Plan, door: &Door, room: usize, inset: f64) -> DVec2 {
    let (axis, [below, _]) = door.wall(plan.rooms);
    let r = &plan.rooms[room];
    let mut p = DVec2::splat(door.at);
    p[axis] = if below == room { r.high[axis] - inset } else { r.low[axis] + inset };
    p
}

/// The point in the middle of the corridor in front of a door, and the axis along which that runs; `None` of a door between
/// rooms.
fn outside(plan: &Plan, door: &Door) -> Option<(DVec2, usize)> {
    let (axis, _) = door.wall(plan.rooms);
    let c = door.rooms.into_iter().map(|r| &plan.rooms[r]).find(|r| r.corridor)?;
    let mut p = DVec2::splat(door.at);
    p[axis] = 0.5 * (c.low[axis] + c.high[axis]);
    Some((p, 1 - axis))
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
