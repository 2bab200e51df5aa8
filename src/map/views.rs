//! What the map is trained and judged on: every keyframe that is known, and the images, at mapping resolution, of those that
//! have a place. Everything is sized at boot; full is a value.
//!
//! An entry is one camera's view of a keyframe; those of a keyframe stand side by side and keep their index for good. Images
//! are what is large: they lie in a fixed number of places, on the host and, by the same numbers, on the GPU. Where there is an
//! archive they come and go (`archive`); without one a keyframe keeps its place.

use super::coarseness::Coarseness;
use super::exposure::Exposure;
use super::horizon::{Absent, Horizon};
use super::keyframes::{Keyframe, PoseCorrection};
use super::refine::Refinement;
use super::schedule::Rng;
use super::shape::Shape;
use glam::DVec3;
use stipple_drivers::{Image, Nanos, Pose, Span};

/// The vehicle is with an anchor that is as near as this, m, and has left it when it was with it last so long ago.
const VISIT_NEAR_M: f64 = 5.0;
const VISIT_AWAY: Span = Span(30_000_000_000);

/// One camera's view of a keyframe.
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
    pub body_from_raw: Pose,
    /// Pose of the camera when the Gaussians of an anchor were last put in place.
    pub placed: Pose,
    pub held_out: bool,
    pub anchor: bool,
    /// What the mapper found out beside it.
    pub refined: Refinement,
    /// What its view leaves out, that its list of intersections may hold it.
    pub coarseness: Coarseness,
    /// How far it sees.
    pub horizon: Horizon,
    /// Where it shows what is not in the pool, if it does.
    pub absent: Option<Absent>,
    /// Training steps on it.
    pub steps: u32,
    /// The training step that was last started on it since the mapper was opened; zero for none.
    pub trained_at: u64,
    /// When the vehicle was last near this anchor, and whether it ever came back after it had left.
    pub near_at: Nanos,
    pub visited_again: bool,
}

impl Stored {
    /// Pose of the camera by odometry; right for the first image of a keyframe alone, which has its pose.
    pub fn world_from_cam(&self) -> Pose {
        self.given * self.body_from_cam
    }
}

/// Views that are drawn, at most, of which one is trained on next.
const VIEWS_DRAWN: usize = 4;
/// Views that there are for each that is drawn, at least. Where most of a few are drawn their order is nearly fixed, and the map is
/// worse: four fisheye views, densified, had 22.9 dB with one drawn, 23.1 with two, and 22.6 with three or four.
const VIEWS_A_DRAW: usize = 4;

/// No place, or nobody's.
const NONE: u32 = u32::MAX;

/// Every keyframe known, and places for the images of some. What is known of the body is in the first entry of a keyframe.
pub struct Views {
    cameras: usize,
    /// Planes of an image: grey, or red, green and blue.
    channels: usize,
    /// Entries that there is room for.
    known: usize,
    entries: Vec<Stored>,
    planes: Vec<Image>,
    /// The place of each keyframe's images, and the keyframe whose images are at each place.
    places: Vec<u32>,
    keyframes: Vec<u32>,
    /// How many keyframes had been given a place when that at each place was.
    arrived: Vec<u64>,
    arrivals: u64,
    training: Vec<u32>,
    /// Entries of earlier runs, which come first.
    pub earlier: usize,
}

impl Views {
    /// Room for the shape's images, and for what is known of `known` of them or more.
    pub fn new(shape: &Shape, known: usize) -> Views {
        let (cameras, channels) = (shape.cameras as usize, shape.channels as usize);
        let places = shape.images as usize / cameras;
        let known = (known / cameras).max(places) * cameras;
        let image = || Image::new(shape.width as usize, shape.height as usize);
        Views {
            cameras,
            channels,
            known,
            entries: Vec::with_capacity(known),
            planes: (0..places * cameras * channels).map(|_| image()).collect(),
            places: Vec::with_capacity(known / cameras),
            keyframes: vec![NONE; places],
            arrived: vec![0; places],
            arrivals: 0,
            training: Vec::with_capacity(known),
            earlier: 0,
        }
    }

    /// Entries; those of a keyframe follow one another.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether another keyframe would find no entry, or no place for its images.
    pub fn is_full(&self) -> bool {
        self.entries.len() + self.cameras > self.known || self.free_place().is_none()
    }

