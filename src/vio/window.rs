//! The frames being estimated: up to eight keyframe poses and four states with velocity and biases.
//!
//! Frames live in stable slots, so landmarks and the prior name them by slot; `order` is by time.
//! A frame the prior touches is *anchored*: its estimate is kept as a fixed linearisation point
//! plus an error, and every Jacobian to it is taken at that point (first-estimate Jacobians), which
//! keeps position and yaw unobservable as they are.

use super::preintegration::{Increment, Mat9};
use super::residuals::{InertialWeight, Motion, Transform};
use super::rig::RigState;
use super::shutter::Twist;
use crate::limits::{KEYFRAMES, STATES};
use crate::math::dense::Columns;
use crate::mem::List;
use glam::DVec3;
use stipple_drivers::Nanos;

/// Frames at the peak, just before marginalisation.
pub const FRAMES: usize = STATES + 1 + KEYFRAMES + 1;
pub const POSE_DIM: usize = 6;
pub const MOTION_DIM: usize = 9;

#[derive(Clone, Copy, Debug)]
pub struct Frame {
    pub t: Nanos,
    pub now: Motion,
    pub keyframe: bool,
    /// Velocity and biases are still estimated.
    pub moving: bool,
    pub is_linearized: bool,
    pub linearization_point: Motion,
    /// Error since the anchor, [p, θ, v, bg, ba].
    pub delta: [f64; 15],
    /// From the frame before, when that one is moving.
    pub increment: Increment,
    pub weight: InertialWeight,
    /// What the gyro reads at the stamp, and the twist held from it through an optimisation.
    pub rate: DVec3,
    pub twist: Twist,
    /// Mean rate of a frame found at rest, rad/s.
    pub rest: Option<DVec3>,
    /// Landmarks it hosted when it became a keyframe.
    pub hosted: usize,
    pub body: Transform,
    /// Where Jacobians are taken: the anchor, or now.
    pub body_linearized: Transform,
}

impl Frame {
    pub fn first(t: Nanos, now: Motion) -> Frame {
        let mut f = Frame {
            t,
            now,
            keyframe: false,
            moving: true,
            is_linearized: false,
            linearization_point: now,
            delta: [0.0; 15],
            increment: Increment::new(now.bg, now.ba),
            weight: InertialWeight { increment: Mat9::zeros(), bg: 0.0, ba: 0.0 },
            rate: DVec3::ZERO,
            twist: Twist::default(),
            rest: None,
            hosted: 0,
            body: Transform::default(),
            body_linearized: Transform::default(),
        };
        f.refresh();
        f
    }

    pub fn refresh(&mut self) {
        self.body = Transform::from(&self.now.pose);
        self.body_linearized =
            if self.is_linearized { Transform::from(&self.linearization_point.pose) } else { self.body };
    }

    /// Takes the twist of the estimate; an anchored frame has its own for good.
    pub fn hold_twist(&mut self) {
        if !self.is_linearized {
            let to_body = self.now.pose.q.conjugate();
            self.twist = Twist { v: to_body * self.now.v, w: self.rate - self.now.bg };
        }
    }

    /// Motion at which Jacobians are taken.
    pub fn motion_linearized(&self) -> &Motion {
        if self.is_linearized {
            &self.linearization_point
        } else {
            &self.now
        }
    }

    pub fn fix_linearization_point(&mut self) {
        if !self.is_linearized {
            (self.is_linearized, self.linearization_point, self.delta) = (true, self.now, [0.0; 15]);
            self.refresh();
        }
    }

    /// Moves by an error: an anchored frame accumulates it in the tangent space of its anchor.
    pub fn step(&mut self, d: &[f64; 15]) {
        if self.is_linearized {
            (0..15).for_each(|i| self.delta[i] += d[i]);
            self.now = self.linearization_point.plus(&self.delta);
        } else {
            self.now = self.now.plus(d);
        }
        self.refresh();
    }
}

#[derive(Clone, Debug)]
pub struct Window {
    frames: Vec<Frame>,
    saved: Vec<Frame>,
    used: [bool; FRAMES],
    /// Slots, oldest first.
    pub order: List<u8, FRAMES>,
    pub rig: RigState,
}

impl Window {
    pub fn new(rig: RigState) -> Window {
        let frames = vec![Frame::first(Nanos(0), Motion::default()); FRAMES];
        Window { saved: frames.clone(), frames, used: [false; FRAMES], order: List::default(), rig }
    }

    pub const BYTES: usize = 2 * FRAMES * size_of::<Frame>();

    pub fn clear(&mut self) {
        self.used = [false; FRAMES];
        self.order.clear();
        self.rig.release();
    }

    /// The slot taken, or `None` when the window is full.
    pub fn push(&mut self, frame: Frame) -> Option<usize> {
        let slot = self.used.iter().position(|u| !u)?;
        self.order.push(slot as u8).ok()?;
        self.used[slot] = true;
        self.frames[slot] = frame;
        Some(slot)
    }

