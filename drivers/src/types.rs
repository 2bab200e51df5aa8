//! Time, samples, images and poses: the plain data every other module is written in.
//!
//! Instants are `Nanos`, their differences `Span`; seconds appear only through `Span::secs`.
//! Transforms are named `a_from_b`: `world_from_body * body_from_cam`.

use glam::{DMat3, DQuat, DVec3};

/// An instant: nanoseconds of the recording's (or the host's monotonic) clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Nanos(pub i64);

/// A difference of two instants, nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Span(pub i64);

impl Nanos {
    pub const MIN: Nanos = Nanos(i64::MIN);
}

impl Span {
    pub fn secs(self) -> f64 {
        self.0 as f64 * 1e-9
    }

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

/// One inertial sample in the body frame (body = IMU): gyro rad/s, specific force m/s².
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ImuSample {
    pub t: Nanos,
    pub gyro_body: DVec3,
    pub accel_body: DVec3,
}

impl ImuSample {
    pub fn is_finite(&self) -> bool {
        self.gyro_body.is_finite() && self.accel_body.is_finite()
    }
}

/// An 8-bit grey image, row-major, stride = width. Integer pixel coordinates are pixel centres.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Image {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<u8>,
}

impl Image {
    pub fn new(width: usize, height: usize) -> Image {
        Image { width, height, pixels: vec![0; width * height] }
    }

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

/// Red, green and blue of an image.
pub type Colour = [Image; 3];

/// ITU-R BT.601, the weights of JPEG's own luma.
pub fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8
}

/// Images of all cameras of a rig at one mid-exposure instant; `images[camera]`.
#[derive(Clone, Debug, Default)]
pub struct Frames {
    pub t: Nanos,
    pub images: Vec<Image>,
    /// Of the first cameras, where colour is asked for; `images` are then their luma, which is all that tracking and
    /// stereo read.
    pub colours: Vec<Colour>,
}

impl Frames {
    /// Pre-shaped for a rig, so that reading into it allocates nothing.
    pub fn for_rig(calibration: &crate::Calibration) -> Frames {
        let shape = |c: &crate::RigCamera| Image::new(c.camera.width, c.camera.height);
        Frames { t: Nanos(0), images: calibration.cameras.iter().map(shape).collect(), colours: Vec::new() }
    }

    /// Copies frames of the same shape; allocates nothing.
    pub fn copy_from(&mut self, other: &Frames) {
        self.t = other.t;
        let colours = self.colours.iter_mut().flatten().zip(other.colours.iter().flatten());
        for (to, from) in self.images.iter_mut().zip(&other.images).chain(colours) {
            to.copy_from(from);
        }
    }

    /// The first `cameras` of the rig in colour too.
    pub fn in_colour(calibration: &crate::Calibration, cameras: usize) -> Frames {
        let mut frames = Frames::for_rig(calibration);
        frames.colours = frames.images.iter().take(cameras).map(|i| std::array::from_fn(|_| i.clone())).collect();
        frames
    }
}

/// A rigid transform `a_from_b`: `p_a = q * p_b + p`. `q` is kept normalised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    pub q: DQuat,
    pub p: DVec3,
}

impl Default for Pose {
    fn default() -> Self {
        Pose::IDENTITY
    }
}

impl Pose {
    pub const IDENTITY: Pose = Pose { q: DQuat::IDENTITY, p: DVec3::ZERO };

    pub fn new(q: DQuat, p: DVec3) -> Pose {
        Pose { q: q.normalize(), p }
    }

    pub fn inverse(&self) -> Pose {
        let q = self.q.conjugate();
        Pose { q, p: -(q * self.p) }
    }

    pub fn transform(&self, p: DVec3) -> DVec3 {
        self.q * p + self.p
    }

    pub fn rotation(&self) -> DMat3 {
        DMat3::from_quat(self.q)
    }

    /// Linear in position, spherical in rotation; `s` = 0 gives `self`, 1 gives `other`.
    pub fn interpolate(&self, other: &Pose, s: f64) -> Pose {
        Pose::new(self.q.slerp(other.q, s), self.p.lerp(other.p, s))
    }

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

/// A pose at an instant (ground truth, trajectories): `world_from_body`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    pub t: Nanos,
    pub pose: Pose,
}

/// The pose at `t` from a time-sorted table, or `None` outside it or inside a hole of more than `hole`.
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
