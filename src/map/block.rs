//! The form in which blocks of Gaussians and keyframes lie in the map's store (`store`): bytes from values, and back. No GPU.
//!
//! All is little endian, without gaps. A record is an `About` (464 bytes, read at boot) and a payload (read when it is needed).
//! The first byte of an `About` is `FORM`; what it does not use is zero.
//!
//! | kind | id | `About` | payload |
//! |---|---|---|---|
//! | `KIND_RUN` | 0 | `RunAbout` | none |
//! | `KIND_BLOCK` | of its anchor, times `PARTS`, plus the part (`parts`) | `BlockAbout` | arrays of `count` elements, one after another: splats (48 bytes each), steps (4), green and blue (8, in colour), Adam's moments (96, if kept), those of green and blue (16, if kept, in colour) |
//! | `KIND_KEYFRAME` | of the keyframe, times `CAMERAS_MAX`, plus the camera | `KeyframeAbout` | none |
//! | `KIND_IMAGE` | the same | none | the pixels of each plane |
//! | `KIND_JOIN` | of the epoch that is another by now | `JoinAbout` | none |
//!
//! What is known of a keyframe changes as long as the map trains; its pixels do not, and are written once.
//!
//! Samples of a block are rounded to 1/255 of the box around them (5 cm in a block of 13 m), and their sizes to 2 %: they tell
//! where a block is, and the poses keep all their digits. Decoding gives `None` for bytes that are not of this form, and never panics.

use super::coarseness::Coarseness;
use super::exposure::Exposure;
use super::horizon::Horizon;
use super::pool::Gaussian;
use crate::gpu::kernels::types::{Moments, Splat};
use crate::store::{About, ABOUT};
use glam::{DQuat, DVec3, Quat, Vec3, Vec4};
use stipple_drivers::{Nanos, Pose};

/// `store::Key::kind` of each record of a map.
pub const KIND_RUN: u8 = 1;
pub const KIND_BLOCK: u8 = 2;
pub const KIND_KEYFRAME: u8 = 3;
pub const KIND_IMAGE: u8 = 4;
pub const KIND_JOIN: u8 = 5;
/// `KeyframeAbout::home` of a keyframe that belongs to no block.
pub const NO_BLOCK: u32 = u32::MAX;
/// Samples of a block.
pub const SAMPLES: usize = 32;

/// Version of this form; a store with another is refused by `store::record::VERSION`, which is raised with it.
const FORM: u8 = 2;
/// Bytes of a pose: quaternion xyzw, then position.
const POSE: usize = 7 * size_of::<f64>();
/// Steps of a sample's coordinate in the box around all of them.
const SAMPLE_STEPS: f32 = 255.0;
/// The least size that a sample has, m, and the ratio from one code of a size to the next.
const SIZE_MIN_M: f32 = 1e-3;
const SIZE_STEP_LN: f32 = 0.04;
// Arrays are copied as they are in memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// What one run did: the frame of its keyframes, and the size of their images.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RunAbout {
    /// Its epoch 0 is this one of the store.
    pub epoch_base: u32,
    /// When the flight began, ms since 1970.
    pub started_unix_ms: i64,
    pub colour: bool,
    /// Size of a stored image, px.
    pub width: u32,
    pub height: u32,
    /// Images of a keyframe, and planes of each.
    pub cameras: u32,
    pub channels: u32,
    /// Median depth of what the first anchor saw, m; zero before there is one.
    pub scene_depth_m: f64,
}

/// An epoch that is one map with another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JoinAbout {
    /// The other one. Unique over all runs of the store.
    pub into: u32,
}

/// What is known of a block without its Gaussians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BlockAbout {
    /// Unique over all runs of the store.
    pub epoch: u32,
    /// Gaussians.
    pub count: u32,
    pub colour: bool,
    /// Whether Adam's moments follow.
    pub moments: bool,
    /// world_from_cam of the anchor by which the Gaussians were put in place.
    pub placed: Pose,
    /// Rigid motion that is to be applied to the Gaussians since they were written.
    pub moved: Pose,
    /// Means of Gaussians spread over the block, in the epoch's frame, and their σ, m; the first `samples_len` are in use.
    pub samples: [[f32; 4]; SAMPLES],
    pub samples_len: u8,
}

