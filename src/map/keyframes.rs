//! Keyframes: the plain data that crosses the border, the queue of those not yet looked at, and the store of
//! rectified images the map is trained and judged on. Everything is sized at boot; full is a value.

use super::refine::Refinement;
use super::view::Exposure;
use crate::mem::Footprint;
use stipple_drivers::{Colour, Image, Nanos, Pose};

/// Raw images of one instant and where the body was, mid-exposure.
#[derive(Clone, Debug, Default)]
pub struct Keyframe {
    pub id: u64,
    pub t: Nanos,
    pub world_from_body: Pose,
    /// As the cameras gave them: left, right, and further ones that train.
    pub images: Vec<Image>,
    /// Of those that train on colour.
    pub colours: Vec<Colour>,
    /// Never trained on, only evaluated.
    pub held_out: bool,
}

impl Keyframe {
    /// Pre-shaped, so that filling it allocates nothing.
    pub fn with_images(images: impl Into<Vec<Image>>) -> Keyframe {
        Keyframe { images: images.into(), ..Keyframe::default() }
    }

    /// Allocates nothing as long as the images fit what was allocated for them.
    fn copy_from(&mut self, other: &Keyframe) {
        (self.id, self.t, self.world_from_body, self.held_out) =
            (other.id, other.t, other.world_from_body, other.held_out);
        let colours = self.colours.iter_mut().flatten().zip(other.colours.iter().flatten());
        for (to, from) in self.images.iter_mut().zip(&other.images).chain(colours) {
            (to.width, to.height) = (from.width, from.height);
            to.pixels.clear();
            to.pixels.extend_from_slice(&from.pixels);
        }
    }
}

/// A better pose for a keyframe offered earlier.
#[derive(Clone, Copy, Debug)]
pub struct PoseCorrection {
    pub id: u64,
    pub world_from_body: Pose,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offer {
    Accepted,
    /// The queue or the store is full; the caller goes on without.
    Full,
}

/// Pairs waiting for the mapper, oldest first; full rejects the newest.
pub struct Queue {
    slots: Vec<Keyframe>,
    pixels_max: usize,
    first: usize,
    len: usize,
}

/// The mapper takes one between two steps; four absorb the keyframes of one slow step.
pub const QUEUE_LEN: usize = 4;

impl Queue {
    pub fn footprint(pixels_max: usize, images: usize, colours: usize) -> Footprint {
        let mut f = Footprint::default();
        f.host("map: keyframes waiting", QUEUE_LEN * (images + 3 * colours) * pixels_max);
        f
    }

    /// `pixels_max` is the largest image the board accepts, `images` how many a keyframe has, `colours` how many of them in
    /// colour.
    pub fn new(pixels_max: usize, images: usize, colours: usize) -> Queue {
        let image = |_| Image { pixels: Vec::with_capacity(pixels_max), ..Image::default() };
        let slot = |_| {
            let colours = (0..colours).map(|_| std::array::from_fn(image)).collect();
            Keyframe { colours, ..Keyframe::with_images((0..images).map(image).collect::<Vec<_>>()) }
        };
        let slots = (0..QUEUE_LEN).map(slot).collect();
        Queue { slots, pixels_max, first: 0, len: 0 }
    }

    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    pub fn is_full(&self) -> bool {
        self.len == QUEUE_LEN
    }

    pub fn push(&mut self, keyframe: &Keyframe) -> Offer {
        let Keyframe { images, colours, .. } = &self.slots[0];
        if self.is_full()
            || keyframe.images.len() < images.len()
            || keyframe.colours.len() < colours.len()
            || keyframe.images.iter().any(|i| i.pixels.len() > self.pixels_max)
        {
            return Offer::Full;
        }
        self.slots[(self.first + self.len) % QUEUE_LEN].copy_from(keyframe);
        self.len += 1;
        Offer::Accepted
    }

    pub fn front(&self) -> Option<&Keyframe> {
        (self.len > 0).then(|| &self.slots[self.first])
    }

    pub fn pop(&mut self) {
        if self.len > 0 {
            self.first = (self.first + 1) % QUEUE_LEN;
            self.len -= 1;
        }
    }

    /// A keyframe still waiting takes its correction too.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        for i in 0..self.len {
            let slot = &mut self.slots[(self.first + i) % QUEUE_LEN];
            if slot.id == correction.id {
                slot.world_from_body = correction.world_from_body;
            }
        }
    }
}

/// One camera's image of a keyframe in the store.
#[derive(Clone, Copy, Debug)]
pub struct Stored {
    pub id: u64,
    pub t: Nanos,
    /// By odometry, with its corrections.
    pub given: Pose,
    /// `given` when its Gaussians were last put in place; of an anchor.
    pub placed: Pose,
    pub held_out: bool,
    pub anchor: bool,
    /// What the mapper found out beside it.
    pub refined: Refinement,
}

impl Stored {
    /// Odometry's pose with the mapper's own correction.
    pub fn world_from_refined(&self) -> Pose {
        self.given * self.refined.body_from_refined
    }
}

