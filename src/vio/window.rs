//! The frames being estimated: states with velocity and biases, and older keyframes as poses only; how many of each
//! is in `limits.rs`.
//!
//! Frames live in stable slots, so landmarks and the prior name them by slot; `order` is by time.
//! A frame the prior touches has a fixed linearization point: its estimate is kept as that point
//! plus an error, and every Jacobian to it is taken there (first-estimate Jacobians), which
//! keeps position and yaw unobservable as they are.

use super::inertial::{InertialWeight, Motion};
use super::preintegration::{Increment, Mat9};
use super::reprojection::Transform;
use super::rig::RigState;
use super::shutter::Twist;
use crate::limits::FRAMES;
use crate::math::dense::Columns;
use crate::math::so3;
use crate::mem::List;
use glam::DVec3;
use stipple_drivers::{Nanos, Pose};

/// Dimensions of [p, θ], and of [v, bg, ba].
pub const POSE_DIM: usize = 6;
pub const MOTION_DIM: usize = 9;
/// Dimension of a barometer's bias.
const HEIGHT_BIAS_DIM: usize = 1;

/// What a barometer says of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Height {
    /// Nothing yet.
    Unknown,
    /// What cannot be.
    Refused,
    /// The height above the first reading, m, and its inverse deviation.
    Measured { height: f64, weight: f64 },
}

/// One frame of the window.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    pub t: Nanos,
    /// The estimate.
    pub now: Motion,
    pub keyframe: bool,
    /// Velocity and biases are still estimated.
    pub is_state: bool,
    /// Its views may all be wrong, and count less: they contradict its prediction, or something speaks against the estimate.
    pub doubted: bool,
    /// Point at which Jacobians are taken for good, once the prior is about this frame.
    pub linearization_point: Option<Motion>,
    /// Error since the linearization point, [p, θ, v, bg, ba].
    pub delta: [f64; 15],
    /// Inertial samples since the frame before, when that one is a state.
    pub increment: Increment,
    pub weight: InertialWeight,
    /// Reading of the gyro at the stamp, rad/s, and the twist held from it through an optimization.
    pub rate: DVec3,
    pub twist: Twist,
    /// Mean rate of a frame found at rest, rad/s.
    pub rest_rate: Option<DVec3>,
    /// What a barometer said at the stamp, its bias there, m, and the inverse deviation of its walk since the state before.
    pub height: Height,
    pub height_bias: f64,
    pub height_walk: f64,
    /// Landmarks it hosted when it became a keyframe.
    pub hosted: usize,
    /// Pose at the estimate, and at the point where Jacobians are taken.
    pub world_from_body: Transform,
    pub world_from_body_linearized: Transform,
}

impl Frame {
    /// A state that nothing has been measured at.
    pub fn new(t: Nanos, now: Motion) -> Frame {
        let mut f = Frame {
            t,
            now,
            keyframe: false,
            is_state: true,
            doubted: false,
            linearization_point: None,
            delta: [0.0; 15],
            increment: Increment::new(now.bg, now.ba),
            weight: InertialWeight { increment: Mat9::zeros(), bg: 0.0, ba: 0.0 },
            rate: DVec3::ZERO,
            twist: Twist::default(),
            rest_rate: None,
            height: Height::Unknown,
            height_bias: 0.0,
            height_walk: 0.0,
            hosted: 0,
            world_from_body: Transform::default(),
            world_from_body_linearized: Transform::default(),
        };
        f.refresh();
        f
    }

    fn refresh(&mut self) {
        self.world_from_body = Transform::from(&self.now.pose);
        self.world_from_body_linearized = Transform::from(&self.linearized().pose);
    }

    /// Takes the twist of the estimate; a frame with a fixed linearization point has its own for good.
    pub fn hold_twist(&mut self) {
        if self.linearization_point.is_none() {
            let to_body = self.now.pose.q.conjugate();
            self.twist = Twist { v: to_body * self.now.v, w: self.rate - self.now.bg };
        }
    }

