//! What is written of blocks and keyframes is read back, and what is not of their form is refused.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

use super::*;
use crate::map::horizon::CELLS;
use proptest::prelude::*;

fn pose() -> impl Strategy<Value = Pose> {
    (any::<[f64; 3]>(), [-3.0..3.0, -3.0..3.0, -3.0..3.0]).prop_map(|(p, turn): ([f64; 3], [f64; 3])| {
        let p = DVec3::from_array(p.map(|v| if v.is_finite() { v } else { 0.0 }));
        Pose::new(DQuat::from_scaled_axis(DVec3::from_array(turn)), p)
    })
}

fn exposure() -> impl Strategy<Value = Exposure> {
    (0.01..100.0, -1.0..1.0).prop_map(|(gain, offset)| Exposure { gain, offset })
}

fn block() -> impl Strategy<Value = BlockAbout> {
    let sample = [-500.0..500.0f32, -500.0..500.0f32, -500.0..500.0f32, 0.001..20.0f32];
    let samples = proptest::collection::vec(sample, 0..=SAMPLES);
    (any::<(u32, bool, bool)>(), 0..40u32, pose(), pose(), samples).prop_map(|(free, count, placed, moved, used)| {
        let (epoch, colour, moments) = free;
        let mut samples = [[0.0; 4]; SAMPLES];
        samples[..used.len()].copy_from_slice(&used);
        BlockAbout { epoch, count, colour, moments, placed, moved, samples, samples_len: used.len() as u8 }
    })
}

/// Elements of any bits, but for those of a float that is not a number, which equals nothing.
fn filled<T: bytemuck::Pod>(n: usize, seed: u32) -> Vec<T> {
    let word = |i: usize| (i as u32).wrapping_mul(0x9e37_79b9).wrapping_add(seed) & 0xbfff_ffff;
    let words: Vec<u32> = (0..n * size_of::<T>() / 4).map(word).collect();
    taken(bytemuck::cast_slice(&words))
}

fn taken<T: bytemuck::Pod>(bytes: &[u8]) -> Vec<T> {
    let mut all = vec![];
    copied(bytes, &mut all);
    all
}

