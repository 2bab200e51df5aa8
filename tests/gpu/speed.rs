//! How long a training step takes, by kernel: `cargo test --release --test gpu speed -- --ignored --nocapture`.
//! STIPPLE_SPEED="width height splats steps" changes the case.

use super::splat::{view, Rng};
use glam::DVec3;
use stipple::config::GpuConfig;
use stipple::gpu::Gpu;
use stipple::map::pipeline::{LearningRates, Pipeline, Shape, SplatInit, View, Weights};

/// One Gaussian where a seeder would put it: on a wavy wall, as wide as its share of the image.
fn seeds(n: usize, v: &View) -> Vec<SplatInit> {
    let mut r = Rng(1);
    let c = &v.camera;
    let pitch = ((c.width * c.height) as f64 / n as f64).sqrt();
    (0..n)
        .map(|_| {
            let (x, y) = (r.uniform(0.0, c.width as f64), r.uniform(0.0, c.height as f64));
            let z = 3.0 + (x * 0.02).sin() + (y * 0.03).cos();
            let p = v.world_from_cam.transform(DVec3::new((x - c.cx) / c.fx * z, (y - c.cy) / c.fy * z, z));
            SplatInit {
                mean: p.as_vec3().to_array(),
                log_scale: std::array::from_fn(|_| (z / c.fx * pitch * r.uniform(0.5, 1.2)).ln() as f32),
                quat_xyzw: std::array::from_fn(|_| r.uniform(-1.0, 1.0) as f32),
                opacity_logit: r.uniform(-1.0, 2.0) as f32,
                colour: r.uniform(0.1, 0.9) as f32,
            }
        })
        .collect()
}

fn cpu_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat[stat.rfind(')').unwrap() + 2..].split(' ').collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

#[test]
#[ignore = "measures"]
fn a_training_step() {
    let case = std::env::var("STIPPLE_SPEED").unwrap_or("376 240 20000 30".into());
    let n: Vec<usize> = case.split(' ').map(|s| s.parse().unwrap()).collect();
    let v = view(n[0], n[1]);
    let shape = Shape {
        width: n[0] as u32,
        height: n[1] as u32,
        splats: n[2] as u32,
        intersections: 20 * n[2] as u32,
        keyframes: 1,
        channels: 1,
        sh_degree: 0,
        cameras: 1,
        inverse_depth: false,
    };
    let mut gpu = Gpu::open(&GpuConfig::default(), Pipeline::arena_bytes(&shape)).unwrap();
    let mut p = Pipeline::new(&mut gpu, shape).unwrap();
    p.append(&mut gpu, &seeds(n[2], &v)).unwrap();
    let goal: Vec<u8> = (0..n[0] * n[1])
        .map(|i| (128.0 + 90.0 * ((i % n[0]) as f64 * 0.2).sin() * ((i / n[0]) as f64 * 0.15).cos()) as u8)
        .collect();
    p.set_keyframe(&mut gpu, 0, &goal).unwrap();
    let rates = LearningRates { position: 1e-3, scale: 5e-3, rotation: 2e-3, opacity: 5e-2, colour: 5e-3 };
    let mut step = |gpu: &mut Gpu| p.train(gpu, &v, 0, &rates, &Weights::default()).unwrap();
    step(&mut gpu);
    let before: Vec<f64> = gpu.timings().iter().map(|t| t.total_ms).collect();
    let (cpu, wall) = (cpu_secs(), std::time::Instant::now());
    let mut last = step(&mut gpu);
    for _ in 1..n[3] {
        last = step(&mut gpu);
    }
    let steps = n[3] as f64;
    let timed: Vec<_> = gpu.timings().to_vec();
    gpu.time_commands(false).unwrap();
    let (start, mut device_ms) = (std::time::Instant::now(), 0.0);
    for _ in 0..n[3] {
        step(&mut gpu);
        device_ms += gpu.last_submit_ms();
    }
    println!(
        "commands not timed: {:.3} ms of wall, {:.3} of it on the device",
        start.elapsed().as_secs_f64() * 1e3 / steps,
        device_ms / steps
    );
    println!(
        "{case} on {}: {:.2} ms of wall, {:.1} ms of CPU a step; {last:?}",
        gpu.caps().name,
        wall.elapsed().as_secs_f64() * 1e3 / steps,
        (cpu_secs() - cpu) * 1e3 / steps
    );
    for (t, before) in timed.iter().zip(before) {
        println!("{:>24} {:8.3} ms", t.name, (t.total_ms - before) / steps);
    }
}
