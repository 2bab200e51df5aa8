//! Time, samples, images and poses: the plain data that every other module uses.
//!
//! Instants are `Nanos`, their differences `Span`; seconds appear only through `Span::secs`. Transforms are named `a_from_b`:
//! `world_from_body * body_from_cam`.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// An instant: nanoseconds of a recording's clock, or of the host's monotonic one. Sums and differences saturate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
pub struct Nanos(pub i64);

/// The difference of two instants, nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
pub struct Span(pub i64);

impl Nanos {
    /// An instant before all others.
    pub const MIN: Nanos = Nanos(i64::MIN);
}

impl Span {
    /// The span in seconds.
    pub fn secs(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// The span of so many seconds, to the nearest nanosecond.
    pub fn from_secs(secs: f64) -> Span {
        Span((secs * 1e9).round() as i64)
    }
}

impl std::ops::Sub for Nanos {
    type Output = Span;
    fn sub(self, rhs: Nanos) -> Span {
        Span(self.0.saturating_sub(rhs.0))
    }
}

impl std::ops::Add<Span> for Nanos {
    type Output = Nanos;
    fn add(self, rhs: Span) -> Nanos {
        Nanos(self.0.saturating_add(rhs.0))
    }
}

impl std::ops::Sub<Span> for Nanos {
    type Output = Nanos;
    fn sub(self, rhs: Span) -> Nanos {
        Nanos(self.0.saturating_sub(rhs.0))
    }
}

/// One inertial sample in the body frame (body = IMU): angular velocity, rad/s, and specific force, m/s².
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ImuSample {
    /// When it was taken.
    pub t: Nanos,
    /// Angular velocity in the body frame, rad/s.
    pub gyro_body: DVec3,
    /// Specific force in the body frame, m/s².
    pub accel_body: DVec3,
    /// Whether gyro and accelerometer stand at the end of their range on an axis, so that what happened beyond is not known.
    pub saturated: [bool; 2],
    /// Whether its reading was repaired, or samples since the one before were refused.
    pub doubted: bool,
}

impl ImuSample {
    /// Whether all six numbers are finite.
    pub fn is_finite(&self) -> bool {
        self.gyro_body.is_finite() && self.accel_body.is_finite()
    }
}

/// An 8-bit grey image, row-major, stride = width. Integer pixel coordinates are pixel centres.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Image {
    /// Columns, pixels.
    pub width: usize,
    /// Rows, pixels.
    pub height: usize,
    /// Grey levels, row after row.
    pub pixels: Vec<u8>,
}

impl Image {
    /// A black image.
    pub fn new(width: usize, height: usize) -> Image {
        Image { width, height, pixels: vec![0; width * height] }
    }

    /// The pixel of column `x` and row `y`.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.pixels[y * self.width + x]
    }

    /// Copies the pixels of an image of equal size; allocates nothing.
    pub fn copy_from(&mut self, other: &Image) {
        debug_assert!(self.width == other.width && self.height == other.height);
        self.pixels.copy_from_slice(&other.pixels);
    }
}

/// The red, green and blue plane of an image.
pub type Colour = [Image; 3];

/// Grey of a colour, by ITU-R BT.601, the weights of JPEG's own luma.
pub fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8
}

/// The images of all cameras of a rig at one mid-exposure instant `t`: `images[camera]`.
#[derive(Clone, Debug, Default)]
pub struct Frames {
    /// Mid-exposure instant of the images.
    pub t: Nanos,
    /// Grey images, one for each camera.
    pub images: Vec<Image>,
    /// Colours of the first cameras, where they are asked for; `images` are then their luma, which is all that tracking and
    /// stereo read.
    pub colours: Vec<Colour>,
}

impl Frames {
    /// Copies frames of the same shape; allocates nothing.
    pub fn copy_from(&mut self, other: &Frames) {
        self.t = other.t;
        let colours = self.colours.iter_mut().flatten().zip(other.colours.iter().flatten());
        for (to, from) in self.images.iter_mut().zip(&other.images).chain(colours) {
            to.copy_from(from);
        }
    }
}

/// A rigid transform `a_from_b`: `p_a = q * p_b + p`. `q` is kept normalised.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Rotation `a_from_b`, of unit length.
    pub q: DQuat,
    /// Origin of b in a, m.
    pub p: DVec3,
}

impl Pose {
    /// The transform that changes nothing.
    pub const IDENTITY: Pose = Pose { q: DQuat::IDENTITY, p: DVec3::ZERO };

    /// The transform of a rotation, which is normalised, and a translation, m.
    pub fn new(q: DQuat, p: DVec3) -> Pose {
        Pose { q: q.normalize(), p }
    }

    /// `b_from_a` of `a_from_b`.
    pub fn inverse(&self) -> Pose {
        let q = self.q.conjugate();
        Pose { q, p: -(q * self.p) }
    }

    /// A point of frame b in frame a.
    pub fn transform(&self, p: DVec3) -> DVec3 {
        self.q * p + self.p
    }

    /// The rotation as a matrix.
    pub fn rotation(&self) -> DMat3 {
        DMat3::from_quat(self.q)
    }

    /// Interpolates linearly in position and spherically in rotation; `s` = 0 gives `self`, 1 gives `other`.
    pub fn interpolate(&self, other: &Pose, s: f64) -> Pose {
        Pose::new(self.q.slerp(other.q, s), self.p.lerp(other.p, s))
    }

    /// Whether all numbers are finite.
    pub fn is_finite(&self) -> bool {
        self.q.is_finite() && self.p.is_finite()
    }
}

impl std::ops::Mul for Pose {
    type Output = Pose;
    /// `a_from_c = a_from_b * b_from_c`
    fn mul(self, rhs: Pose) -> Pose {
        Pose { q: (self.q * rhs.q).normalize(), p: self.transform(rhs.p) }
    }
}

/// A pose `world_from_body` at an instant, as in ground truth and trajectories.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct TimedPose {
    /// When the body was there.
    pub t: Nanos,
    /// `world_from_body`, m.
    pub pose: Pose,
}

/// The pose at `t`, interpolated in a time-sorted table; `None` outside it or in a gap longer than `hole`.
pub fn pose_at(table: &[TimedPose], t: Nanos, hole: Span) -> Option<Pose> {
    let after = table.partition_point(|e| e.t < t);
    if after < table.len() && table[after].t == t {
        return Some(table[after].pose);
    }
    if after == 0 || after == table.len() {
        return None;
    }
    let (a, b) = (&table[after - 1], &table[after]);
    let gap = b.t - a.t;
    if gap > hole {
        return None;
    }
    Some(a.pose.interpolate(&b.pose, (t - a.t).secs() / gap.secs()))
}