impl Default for BlockAbout {
    fn default() -> BlockAbout {
        BlockAbout {
            epoch: 0,
            count: 0,
            colour: false,
            moments: false,
            placed: Pose::IDENTITY,
            moved: Pose::IDENTITY,
            samples: [[0.0; 4]; SAMPLES],
            samples_len: 0,
        }
    }
}

/// What is known of one camera's view of a keyframe, without its image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct KeyframeAbout {
    pub t: Nanos,
    /// Unique over all runs of the store.
    pub epoch: u32,
    pub held_out: bool,
    pub anchor: bool,
    /// Id of the block that it sees most of, or `NO_BLOCK`.
    pub home: u32,
    /// world_from_body by odometry, with its corrections.
    pub given: Pose,
    /// body_from_refined
    pub refined: Pose,
    pub body_from_cam: Pose,
    pub body_from_raw: Pose,
    pub exposure: Exposure,
    pub coarseness: Coarseness,
    /// Training steps on it.
    pub steps: u32,
    pub horizon: Horizon,
}

/// Writes values one after another.
struct Writer {
    about: About,
    at: usize,
}

impl Writer {
    fn new() -> Writer {
        let mut writer = Writer { about: [0; ABOUT], at: 0 };
        writer.put([FORM]);
        writer
    }

    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        self.about[self.at..self.at + N].copy_from_slice(&bytes);
        self.at += N;
    }

    fn words(&mut self, words: &[u32]) {
        words.iter().for_each(|word| self.put(word.to_le_bytes()));
    }
}

/// Reads values one after another; `None` past the end.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    /// What follows the version of an `About`; `None` of another.
    fn of(about: &'a About) -> Option<Bytes<'a>> {
        let mut bytes = Bytes(about);
        (bytes.u8()? == FORM).then_some(bytes)
    }

    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*taken)
    }

    fn u8(&mut self) -> Option<u8> {
        self.take().map(|[byte]| byte)
    }

    fn bool(&mut self) -> Option<bool> {
        match self.u8()? {
            byte @ 0..=1 => Some(byte == 1),
            _ => None,
        }
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn i64(&mut self) -> Option<i64> {
        self.take().map(i64::from_le_bytes)
    }

    fn f32(&mut self) -> Option<f32> {
        self.take().map(f32::from_le_bytes).filter(|v| v.is_finite())
    }

    fn f64(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes).filter(|v| v.is_finite())
    }

    fn pose(&mut self) -> Option<Pose> {
        let q = DQuat::from_xyzw(self.f64()?, self.f64()?, self.f64()?, self.f64()?);
        let p = DVec3::new(self.f64()?, self.f64()?, self.f64()?);
        q.is_normalized().then_some(Pose { q, p })
    }

    fn exposure(&mut self) -> Option<Exposure> {
        let exposure = Exposure { gain: self.f64()?, offset: self.f64()? };
        (exposure.gain > 0.0).then_some(exposure)
    }

    /// Three numbers, m.
    fn place(&mut self) -> Option<Vec3> {
        Some(Vec3::new(self.f32()?, self.f32()?, self.f32()?))
    }
}

fn pose_bytes(pose: &Pose) -> [u8; POSE] {
    let mut bytes = [0; POSE];
    let numbers = pose.q.to_array().into_iter().chain(pose.p.to_array());
    bytes.chunks_exact_mut(size_of::<f64>()).zip(numbers).for_each(|(to, v)| to.copy_from_slice(&v.to_le_bytes()));
    bytes
}

fn exposure_bytes(exposure: &Exposure) -> [u8; 2 * size_of::<f64>()] {
    std::array::from_fn(|i| [exposure.gain, exposure.offset][i / 8].to_le_bytes()[i % 8])
}

impl RunAbout {
    pub fn encode(&self) -> About {
        let mut w = Writer::new();
        w.put(self.started_unix_ms.to_le_bytes());
        w.put([u8::from(self.colour)]);
        w.words(&[self.epoch_base, self.width, self.height, self.cameras, self.channels]);
        w.put(self.scene_depth_m.to_le_bytes());
        w.about
    }

    pub fn decode(about: &About) -> Option<RunAbout> {
        let mut b = Bytes::of(about)?;
        let (started_unix_ms, colour) = (b.i64()?, b.bool()?);
        let [epoch_base, width, height, cameras, channels] = [b.u32()?, b.u32()?, b.u32()?, b.u32()?, b.u32()?];
        let scene_depth_m = b.f64()?;
        Some(RunAbout { epoch_base, started_unix_ms, colour, width, height, cameras, channels, scene_depth_m })
    }
}