    /// Motion at which Jacobians are taken.
    pub fn linearized(&self) -> &Motion {
        self.linearization_point.as_ref().unwrap_or(&self.now)
    }

    /// Makes the present estimate the point at which Jacobians are taken from now on.
    pub fn fix_linearization_point(&mut self) {
        if self.linearization_point.is_none() {
            (self.linearization_point, self.delta) = (Some(self.now), [0.0; 15]);
            self.refresh();
        }
    }

    /// Moves by an error, which a frame with a fixed linearization point sums up in the tangent space there.
    pub fn step(&mut self, d: &[f64; 15]) {
        match self.linearization_point {
            Some(point) => {
                (0..15).for_each(|i| self.delta[i] += d[i]);
                self.now = point.plus(&self.delta);
            }
            None => self.now = self.now.plus(d),
        }
        self.refresh();
    }
}

/// The frames, in slots, and the rig.
#[derive(Clone, Debug)]
pub struct Window {
    frames: Vec<Frame>,
    saved: Vec<Frame>,
    used: [bool; FRAMES],
    /// Slots, oldest first.
    pub order: List<u8, FRAMES>,
    pub rig: RigState,
    /// States have the bias of a barometer.
    pub has_heights: bool,
}

impl Window {
    pub fn new(rig: RigState) -> Window {
        let frames = vec![Frame::new(Nanos(0), Motion::default()); FRAMES];
        Window { saved: frames.clone(), frames, used: [false; FRAMES], order: List::default(), rig, has_heights: false }
    }

    /// Forgets the frames and keeps what was learnt of the rig.
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

    /// Frees the slot of a frame.
    pub fn remove(&mut self, slot: usize) {
        self.used[slot] = false;
        self.order.retain(|s| *s as usize != slot);
    }

    /// Slots of all frames, oldest first.
    pub fn slots(&self) -> impl DoubleEndedIterator<Item = usize> + '_ {
        self.order.iter().map(|s| *s as usize)
    }

    /// Slots of states, oldest first.
    pub fn states(&self) -> impl DoubleEndedIterator<Item = usize> + '_ {
        self.slots().filter(|s| self.frames[*s].is_state)
    }

    /// Slots of frames that are poses only, oldest first.
    pub fn keyframe_poses(&self) -> impl DoubleEndedIterator<Item = usize> + '_ {
        self.slots().filter(|s| !self.frames[*s].is_state)
    }

    /// Slot of the newest frame.
    pub fn newest(&self) -> Option<usize> {
        self.order.last().map(|s| *s as usize)
    }

    /// The frame in a slot.
    #[inline]
    pub fn frame(&self, slot: usize) -> &Frame {
        &self.frames[slot]
    }

    /// The frame in a slot that is taken, to change it.
    pub fn frame_mut(&mut self, slot: usize) -> &mut Frame {
        &mut self.frames[slot]
    }

    /// Pose of the body at the exposure of a frame by camera 0.
    pub fn exposed(&self, frame: &Frame) -> Pose {
        let Motion { pose, v, bg, .. } = frame.now;
        let Some(tau) = self.rig.exposure() else { return pose };
        Pose::new(pose.q * so3::exp((frame.rate - bg) * tau), pose.p + v * tau)
    }

    /// Takes the twists that views are predicted with (`shutter.rs`). Frames of a plain rig need none.
    pub fn hold_twists(&mut self) {
        if !self.rig.is_plain() {
            self.frames.iter_mut().for_each(Frame::hold_twist);
        }
    }

    /// Keeps all estimates for `restore`.
    pub fn save(&mut self) {
        self.saved.copy_from_slice(&self.frames);
        self.rig.save();
    }

    /// Takes back all estimates as `save` kept them.
    pub fn restore(&mut self) {
        self.frames.copy_from_slice(&self.saved);
        self.rig.restore();
    }

    /// Moves every frame and the rig by the solution of a system.
    pub fn step(&mut self, layout: &Layout, dx: &[f64]) {
        for i in 0..self.order.len() {
            let slot = self.order[i] as usize;
            let mut d = [0.0; 15];
            for (part, first) in layout.state(slot).into_iter().zip([0, POSE_DIM]) {
                let Some(part) = part else { continue };
                d[first..first + part.len].copy_from_slice(&dx[part.at..part.at + part.len]);
            }
            self.frames[slot].step(&d);
            self.frames[slot].height_bias += layout.height_bias(slot).map_or(0.0, |part| dx[part.at]);
        }
        self.rig.step(&dx[layout.rig.at..][..layout.rig.len]);
    }
}