    pub fn remove(&mut self, slot: usize) {
        self.used[slot] = false;
        self.order.retain(|s| *s as usize != slot);
    }

    pub fn slots(&self) -> impl DoubleEndedIterator<Item = usize> + '_ {
        self.order.iter().map(|s| *s as usize)
    }

    pub fn states(&self) -> impl DoubleEndedIterator<Item = usize> + '_ {
        self.slots().filter(|s| self.frames[*s].moving)
    }

    pub fn keyframe_poses(&self) -> impl DoubleEndedIterator<Item = usize> + '_ {
        self.slots().filter(|s| !self.frames[*s].moving)
    }

    pub fn newest(&self) -> Option<usize> {
        self.order.last().map(|s| *s as usize)
    }

    #[inline]
    pub fn frame(&self, slot: usize) -> &Frame {
        &self.frames[slot]
    }

    pub fn frame_mut(&mut self, slot: usize) -> &mut Frame {
        &mut self.frames[slot]
    }

    /// Before views are predicted: see `shutter`. Frames of a plain rig need none.
    pub fn hold_twists(&mut self) {
        if !self.rig.is_plain() {
            self.frames.iter_mut().for_each(Frame::hold_twist);
        }
    }

    pub fn save(&mut self) {
        self.saved.copy_from_slice(&self.frames);
        self.rig.save();
    }

    pub fn restore(&mut self) {
        self.frames.copy_from_slice(&self.saved);
        self.rig.restore();
    }

    pub fn step(&mut self, layout: &Layout, dx: &[f64]) {
        for i in 0..self.order.len() {
            let slot = self.order[i] as usize;
            let mut d = [0.0; 15];
            if let Some(o) = layout.pose(slot) {
                d[..POSE_DIM].copy_from_slice(&dx[o..o + POSE_DIM]);
            }
            if let Some(o) = layout.motion(slot) {
                d[POSE_DIM..].copy_from_slice(&dx[o..o + MOTION_DIM]);
            }
            self.frames[slot].step(&d);
        }
        let part = |span: Option<Columns>| span.map_or(&[][..], |s| &dx[s.at..s.at + s.len]);
        if layout.cameras.is_some() || layout.imu.is_some() {
            self.rig.step(part(layout.cameras), part(layout.imu));
        }
    }
}

const ABSENT: usize = usize::MAX;

/// Columns of the frames in a linear system.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    pose: [usize; FRAMES],
    motion: [usize; FRAMES],
    cameras: Option<Columns>,
    imu: Option<Columns>,
    pub dim: usize,
}

impl Layout {
    pub fn empty() -> Layout {
        Layout { pose: [ABSENT; FRAMES], motion: [ABSENT; FRAMES], cameras: None, imu: None, dim: 0 }
    }

    /// Every variable of the window.
    pub fn of(window: &Window) -> Layout {
        let mut l = Layout::empty();
        l.add_rig(&window.rig);
        for slot in window.slots() {
            l.add_pose(slot);
            if window.frame(slot).moving {
                l.add_motion(slot);
            }
        }
        l
    }

    /// Adding twice keeps the first column.
    pub fn add_pose(&mut self, slot: usize) {
        if self.pose[slot] == ABSENT {
            self.pose[slot] = self.dim;
            self.dim += POSE_DIM;
        }
    }

    pub fn add_motion(&mut self, slot: usize) {
        if self.motion[slot] == ABSENT {
            self.motion[slot] = self.dim;
            self.dim += MOTION_DIM;
        }
    }

    /// What is estimated of the rig, if anything.
    pub fn add_rig(&mut self, rig: &RigState) {
        let mut add = |len: usize| {
            let span = Columns { at: self.dim, len };
            self.dim += len;
            (len > 0).then_some(span)
        };
        (self.cameras, self.imu) = (add(rig.camera_dim()), add(rig.parts.imu_dim()));
    }

    /// Columns of the rig that views touch.
    pub fn cameras(&self) -> Option<Columns> {
        self.cameras
    }

    /// Columns of the rig that inertial factors touch.
    pub fn imu(&self) -> Option<Columns> {
        self.imu
    }

    /// Pose, then velocity and biases.
    pub fn state(&self, slot: usize) -> [Option<Columns>; 2] {
        [
            self.pose(slot).map(|at| Columns { at, len: POSE_DIM }),
            self.motion(slot).map(|at| Columns { at, len: MOTION_DIM }),
        ]
    }

    #[inline]
    pub fn pose(&self, slot: usize) -> Option<usize> {
        (self.pose[slot] != ABSENT).then_some(self.pose[slot])
    }

    #[inline]
    pub fn motion(&self, slot: usize) -> Option<usize> {
        (self.motion[slot] != ABSENT).then_some(self.motion[slot])
    }
}
