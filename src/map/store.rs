//! The images the map is trained and judged on, at mapping resolution, and what is known of each. Everything is sized at
//! boot; full is a value.

use super::coarseness::Coarseness;
use super::exposure::Exposure;
use super::keyframes::{Keyframe, PoseCorrection};
use super::refine::Refinement;
use super::shape::Shape;
use stipple_drivers::{Image, Nanos, Pose};

/// One camera's image of a keyframe in the store.
#[derive(Clone, Copy, Debug)]
pub struct Stored {
    pub id: u64,
    pub t: Nanos,
    pub epoch: u32,
    /// Odometry's pose, with its corrections.
    pub given: Pose,
    /// Where the camera sits on the body by which the stored image was drawn.
    pub body_from_cam: Pose,
    /// Where the raw camera sits whose image it was drawn from.
    body_from_raw: Pose,
    /// Pose of the camera when the Gaussians of an anchor were last put in place.
    pub placed: Pose,
    pub held_out: bool,
    pub anchor: bool,
    /// What the mapper found out beside it.
    pub refined: Refinement,
    /// What its view leaves out, that its list of intersections may hold it.
    pub coarseness: Coarseness,
}

impl Stored {
    /// Pose of the camera by odometry; right for the first image of a keyframe alone, which has its pose.
    pub fn world_from_cam(&self) -> Pose {
        self.given * self.body_from_cam
    }

    /// Odometry's pose with the mapper's own correction.
    pub fn world_from_refined(&self) -> Pose {
        self.given * self.refined.body_from_refined
    }
}

/// The images the map trains on, at mapping resolution, and what is known of each. A keyframe has one of every camera
/// that trains, side by side; what is known of the body is in the first of them.
pub struct Store {
    cameras: usize,
    /// Planes of an image: grey, or red, green and blue.
    channels: usize,
    entries: Vec<Stored>,
    planes: Vec<Image>,
    training: Vec<u32>,
}

impl Store {
    pub fn new(shape: &Shape) -> Store {
        let (capacity, channels) = (shape.images as usize, shape.channels as usize);
        let image = || Image::new(shape.width as usize, shape.height as usize);
        Store {
            cameras: shape.cameras as usize,
            channels,
            entries: Vec::with_capacity(capacity),
            planes: (0..capacity * channels).map(|_| image()).collect(),
            training: Vec::with_capacity(capacity),
        }
    }

    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether a keyframe would find no room for all its images.
    pub fn is_full(&self) -> bool {
        (self.entries.len() + self.cameras) * self.channels > self.planes.len()
    }

    /// The camera that an image is of.
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

    /// Takes the next camera of a keyframe, whose planes `draw` makes one by one; `None` when the store is full. Both poses are
    /// on the body: of the camera that is drawn, and of the raw one.
    pub fn add(
        &mut self,
        keyframe: &Keyframe,
        [body_from_cam, body_from_raw]: [Pose; 2],
        mut draw: impl FnMut(usize, &mut Image),
    ) -> Option<usize> {
        let index = self.entries.len();
        let planes = self.planes.get_mut(index * self.channels..(index + 1) * self.channels)?;
        planes.iter_mut().enumerate().for_each(|(channel, plane)| draw(channel, plane));
        let &Keyframe { id, t, epoch, world_from_body, held_out, .. } = keyframe;
        let mut refined = Refinement::default();
        // Cameras change their exposure slowly: the last one's is the best guess. Not so its offset, which cameras keep: what
        // training put there is the blur of a map that was not finished, and handed on it grows from view to view, as gains
        // fall to a quarter and seeds get ever more contrast to make up for it.
        let last = self.training.iter().rev().find(|k| self.camera(**k as usize) == self.camera(index));
        refined.exposure.gain = last.map_or(1.0, |&k| self.get(k as usize).refined.exposure.gain);
        let coarseness = last.map_or(Coarseness::default(), |&k| self.get(k as usize).coarseness);
        self.entries.push(Stored {
            id,
            t,
            epoch,
            given: world_from_body,
            body_from_cam,
            body_from_raw,
            placed: world_from_body * body_from_cam,
            held_out,
            anchor: false,
            refined,
            coarseness,
        });
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

    /// An image's exposure: its own where it is trained on; of one held out, what those beside it in time make likely.
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
        let found = self.entries.chunks_exact_mut(self.cameras).rev().find(|of_one| of_one[0].id == correction.id);
        let Some(images) = found.filter(|_| to.is_finite()) else { return false };
        images[0].given = to;
        for (e, raw) in
            images.iter_mut().zip(correction.body_from_cam.iter().flatten()).filter(|(_, raw)| raw.is_finite())
        {
            // What was drawn from the raw image keeps its place relative to it, and what was refined moves along.
            let moved = *raw * e.body_from_raw.inverse();
            e.body_from_cam = moved * e.body_from_cam;
            e.refined.body_from_refined = moved * e.refined.body_from_refined * moved.inverse();
            e.body_from_raw = *raw;
        }
        true
    }

