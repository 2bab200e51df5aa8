//! What makes steps fast must not show in the map: steps started ahead.

use super::splat::{open, scene, shape, target, train, view, FAST};
use stipple::gpu::{Gpu, GpuOptions};
use stipple::map::pipeline::{Pipeline, Rendered, SplatInit, StepStats, Weights};

/// The map, to the bit.
fn map(gpu: &mut Gpu, p: &mut Pipeline) -> Vec<u32> {
    let mut map: Vec<SplatInit> = Vec::new();
    p.download(gpu, &mut map).unwrap();
    bytemuck::cast_slice(&map).to_vec()
}

#[test]
fn steps_started_ahead_leave_the_same_map_and_answers_to_the_bit() {
    const STEPS: usize = 9;
    let v = view(65, 47);
    let s = shape(&v, 512, 1 << 16);
    let ready = |gpu: &mut Gpu, p: &mut Pipeline| {
        p.append(gpu, &scene(500, &v, 9)).unwrap();
        p.set_keyframe(gpu, 0, &target(65, 47)).unwrap();
    };
    let (mut gpu, mut p) = open(s);
    ready(&mut gpu, &mut p);
    let answers = train(&mut gpu, &mut p, &v, STEPS);
    let waited_for = map(&mut gpu, &mut p);

    let validated = GpuOptions { validation: true };
    let Ok(mut gpu) = Gpu::open_with(&crate::config(), Pipeline::arena_bytes(&s), validated) else {
        return println!("ignored: there is no validation layer");
    };
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    ready(&mut gpu, &mut p);
    let (mut ahead, mut under_way): (Vec<StepStats>, _) = (Vec::new(), None);
    for i in 0..=STEPS {
        let next = (i < STEPS).then(|| p.start(&mut gpu, &v, 0, &FAST, &Weights::default()).unwrap());
        // Looking at the map in between neither disturbs it nor what the step has to say.
        if i % 4 == 2 {
            p.render(&mut gpu, &v, &mut Rendered::default()).unwrap();
        }
        if let Some(step) = std::mem::replace(&mut under_way, next) {
            ahead.push(p.finish(&mut gpu, &step).unwrap());
        }
    }
    assert_eq!(answers, ahead);
    assert!(waited_for == map(&mut gpu, &mut p));
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