/// The images the map trains on, at mapping resolution, and what is known of each. A keyframe has one of every camera
/// that trains, side by side; what is known of the body is in the first of them.
pub struct Store {
    cameras: usize,
    /// Of an image: grey, or red, green and blue.
    channels: usize,
    entries: Vec<Stored>,
    planes: Vec<Image>,
    training: Vec<u32>,
}

impl Store {
    pub fn footprint(capacity: usize, channels: usize, pixels: usize) -> Footprint {
        let mut f = Footprint::default();
        f.host("map: keyframe images", capacity * channels * pixels);
        f.host("map: keyframes", capacity * (size_of::<Stored>() + channels * size_of::<Image>() + size_of::<u32>()));
        f
    }

    /// `capacity` is of images.
    pub fn new(capacity: usize, cameras: usize, channels: usize, width: usize, height: usize) -> Store {
        Store {
            cameras,
            channels,
            entries: Vec::with_capacity(capacity),
            planes: (0..capacity * channels).map(|_| Image::new(width, height)).collect(),
            training: Vec::with_capacity(capacity),
        }
    }

    pub fn len(&self) -> usize {
        self.entries.len()
    }

    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Whether a keyframe would find no room for all its images.
    pub fn is_full(&self) -> bool {
        (self.entries.len() + self.cameras) * self.channels > self.planes.len()
    }

    /// Of an image, which camera's it is.
    pub fn camera(&self, index: usize) -> usize {
        index % self.cameras
    }

    /// The first image of the same keyframe.
    pub fn first(&self, index: usize) -> usize {
        index - self.camera(index)
    }

    /// Where the body was when an image was taken: odometry's pose with the mapper's own correction.
    pub fn world_from_body(&self, index: usize) -> Pose {
        self.get(self.first(index)).world_from_refined()
    }

    /// Takes the next camera of a keyframe, whose planes `draw` makes one by one; `None` when the store is full.
    pub fn add(&mut self, keyframe: &Keyframe, mut draw: impl FnMut(usize, &mut Image)) -> Option<usize> {
        let index = self.entries.len();
        let planes = self.planes.get_mut(index * self.channels..(index + 1) * self.channels)?;
        planes.iter_mut().enumerate().for_each(|(channel, plane)| draw(channel, plane));
        let &Keyframe { id, t, world_from_body, held_out, .. } = keyframe;
        let mut refined = Refinement::default();
        // Cameras change their exposure slowly: the last one's is the best guess. Not so its offset, which cameras keep: what
        // training put there is the blur of a map that was not finished, and handed on it grows from view to view, as gains
        // fall to a quarter and seeds get ever more contrast to make up for it (V1_01 at 28 steps a second: 19.55 dB
        // against 20.37).
        let last = self.training.iter().rev().find(|k| self.camera(**k as usize) == self.camera(index));
        refined.exposure.gain = last.map_or(1.0, |&k| self.get(k as usize).refined.exposure.gain);
        let (given, placed) = (world_from_body, world_from_body);
        self.entries.push(Stored { id, t, given, placed, held_out, anchor: false, refined });
        if !held_out {
            self.training.push(index as u32);
        }
        Some(index)
    }

    pub fn get(&self, index: usize) -> &Stored {
        &self.entries[index]
    }

    pub fn get_mut(&mut self, index: usize) -> &mut Stored {
        &mut self.entries[index]
    }

    /// Grey, or red, green and blue.
    pub fn planes(&self, index: usize) -> &[Image] {
        &self.planes[index * self.channels..][..self.channels]
    }

    pub fn iter(&self) -> impl Iterator<Item = &Stored> {
        self.entries.iter()
    }

    /// Of a keyframe that is trained on, its own; of one held out, what those beside it in time make likely.
    pub fn exposure(&self, index: usize) -> Exposure {
        let e = self.get(index);
        if e.held_out {
            self.between(index).exposure
        } else {
            e.refined.exposure
        }
    }

    /// An image's exposure and its keyframe's correction, which all its images share.
    fn refined(&self, index: usize) -> Refinement {
        let mut refined = self.get(index).refined;
        refined.body_from_refined = self.get(self.first(index)).refined.body_from_refined;
        refined
    }

    /// What the keyframes trained on before and after one were refined by, at its time.
    pub fn between(&self, index: usize) -> Refinement {
        let t = self.get(index).t;
        let at = self.training.partition_point(|k| (*k as usize) < index);
        let same = |k: &&u32| self.camera(**k as usize) == self.camera(index);
        let of = |k: &u32| (self.get(*k as usize).t, self.refined(*k as usize));
        let after = self.training[at..].iter().find(same).map(of);
        let before = self.training[..at].iter().rev().find(same).map(of);
        match (before, after) {
            (Some((t0, a)), Some((t1, b))) if t1 > t0 => {
                a.towards(&b, ((t - t0).secs() / (t1 - t0).secs()).clamp(0.0, 1.0))
            }
            (one, other) => one.or(other).map_or_else(Refinement::default, |(_, refined)| refined),
        }
    }