impl JoinAbout {
    pub fn encode(&self) -> About {
        let mut w = Writer::new();
        w.words(&[self.into]);
        w.about
    }

    pub fn decode(about: &About) -> Option<JoinAbout> {
        Some(JoinAbout { into: Bytes::of(about)?.u32()? })
    }
}

impl BlockAbout {
    /// The samples in use.
    pub fn samples(&self) -> &[[f32; 4]] {
        &self.samples[..usize::from(self.samples_len).min(SAMPLES)]
    }

    /// Samples that are not finite are left out.
    pub fn encode(&self) -> About {
        let samples = || self.samples().iter().map(|s| Vec4::from_array(*s)).filter(|s| s.is_finite());
        let least = samples().map(Vec4::truncate).reduce(Vec3::min).unwrap_or(Vec3::ZERO);
        let most = samples().map(Vec4::truncate).reduce(Vec3::max).unwrap_or(Vec3::ZERO);
        // Beyond what is one block by far: the size stays a number.
        let size = (most - least).min(Vec3::splat(f32::MAX));
        let mut w = Writer::new();
        w.words(&[self.epoch, self.count]);
        w.put([u8::from(self.colour)]);
        w.put([u8::from(self.moments)]);
        w.put(pose_bytes(&self.placed));
        w.put(pose_bytes(&self.moved));
        w.put([samples().count() as u8]);
        least.to_array().into_iter().chain(size.to_array()).for_each(|v| w.put(v.to_le_bytes()));
        for sample in samples() {
            for ((at, least), size) in sample.to_array().into_iter().zip(least.to_array()).zip(size.to_array()) {
                let step = if size > 0.0 { ((at - least) / size * SAMPLE_STEPS).round() } else { 0.0 };
                w.put([step as u8]);
            }
            w.put([((sample.w / SIZE_MIN_M).ln() / SIZE_STEP_LN).round() as u8]);
        }
        w.about
    }

    pub fn decode(about: &About) -> Option<BlockAbout> {
        let mut b = Bytes::of(about)?;
        let (epoch, count, colour, moments) = (b.u32()?, b.u32()?, b.bool()?, b.bool()?);
        let (placed, moved) = (b.pose()?, b.pose()?);
        let samples_len = b.u8().filter(|n| usize::from(*n) <= SAMPLES)?;
        let (least, size) = (b.place()?, b.place()?);
        let mut samples = [[0.0; 4]; SAMPLES];
        for sample in &mut samples[..usize::from(samples_len)] {
            for axis in 0..3 {
                let step = f32::from(b.u8()?);
                sample[axis] = least[axis] + size[axis] * (step / SAMPLE_STEPS);
            }
            sample[3] = SIZE_MIN_M * (f32::from(b.u8()?) * SIZE_STEP_LN).exp();
        }
        Some(BlockAbout { epoch, count, colour, moments, placed, moved, samples, samples_len })
    }

    /// Bytes of the payload's arrays, in their order; those that are not kept are empty. `None` beyond what memory could hold.
    fn lengths(&self) -> Option<[usize; 5]> {
        let n = self.count as usize;
        let of = |kept: bool, each: usize| n.checked_mul(if kept { each } else { 0 });
        Some([
            of(true, size_of::<Splat>())?,
            of(true, size_of::<u32>())?,
            of(self.colour, size_of::<[f32; 2]>())?,
            of(self.moments, size_of::<Moments>())?,
            of(self.moments && self.colour, size_of::<[f32; 4]>())?,
        ])
    }

    /// Bytes of the payload; `None` beyond what memory could hold.
    pub fn payload_bytes(&self) -> Option<usize> {
        self.lengths()?.into_iter().try_fold(0usize, |sum, n| sum.checked_add(n))
    }

    /// The arrays in a payload; `None` where it has another length.
    pub fn arrays<'a>(&self, payload: &'a [u8]) -> Option<BlockBytes<'a>> {
        if self.payload_bytes()? != payload.len() {
            return None;
        }
        let mut rest = payload;
        let [splats, steps, chroma, moments, chroma_moments] = self.lengths()?.map(|n| {
            let (array, after) = rest.split_at(n);
            rest = after;
            array
        });
        Some(BlockBytes { splats, steps, chroma, moments, chroma_moments })
    }
}