/// Columns of the frames and of the rig in a linear system.
#[derive(Clone, Copy, Debug, Default)]
pub struct Layout {
    pose: [Option<usize>; FRAMES],
    motion: [Option<usize>; FRAMES],
    height_bias: [Option<usize>; FRAMES],
    /// All columns of the rig: those that cameras touch, then those of the inertial unit.
    pub rig: Columns,
    camera_dim: usize,
    pub dim: usize,
}

impl Layout {
    /// Columns of every variable of the window: the rig first, the newest state last.
    pub fn of(window: &Window) -> Layout {
        let mut l = Layout::default();
        l.add_rig(&window.rig);
        for slot in window.slots() {
            if window.frame(slot).is_state {
                l.add_height_bias(window, slot);
                l.add_pose(slot);
                l.add_motion(slot);
            } else {
                l.add_pose(slot);
            }
        }
        l
    }

    /// Column of a barometer's bias at a state, where there is a barometer.
    pub fn add_height_bias(&mut self, window: &Window, slot: usize) {
        if window.has_heights {
            self.height_bias[slot] = Some(self.dim);
            self.dim += HEIGHT_BIAS_DIM;
        }
    }

    /// Columns of a frame's pose; adding twice keeps the first.
    pub fn add_pose(&mut self, slot: usize) {
        if self.pose[slot].is_none() {
            self.pose[slot] = Some(self.dim);
            self.dim += POSE_DIM;
        }
    }

    /// Columns of a state's velocity and biases.
    pub fn add_motion(&mut self, slot: usize) {
        self.motion[slot] = Some(self.dim);
        self.dim += MOTION_DIM;
    }

    /// What is estimated of the rig, if anything.
    pub fn add_rig(&mut self, rig: &RigState) {
        (self.rig, self.camera_dim) = (Columns { at: self.dim, len: rig.dim() }, rig.camera_dim());
        self.dim += self.rig.len;
    }

    /// Columns of the rig that views touch.
    pub fn cameras(&self) -> Option<Columns> {
        (self.camera_dim > 0).then_some(Columns { len: self.camera_dim, ..self.rig })
    }

    /// Columns of the rig that inertial factors touch.
    pub fn imu(&self) -> Option<Columns> {
        let (at, len) = (self.rig.at + self.camera_dim, self.rig.len - self.camera_dim);
        (len > 0).then_some(Columns { at, len })
    }

    /// Columns of all poses.
    pub fn poses(&self) -> impl Iterator<Item = Columns> + '_ {
        self.pose.iter().flatten().map(|at| Columns { at: *at, len: POSE_DIM })
    }

    /// Columns of a frame's pose, then of its velocity and biases.
    pub fn state(&self, slot: usize) -> [Option<Columns>; 2] {
        let motion = self.motion[slot].map(|at| Columns { at, len: MOTION_DIM });
        [self.pose(slot).map(|at| Columns { at, len: POSE_DIM }), motion]
    }

    /// Column of a barometer's bias at a state.
    pub fn height_bias(&self, slot: usize) -> Option<Columns> {
        self.height_bias[slot].map(|at| Columns { at, len: HEIGHT_BIAS_DIM })
    }

    /// First column of a frame's pose.
    #[inline]
    pub fn pose(&self, slot: usize) -> Option<usize> {
        self.pose[slot]
    }
}