    /// Anchors whose pose was corrected by more than `tolerance` (m, rad) since their Gaussians were put in place, and
    /// by what; they count as in place from here on.
    pub fn displaced(&mut self, tolerance: f64) -> impl Iterator<Item = (u32, Pose)> + '_ {
        self.entries.iter_mut().enumerate().filter(|(_, e)| e.anchor).filter_map(move |(i, e)| {
            let now = e.world_from_cam();
            let by = now * e.placed.inverse();
            let turned = (now.q * e.placed.q.inverse()).to_scaled_axis().length();
            if (now.p - e.placed.p).length() <= tolerance && turned <= tolerance {
                return None;
            }
            e.placed = now;
            Some((i as u32, by))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits::CAMERAS_MAX;
    use glam::{DQuat, DVec3};

    const ON_BODY: [Pose; 2] = [Pose::IDENTITY; 2];

    fn keyframe(id: u64, held_out: bool) -> Keyframe {
        Keyframe { id, held_out, ..Keyframe::default() }
    }

    fn store(images: u32, cameras: u32) -> Store {
        Store::new(&Shape { width: 2, height: 2, splats: 1, intersections: 1, images, channels: 1, cameras })
    }

    #[test]
    fn held_out_keyframes_are_stored_but_not_for_training() {
        let mut s = store(3, 1);
        for id in 0..3 {
            assert_eq!(s.add(&keyframe(id, id == 1), ON_BODY, |_, i| i.pixels.fill(9)), Some(id as usize));
        }
        assert_eq!(s.add(&keyframe(3, false), ON_BODY, |_, _| {}), None);
        assert_eq!(s.training(), [0, 2]);
        assert_eq!((s.len(), s.planes(1)[0].pixels[3]), (3, 9));
    }

    #[test]
    fn images_of_one_keyframe_share_its_pose_and_not_their_exposure() {
        let mut s = store(5, 2);
        for id in 0..2 {
            assert!(!s.is_full());
            for camera in 0..2 {
                let index = s.add(&keyframe(id, false), ON_BODY, |_, _| {}).expect("room for five");
                assert_eq!((s.camera(index), s.first(index)), (camera, 2 * id as usize));
            }
        }
        assert!(s.is_full(), "one image more is no keyframe");
        assert!(s.correct(&PoseCorrection {
            id: 1,
            world_from_body: Pose { p: DVec3::X, ..Pose::IDENTITY },
            body_from_cam: None
        }));
        assert_eq!([1, 2, 3].map(|i| s.world_from_body(i).p), [DVec3::ZERO, DVec3::X, DVec3::X]);
        s.get_mut(1).refined.exposure.gain = 2.0;
        assert_eq!(s.add(&keyframe(2, false), ON_BODY, |_, _| {}), Some(4));
        assert_eq!([0, 1, 4].map(|i| s.exposure(i).gain), [1.0, 2.0, 1.0]);
    }

    /// An estimator that learns where a camera sits moves the body, not the camera: nor do its image and its Gaussians.
    #[test]
    fn a_correction_of_rig_and_pose_that_leaves_the_camera_where_it_was_moves_nothing() {
        let mut s = store(2, 2);
        let turned = |x: f64| Pose { q: DQuat::from_rotation_x(x), p: DVec3::new(0.1, x, 0.0) };
        let (raw, raw_from_cam) = (turned(0.3), Pose { q: DQuat::from_rotation_z(0.02), p: DVec3::ZERO });
        for _ in 0..2 {
            s.add(&keyframe(7, false), [raw * raw_from_cam, raw], |_, _| {});
        }
        s.get_mut(0).anchor = true;
        s.get_mut(0).refined.body_from_refined = turned(0.2);
        let before = s.world_from_body(0) * s.get(0).body_from_cam;
        let learnt = turned(0.31);
        let world_from_body = raw * learnt.inverse();
        let mut body_from_cam = [learnt; CAMERAS_MAX];
        assert!(s.correct(&PoseCorrection { id: 7, world_from_body, body_from_cam: Some(body_from_cam) }));
        for index in 0..2 {
            let now = s.world_from_body(index) * s.get(index).body_from_cam;
            let off = now.inverse() * before;
            assert!(off.p.length() < 1e-12 && off.q.to_scaled_axis().length() < 1e-12, "{off:?}");
        }
        assert_eq!(s.displaced(1e-9).count(), 0);
        // Of one camera alone: the other stays.
        body_from_cam[0] = turned(0.4);
        assert!(s.correct(&PoseCorrection { id: 7, world_from_body, body_from_cam: Some(body_from_cam) }));
        assert_eq!(s.displaced(1e-9).count(), 1);
        body_from_cam[0].p.x = f64::NAN;
        assert!(s.correct(&PoseCorrection { id: 7, world_from_body, body_from_cam: Some(body_from_cam) }));
        assert!(s.get(0).body_from_cam.is_finite());
    }
}