/// The arrays of a block, as the device has them. Those that are not kept are empty.
#[cfg(feature = "instruments")]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BlockArrays<'a> {
    pub splats: &'a [Splat],
    pub steps: &'a [u32],
    pub chroma: &'a [[f32; 2]],
    pub moments: &'a [Moments],
    pub chroma_moments: &'a [[f32; 4]],
}

#[cfg(feature = "instruments")]
impl BlockArrays<'_> {
    /// Appends a payload.
    pub fn encode(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(bytemuck::cast_slice(self.splats));
        out.extend_from_slice(bytemuck::cast_slice(self.steps));
        out.extend_from_slice(bytemuck::cast_slice(self.chroma));
        out.extend_from_slice(bytemuck::cast_slice(self.moments));
        out.extend_from_slice(bytemuck::cast_slice(self.chroma_moments));
    }
}

/// The arrays of a block as they lie in its payload, which may be aligned to nothing: `copied` takes them out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BlockBytes<'a> {
    pub splats: &'a [u8],
    pub steps: &'a [u8],
    pub chroma: &'a [u8],
    pub moments: &'a [u8],
    pub chroma_moments: &'a [u8],
}

/// Replaces what is in `to` by the elements of an array in a payload, whole ones. Allocates where `to` has no room.
#[cfg(feature = "instruments")]
pub fn copied<T: bytemuck::Pod>(bytes: &[u8], to: &mut Vec<T>) {
    to.clear();
    to.resize(bytes.len() / size_of::<T>(), T::zeroed());
    let whole = size_of_val(to.as_slice());
    bytemuck::cast_slice_mut(to).copy_from_slice(&bytes[..whole]);
}

impl<'a> BlockBytes<'a> {
    /// The Gaussians, moved by `by` as move_block.comp does: means and rotations.
    pub fn gaussians(&self, by: &Pose) -> impl ExactSizeIterator<Item = Gaussian> + 'a {
        let (splats, chroma) = (self.splats, self.chroma);
        let (turn, shift) = (by.q, by.p);
        (0..splats.len() / size_of::<Splat>()).map(move |i| {
            let splat: Splat = bytemuck::pod_read_unaligned(&splats[i * size_of::<Splat>()..][..size_of::<Splat>()]);
            let grey = [splat.scale_colour[3]; 2];
            let chroma = chroma.chunks_exact(size_of_val(&grey)).nth(i).map_or(grey, bytemuck::pod_read_unaligned);
            let g = Gaussian::unpacked(&splat, chroma);
            let mean = turn * Vec3::from_array(g.mean).as_dvec3() + shift;
            // The stored quaternion need not be of unit length, and keeps its own.
            let quat = turn.as_quat().mul_quat(Quat::from_vec4(Vec4::from_array(g.quat_xyzw)));
            Gaussian { mean: mean.as_vec3().to_array(), quat_xyzw: quat.to_array(), ..g }
        })
    }
}

impl KeyframeAbout {
    pub fn encode(&self) -> About {
        let mut w = Writer::new();
        w.put(self.t.0.to_le_bytes());
        w.words(&[self.epoch, self.home]);
        w.put([u8::from(self.held_out)]);
        w.put([u8::from(self.anchor)]);
        let poses = [self.given, self.refined, self.body_from_cam, self.body_from_raw];
        poses.iter().for_each(|pose| w.put(pose_bytes(pose)));
        w.put(exposure_bytes(&self.exposure));
        w.put(self.coarseness.level().to_le_bytes());
        w.words(&[self.steps]);
        w.put(self.horizon.0);
        w.about
    }

    pub fn decode(about: &About) -> Option<KeyframeAbout> {
        let mut b = Bytes::of(about)?;
        let (t, epoch, home) = (Nanos(b.i64()?), b.u32()?, b.u32()?);
        let (held_out, anchor) = (b.bool()?, b.bool()?);
        let (given, refined, body_from_cam, body_from_raw) = (b.pose()?, b.pose()?, b.pose()?, b.pose()?);
        let (exposure, coarseness) = (b.exposure()?, Coarseness::at(b.f32()?));
        let (steps, horizon) = (b.u32()?, Horizon(b.take()?));
        Some(KeyframeAbout {
            t,
            epoch,
            held_out,
            anchor,
            home,
            given,
            refined,
            body_from_cam,
            body_from_raw,
            exposure,
            coarseness,
            steps,
            horizon,
        })
    }
}

#[cfg(test)]
#[path = "block_tests.rs"]
mod tests;