    /// After the exposure of one image that is trained on moved: all of them move back by its share, so that their mean
    /// stays.
    pub fn balance_exposure(&mut self, moved: [f64; 2]) {
        let share = moved.map(|x| -x / self.training.len().max(1) as f64);
        for k in &self.training {
            self.entries[*k as usize].refined.shift_exposure(share);
        }
    }

    /// Indices of keyframes that may be trained on.
    pub fn training(&self) -> &[u32] {
        &self.training
    }

    pub fn anchors(&self) -> usize {
        self.entries.iter().filter(|e| e.anchor).count()
    }

    /// A correction moves what was refined along; what is not finite moves nothing. Answers whether there was one to take.
    pub fn correct(&mut self, correction: &PoseCorrection) -> bool {
        let to = correction.world_from_body;
        // The newest are corrected most.
        let found = self.entries.iter_mut().step_by(self.cameras).rev().find(|e| e.id == correction.id);
        let Some(e) = found.filter(|_| to.p.is_finite() && to.q.is_finite()) else { return false };
        e.given = to;
        true
    }

    /// Anchors whose pose was corrected by more than `tolerance` (m, rad) since their Gaussians were put in place, and
    /// by what; they count as in place from here on.
    pub fn displaced(&mut self, tolerance: f64) -> impl Iterator<Item = (u32, Pose)> + '_ {
        self.entries.iter_mut().enumerate().filter(|(_, e)| e.anchor).filter_map(move |(i, e)| {
            let by = e.given * e.placed.inverse();
            let turned = (e.given.q * e.placed.q.inverse()).to_scaled_axis().length();
            if (e.given.p - e.placed.p).length() <= tolerance && turned <= tolerance {
                return None;
            }
            e.placed = e.given;
            Some((i as u32, by))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn keyframe(id: u64, held_out: bool) -> Keyframe {
        let mut k = Keyframe::with_images([Image::new(4, 3), Image::new(4, 3)]);
        k.images[0].pixels.fill(id as u8);
        (k.id, k.held_out) = (id, held_out);
        k
    }

    #[test]
    fn full_queue_rejects_newest_and_keeps_order() {
        let mut q = Queue::new(12, 2, 0);
        for id in 1..=4 {
            assert_eq!(q.push(&keyframe(id, false)), Offer::Accepted);
        }
        assert_eq!(q.push(&keyframe(5, false)), Offer::Full);
        q.correct(&PoseCorrection { id: 2, world_from_body: Pose { p: DVec3::X, ..Pose::IDENTITY } });
        assert_eq!(q.front().map(|k| (k.id, k.images[0].pixels[0])), Some((1, 1)));
        q.pop();
        assert_eq!(q.push(&keyframe(6, false)), Offer::Accepted);
        assert_eq!(q.front().map(|k| (k.id, k.world_from_body.p)), Some((2, DVec3::X)));
        for id in [2, 3, 4, 6] {
            assert_eq!(q.front().map(|k| k.id), Some(id));
            q.pop();
        }
        assert!(q.front().is_none() && q.is_empty());
    }

    #[test]
    fn images_beyond_the_budget_are_refused() {
        assert_eq!(Queue::new(11, 2, 0).push(&keyframe(1, false)), Offer::Full);
    }

    #[test]
    fn held_out_keyframes_are_stored_but_not_for_training() {
        let mut s = Store::new(3, 1, 1, 2, 2);
        for id in 0..3 {
            assert_eq!(s.add(&keyframe(id, id == 1), |_, i| i.pixels.fill(9)), Some(id as usize));
        }
        assert_eq!(s.add(&keyframe(3, false), |_, _| {}), None);
        assert_eq!(s.training(), [0, 2]);
        assert_eq!((s.len(), s.planes(1)[0].pixels[3]), (3, 9));
    }

    #[test]
    fn images_of_one_keyframe_share_its_pose_and_not_their_exposure() {
        let mut s = Store::new(5, 2, 1, 2, 2);
        for id in 0..2 {
            assert!(!s.is_full());
            for camera in 0..2 {
                let index = s.add(&keyframe(id, false), |_, _| {}).expect("room for five");
                assert_eq!((s.camera(index), s.first(index)), (camera, 2 * id as usize));
            }
        }
        assert!(s.is_full(), "one image more is no keyframe");
        assert!(s.correct(&PoseCorrection { id: 1, world_from_body: Pose { p: DVec3::X, ..Pose::IDENTITY } }));
        assert_eq!([1, 2, 3].map(|i| s.world_from_body(i).p), [DVec3::ZERO, DVec3::X, DVec3::X]);
        s.get_mut(1).refined.exposure.gain = 2.0;
        assert_eq!(s.add(&keyframe(2, false), |_, _| {}), Some(4));
        assert_eq!([0, 1, 4].map(|i| s.exposure(i).gain), [1.0, 2.0, 1.0]);
    }
}