    /// Keyframes that can have a place at once.
    pub fn places(&self) -> usize {
        self.keyframes.len()
    }

    /// Index of the first view of a keyframe by its number.
    pub fn index_of(&self, id: u64) -> Option<usize> {
        let keyframes = self.entries.len() / self.cameras;
        let id_at = |keyframe: usize| self.entries[keyframe * self.cameras].id;
        // Numbers grow.
        let (mut low, mut high) = (0, keyframes);
        while low < high {
            let middle = (low + high) / 2;
            if id_at(middle) < id {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        (low < keyframes && id_at(low) == id).then_some(low * self.cameras)
    }

    /// Whether no other keyframe can be known.
    pub fn knows_all_it_can(&self) -> bool {
        self.entries.len() + self.cameras > self.known
    }

    /// A free place for the images of a keyframe.
    pub fn free_place(&self) -> Option<usize> {
        self.keyframes.iter().position(|k| *k == NONE)
    }

    /// First entries of the keyframes that have a place.
    pub fn placed(&self) -> impl Iterator<Item = usize> + '_ {
        self.keyframes.iter().filter(|k| **k != NONE).map(|k| *k as usize * self.cameras)
    }

    /// Whether the images of an entry's keyframe have a place.
    pub fn has_place(&self, index: usize) -> bool {
        self.places[index / self.cameras] != NONE
    }

    /// Number of an entry's image among the images that have a place.
    ///
    /// # Panics
    /// Where it has none.
    pub fn image(&self, index: usize) -> usize {
        let place = self.places[index / self.cameras];
        assert!(place != NONE, "the images of entry {index} have a place");
        place as usize * self.cameras + self.camera(index)
    }

    /// Gives up the place of an entry's keyframe.
    pub fn unplace(&mut self, index: usize) {
        let place = std::mem::replace(&mut self.places[index / self.cameras], NONE);
        if let Some(keyframe) = self.keyframes.get_mut(place as usize) {
            *keyframe = NONE;
        }
    }

    /// Gives an entry's keyframe a free place; false where there is none. Its planes are what was there before.
    pub fn place(&mut self, index: usize) -> bool {
        let (keyframe, Some(place)) = (index / self.cameras, self.free_place()) else { return false };
        (self.places[keyframe], self.keyframes[place]) = (place as u32, keyframe as u32);
        self.arrivals += 1;
        self.arrived[place] = self.arrivals;
        true
    }

    /// A number that is less the longer an entry's keyframe has had its place.
    ///
    /// # Panics
    /// Where it has none.
    pub fn arrival(&self, index: usize) -> u64 {
        self.arrived[self.places[index / self.cameras] as usize]
    }

    /// The camera that an image is of.
    pub fn camera(&self, index: usize) -> usize {
        index % self.cameras
    }

    pub fn cameras(&self) -> usize {
        self.cameras
    }

    /// The first image of the same keyframe.
    pub fn first(&self, index: usize) -> usize {
        index - self.camera(index)
    }

    /// Where the body was when an image was taken: odometry's pose with the mapper's own correction.
    pub fn world_from_body(&self, index: usize) -> Pose {
        let e = self.get(self.first(index));
        e.given * e.refined.body_from_refined
    }

    /// Takes the next camera of a keyframe, whose planes `draw` makes one by one; `None` when there is no room. Both poses are
    /// on the body: of the camera that is drawn, and of the raw one.
    pub fn add(
        &mut self,
        keyframe: &Keyframe,
        [body_from_cam, body_from_raw]: [Pose; 2],
        mut draw: impl FnMut(usize, &mut Image),
    ) -> Option<usize> {
        let index = self.entries.len();
        if index == self.known {
            return None;
        }
        let &Keyframe { id, t, epoch, world_from_body, held_out, .. } = keyframe;
        let mut refined = Refinement::default();
        // Cameras change their exposure slowly: the last one's is the best guess. Not so its offset, which cameras keep: what
        // training put there is the blur of a map that was not finished, and handed on it grows from view to view, as gains
        // fall to a quarter and seeds get ever more contrast to make up for it.
        let last = self.training.iter().rev().find(|k| self.camera(**k as usize) == self.camera(index));
        refined.exposure.gain = last.map_or(1.0, |&k| self.get(k as usize).refined.exposure.gain);
        let coarseness = last.map_or(Coarseness::default(), |&k| self.get(k as usize).coarseness);
        let stored = Stored {
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
            horizon: Horizon::default(),
            absent: None,
            steps: 0,
            trained_at: 0,
            near_at: t,
            visited_again: false,
        };
        if self.camera(index) == 0 && self.free_place().is_none() {
            return None;
        }
        self.know(stored);
        if self.camera(index) == 0 {
            self.place(index);
        }
        self.planes_mut(index).iter_mut().enumerate().for_each(|(channel, plane)| draw(channel, plane));
        Some(index)
    }

    /// Takes an entry without an image; false when there is no room.
    pub fn know(&mut self, stored: Stored) -> bool {
        let index = self.entries.len();
        if index == self.known {
            return false;
        }
        if self.camera(index) == 0 {
            self.places.push(NONE);
        }
        if !stored.held_out {
            self.training.push(index as u32);
        }
        self.entries.push(stored);
        true
    }

    pub fn get(&self, index: usize) -> &Stored {
        &self.entries[index]
    }

    pub fn get_mut(&mut self, index: usize) -> &mut Stored {
        &mut self.entries[index]
    }

    /// Grey, or red, green and blue, of an image that has a place.
    pub fn planes(&self, index: usize) -> &[Image] {
        &self.planes[self.image(index) * self.channels..][..self.channels]
    }

    /// The same, to be filled.
    pub fn planes_mut(&mut self, index: usize) -> &mut [Image] {
        let image = self.image(index);
        &mut self.planes[image * self.channels..][..self.channels]
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

    /// What keyframes of its run and epoch beside one were refined by, at its time; where there are none, another's exposure.
    pub fn between(&self, index: usize) -> Refinement {
        let Stored { t, epoch, .. } = self.entries[index];
        let at = self.training.partition_point(|k| (*k as usize) < index);
        let same = |k: &&u32| self.camera(**k as usize) == self.camera(index);
        let before = self.training[..at].iter().rev().find(same).map(|k| *k as usize);
        let after = self.training[at..].iter().find(same).map(|k| *k as usize);
        let own = |k: &usize| self.get(*k).epoch == epoch && (*k < self.earlier) == (index < self.earlier);
        match (before.filter(own), after.filter(own)) {
            (Some(a), Some(b)) => {
                let [t0, t1] = [a, b].map(|k| self.get(k).t);
                let share = if t1 > t0 { (t - t0).secs() / (t1 - t0).secs() } else { 0.0 };
                self.refined(a).towards(&self.refined(b), share.clamp(0.0, 1.0))
            }
            (Some(k), None) | (None, Some(k)) => self.refined(k),
            (None, None) => before
                .or(after)
                .map_or_else(Refinement::default, |k| Refinement::known(Pose::IDENTITY, self.refined(k).exposure)),
        }
    }

    /// After the exposure of one image that is trained on moved: those that are trained on beside it, all where they are not
    /// named, move back by its share, so that their mean stays.
    pub fn balance_exposure(&mut self, moved: [f64; 2], beside: Option<&[u32]>) {
        let beside = beside.unwrap_or(&self.training);
        let share = moved.map(|x| -x / beside.len().max(1) as f64);
        for k in beside {
            self.entries[*k as usize].refined.shift_exposure(share);
        }
    }

    /// Entries that are not held out, oldest first.
    pub fn training(&self) -> &[u32] {
        &self.training
    }

    /// A view of `some` to train on next: of a few that are drawn, and that `may` be taken, the one that was trained on the longest
    /// ago.
    pub fn draw(&self, some: &[u32], may: impl Fn(u32) -> bool, rng: &mut Rng) -> Option<u32> {
        let drawn = (some.len() / VIEWS_A_DRAW).clamp(1, VIEWS_DRAWN);
        self.least_recent((0..drawn).filter_map(|_| rng.one_of(some)).filter(|index| may(*index)))
    }

    /// The entry of some that was trained on the longest ago.
    pub fn least_recent(&self, some: impl Iterator<Item = u32>) -> Option<u32> {
        some.min_by_key(|index| self.get(*index as usize).trained_at)
    }

    /// Those of them that are of this run.
    pub fn own_training(&self) -> &[u32] {
        &self.training[self.training.partition_point(|k| (*k as usize) < self.earlier)..]
    }

    /// Anchors of this run.
    pub fn anchors(&self) -> usize {
        self.entries[self.earlier..].iter().filter(|e| e.anchor).count()
    }

    /// Makes one map of two epochs.
    pub fn join(&mut self, from: u32, into: u32) {
        self.entries.iter_mut().filter(|e| e.epoch == from).for_each(|e| e.epoch = into);
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

    /// Notes where the vehicle is: an anchor that it had left and is near now is visited again.
    pub fn visit(&mut self, t: Nanos, epoch: u32, p_world: DVec3) {
        let near = |e: &&mut Stored| e.epoch == epoch && e.given.p.distance(p_world) <= VISIT_NEAR_M;
        for entry in self.entries.iter_mut().filter(|e| e.anchor).filter(near) {
            entry.visited_again |= t - entry.near_at > VISIT_AWAY;
            entry.near_at = t;
        }
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
    use glam::DQuat;

    const ON_BODY: [Pose; 2] = [Pose::IDENTITY; 2];

    fn keyframe(id: u64, held_out: bool) -> Keyframe {
        Keyframe { id, held_out, ..Keyframe::default() }
    }

    fn views(images: u32, cameras: u32) -> Views {
        let shape = Shape {
            width: 2,
            height: 2,
            splats: 1,
            intersections: 1,
            images,
            channels: 1,
            cameras,
            fisheye: false,
            half_size: false,
        };
        Views::new(&shape, 0)
    }

    #[test]
    fn held_out_keyframes_are_stored_but_not_for_training() {
        let mut s = views(3, 1);
        for id in 0..3 {
            assert_eq!(s.add(&keyframe(id, id == 1), ON_BODY, |_, i| i.pixels.fill(9)), Some(id as usize));
        }
        assert_eq!(s.add(&keyframe(3, false), ON_BODY, |_, _| {}), None);
        assert_eq!(s.training(), [0, 2]);
        assert_eq!((s.len(), s.planes(1)[0].pixels[3]), (3, 9));
    }

    #[test]
    fn an_anchor_is_visited_again_when_the_vehicle_was_away_for_a_while() {
        let mut s = views(3, 1);
        for (id, epoch) in [(0, 0), (1, 0), (2, 1)] {
            s.add(&Keyframe { id, epoch, ..Keyframe::default() }, ON_BODY, |_, _| {});
        }
        // The second is no anchor, the third is of another epoch.
        (s.entries[0].anchor, s.entries[2].anchor) = (true, true);
        let mut again = |seconds: f64, x: f64| {
            s.visit(Nanos::default() + Span::from_secs(seconds), 0, DVec3::X * x);
            [0, 1, 2].map(|i| s.entries[i].visited_again)
        };
        // Around it for two minutes, and away for half of one.
        assert!((1..7).all(|k| again(20.0 * f64::from(k), 4.0) == [false; 3]));
        assert_eq!([again(130.0, 6.0), again(149.0, 4.0)], [[false; 3]; 2]);
        assert_eq!([again(179.5, 6.0), again(179.6, 4.0)], [[false; 3], [true, false, false]]);
        // Its Gaussians are those of an earlier visit from then on.
        assert_eq!(again(180.0, 4.0), [true, false, false]);
    }

    #[test]
    fn the_view_trained_on_the_longest_ago_is_one_that_never_was() {
        let mut s = views(3, 1);
        for (id, trained_at) in [(0, 7), (1, 0), (2, 5)] {
            s.add(&keyframe(id, false), ON_BODY, |_, _| {});
            s.get_mut(id as usize).trained_at = trained_at;
        }
        let of = |some: &[u32]| s.least_recent(some.iter().copied());
        assert_eq!([of(&[0, 1, 2]), of(&[0, 2, 2]), of(&[0]), of(&[])], [Some(1), Some(2), Some(0), None]);
    }

    #[test]
    fn of_many_views_the_oldest_are_drawn_and_of_few_any() {
        let often = |views: u64| {
            let (mut s, mut rng) = (views_of_one_camera(views), Rng::new(1));
            let some: Vec<u32> = (0..views as u32).collect();
            // The first half was trained on.
            (0..views / 2).for_each(|id| s.get_mut(id as usize).trained_at = 1);
            let draws = (0..1000).map(|_| s.draw(&some, |index| index > 0, &mut rng));
            draws.flatten().filter(|index| u64::from(*index) < views / 2).count()
        };
        // Of 4 views one is drawn; of 40 four, all of which are of the first half once in sixteen times.
        assert!((200..300).contains(&often(4)) && (30..100).contains(&often(40)), "{} {}", often(4), often(40));
        assert_eq!(views_of_one_camera(1).draw(&[], |_| true, &mut Rng::new(1)), None);
    }

    fn views_of_one_camera(keyframes: u64) -> Views {
        let mut s = views(keyframes as u32, 1);
        (0..keyframes).for_each(|id| _ = s.add(&keyframe(id, false), ON_BODY, |_, _| {}));
        s
    }

    #[test]
    fn images_of_one_keyframe_share_its_pose_and_not_their_exposure() {
        let mut s = views(7, 2);
        let add = |s: &mut Views, id: u64| {
            assert!(!s.is_full());
            for camera in 0..2 {
                let index = s.add(&keyframe(id, false), ON_BODY, |_, _| {}).expect("room for six");
                assert_eq!((s.camera(index), s.first(index)), (camera, 2 * id as usize));
            }
        };
        (0..2).for_each(|id| add(&mut s, id));
        assert!(s.correct(&PoseCorrection {
            id: 1,
            world_from_body: Pose { p: DVec3::X, ..Pose::IDENTITY },
            body_from_cam: None
        }));
        assert_eq!([1, 2, 3].map(|i| s.world_from_body(i).p), [DVec3::ZERO, DVec3::X, DVec3::X]);
        s.get_mut(1).refined.exposure.gain = 2.0;
        s.get_mut(3).refined.exposure.gain = 3.0;
        add(&mut s, 2);
        assert_eq!([0, 1, 4, 5].map(|i| s.exposure(i).gain), [1.0, 2.0, 1.0, 3.0]);
        assert!(s.is_full(), "one image more is no keyframe");
    }

    /// Keyframes 0 and 1 are of an earlier run; of this one 3 follows 2 in epoch 0, and 5 is between 4 and 7 in epoch 1.
    #[test]
    fn a_held_out_keyframe_has_the_corrections_of_its_own_run_and_epoch() {
        let mut s = views(8, 1);
        s.earlier = 2;
        for (id, epoch) in (0..).zip([0, 0, 0, 0, 1, 1, 2, 1]) {
            let of = Keyframe { t: Nanos(id as i64), epoch, ..keyframe(id, [1, 3, 5, 6].contains(&id)) };
            s.add(&of, ON_BODY, |_, _| {});
            let (p, exposure) = (DVec3::X * id as f64, Exposure { gain: 10.0 + id as f64, offset: 0.0 });
            s.get_mut(id as usize).refined = Refinement::known(Pose { p, ..Pose::IDENTITY }, exposure);
        }
        let found = [1, 3, 5, 6].map(|i| s.between(i)).map(|r| [r.body_from_refined.p.x, r.exposure.gain]);
        assert_eq!(found, [[0.0, 10.0], [2.0, 12.0], [5.0, 15.0], [0.0, 14.0]]);
    }

    #[test]
    fn a_place_that_is_given_up_is_another_keyframes_and_entries_stay() {
        let mut s = views(2, 1);
        (0..2).for_each(|id| _ = s.add(&keyframe(id, false), ON_BODY, |_, i| i.pixels.fill(id as u8)));
        s.unplace(0);
        assert_eq!((s.len(), s.has_place(0), s.has_place(1)), (2, false, true));
        assert!(s.place(0) && !s.place(1), "both places are taken");
        assert_eq!((s.image(0), s.placed().collect::<Vec<_>>()), (0, vec![0, 1]));
        assert!(s.arrival(0) > s.arrival(1));
    }

    /// An estimator that learns where a camera sits moves the body, not the camera: nor do its image and its Gaussians.
    #[test]
    fn a_correction_of_rig_and_pose_that_leaves_the_camera_where_it_was_moves_nothing() {
        let mut s = views(2, 2);
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