proptest! {
    #[test]
    fn runs_and_keyframes_read_back_as_they_were(
        run in any::<(u32, i64, bool, u32, u32, u32, u32)>(), depth in 0.0..9.0f64,
        (t, epoch, home, held_out, anchor) in any::<(i64, u32, u32, bool, bool)>(),
        poses in [pose(), pose(), pose(), pose()], exposure in exposure(), level in 0.0..10.0f32, steps in any::<u32>(), cell in any::<u8>(),
    ) {
        let (epoch_base, started_unix_ms, colour, width, height, cameras, channels) = run;
        let run = RunAbout { epoch_base, started_unix_ms, colour, width, height, cameras, channels, scene_depth_m: depth };
        prop_assert_eq!(RunAbout::decode(&run.encode()), Some(run));
        let [given, refined, body_from_cam, body_from_raw] = poses;
        let (t, coarseness, horizon) = (Nanos(t), Coarseness::at(level), Horizon([cell; CELLS]));
        let keyframe = KeyframeAbout {
            t, epoch, held_out, anchor, home, given, refined, body_from_cam, body_from_raw, exposure, coarseness, steps, horizon,
        };
        prop_assert_eq!(KeyframeAbout::decode(&keyframe.encode()), Some(keyframe));
    }

    #[test]
    fn blocks_read_back_with_samples_to_the_step_of_their_box(block in block()) {
        let read = BlockAbout::decode(&block.encode()).unwrap();
        prop_assert_eq!(BlockAbout { samples: block.samples, ..read }, block);
        for axis in 0..3 {
            let of = |b: &BlockAbout| b.samples().iter().map(|s| s[axis]).collect::<Vec<f32>>();
            let (was, is) = (of(&block), of(&read));
            let ends = was.iter().fold([f32::MAX, f32::MIN], |[a, b], v| [a.min(*v), b.max(*v)]);
            let close = |(a, b): (&f32, &f32)| (a - b).abs() <= (ends[1] - ends[0]) / SAMPLE_STEPS + 1e-4;
            prop_assert!(was.iter().zip(&is).all(close), "{:?} {:?}", was, is);
        }
        let sizes = block.samples().iter().zip(read.samples()).map(|(was, is)| (is[3] / was[3]).ln().abs());
        prop_assert!(sizes.fold(0.0, f32::max) <= SIZE_STEP_LN);
    }

    #[test]
    fn arrays_read_back_and_other_lengths_are_refused(block in block(), seed in any::<u32>()) {
        let n = block.count as usize;
        let (splats, steps) = (filled(n, seed), filled(n, seed + 1));
        let chroma = filled(if block.colour { n } else { 0 }, seed);
        let moments = filled(if block.moments { n } else { 0 }, seed);
        let chroma_moments = filled(if block.colour && block.moments { n } else { 0 }, seed);
        let arrays = BlockArrays {
            splats: &splats, steps: &steps, chroma: &chroma, moments: &moments, chroma_moments: &chroma_moments,
        };
        // Behind one byte: nothing is aligned.
        let mut payload = vec![7];
        arrays.encode(&mut payload);
        let bytes = block.arrays(&payload[1..]).unwrap();
        let read = (taken(bytes.splats), taken(bytes.steps), taken(bytes.chroma), taken(bytes.moments), taken(bytes.chroma_moments));
        prop_assert_eq!(read, (splats, steps, chroma, moments, chroma_moments));
        prop_assert_eq!(bytes.gaussians(&Pose::IDENTITY).len(), n);
        prop_assert!(block.arrays(&payload).is_none() && (n == 0 || block.arrays(&payload[2..]).is_none()));
    }

    #[test]
    fn foreign_bytes_are_nothing_or_something_and_never_a_panic(
        about in proptest::collection::vec(any::<u8>(), ABOUT), payload in proptest::collection::vec(any::<u8>(), 0..2000),
    ) {
        let mut about: About = about.try_into().unwrap();
        for form in [FORM, about[0]] {
            about[0] = form;
            let _ = RunAbout::decode(&about);
            let _ = KeyframeAbout::decode(&about);
            let _ = BlockAbout::decode(&about).map(|b| b.arrays(&payload).map(|a| a.gaussians(&b.moved).count()));
        }
    }

    #[test]
    fn gaussians_are_moved_as_points_and_frames_are(by in pose(), at in [-9.0..9.0f32, -9.0..9.0f32, -9.0..9.0f32]) {
        let by = Pose { p: by.p.clamp(DVec3::splat(-50.0), DVec3::splat(50.0)), ..by };
        let q = Quat::from_xyzw(0.2, -0.4, 0.1, 0.7);
        let splat = Splat {
            mean_opacity: [at[0], at[1], at[2], 0.5],
            scale_colour: [-1.0, -2.0, -3.0, 0.25],
            quat: q.to_array(),
        };
        let mut payload = vec![];
        BlockArrays { splats: &[splat], steps: &[0], ..BlockArrays::default() }.encode(&mut payload);
        let block = BlockAbout { count: 1, ..BlockAbout::default() };
        let g = block.arrays(&payload).unwrap().gaussians(&by).next().unwrap();
        let to = by.transform(Vec3::from_array(at).as_dvec3());
        prop_assert!((Vec3::from_array(g.mean).as_dvec3() - to).length() < 1e-5);
        // The length of the quaternion stays: matrices of it are scaled by its square.
        let frame = |q: Quat| glam::DMat3::from_quat(q.as_dquat().normalize());
        let off = frame(Quat::from_array(g.quat_xyzw)) - by.rotation() * frame(q);
        let length = Quat::from_array(g.quat_xyzw).length();
        prop_assert!(off.to_cols_array().iter().all(|v| v.abs() < 1e-5) && (length - q.length()).abs() < 1e-5);
        prop_assert_eq!((g.opacity_logit, g.log_scale, g.colour), (0.5, [-1.0, -2.0, -3.0], [0.25; 3]));
    }
}

#[test]
fn another_version_of_the_form_is_not_read() {
    let mut about = BlockAbout::default().encode();
    assert!(BlockAbout::decode(&about).is_some());
    about[0] = FORM + 1;
    assert!(BlockAbout::decode(&about).is_none());
}
