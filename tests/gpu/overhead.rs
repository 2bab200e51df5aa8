//! Times: what the core tells, and what it costs beside the kernels.
//!
//! `cargo test --release --test gpu_core -- --ignored --nocapture`

use super::{axpy, floats, open};
use std::time::Instant;
use stipple::config::GpuConfig;
use stipple::gpu::{Gpu, GpuOptions, Threads};

/// Milliseconds of one call, the median of `n`.
fn median_ms(n: usize, mut call: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..n)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[n / 2]
}

#[test]
fn timings_name_every_command_and_add_up() {
    let mut gpu = open(1 << 22);
    let x = floats(&mut gpu, "x", &[1.0; 100_000]);
    let y = gpu.alloc::<f32>("y", 100_000).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let before: f64 = gpu.timings().iter().map(|t| t.total_ms).sum();
    let fills = gpu.timings()[0].count;
    let start = std::time::Instant::now();
    let mut rec = gpu.record();
    rec.fill(y, 0);
    (0..3).for_each(|_| axpy(&mut rec, &k, x, y, 1.0));
    gpu.submit(rec).unwrap();
    let wall_ms = start.elapsed().as_secs_f64() * 1e3;
    let t = gpu.timings();
    assert_eq!(t.iter().map(|t| t.name).collect::<Vec<_>>(), ["fill", "report", "axpy"]);
    assert_eq!(t[0].count - fills, 1);
    if gpu.caps().timestamp_period_ns > 0.0 {
        assert_eq!(t[2].count, 3);
        assert!(t[2].total_ms > 0.0 && t[2].total_ms >= t[2].last_ms);
        let sum = t.iter().map(|t| t.total_ms).sum::<f64>() - before;
        assert!((sum - gpu.last_submit_ms()).abs() < 1e-6 * sum, "{sum} against {}", gpu.last_submit_ms());
    }
    assert!(gpu.last_submit_ms() > 0.0 && gpu.last_submit_ms() <= wall_ms);
    let rows = gpu.timings().to_vec();
    gpu.time_commands(0);
    let mut rec = gpu.record();
    (0..3).for_each(|_| axpy(&mut rec, &k, x, y, 1.0));
    gpu.submit(rec).unwrap();
    assert_eq!(gpu.timings(), rows);
    assert!(gpu.last_submit_ms() > 0.0);
}

#[test]
#[ignore = "prints times of submissions and transfers: cargo test --release --test gpu overhead_of_submissions_and_transfers -- --ignored --nocapture"]
fn overhead_of_submissions_and_transfers() {
    let mut gpu = Gpu::open_with(&GpuConfig::default(), 64 << 20, GpuOptions::default()).unwrap();
    let (x, y) = (gpu.alloc::<f32>("x", 4 << 20).unwrap(), gpu.alloc::<f32>("y", 4 << 20).unwrap());
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    println!("{}: {:?}", gpu.caps().name, gpu.caps());
    for (commands, each) in [(1, true), (10, true), (100, true), (1000, true), (1000, false)] {
        gpu.time_commands(u64::from(each));
        let mut record_ms = 0.0;
        let submit = median_ms(51, || {
            let start = Instant::now();
            let mut rec = gpu.record();
            (0..commands).for_each(|_| axpy(&mut rec, &k, x.part(0, 64), y.part(0, 64), 1.0));
            record_ms = start.elapsed().as_secs_f64() * 1e3;
            gpu.submit(rec).unwrap();
        });
        let device = gpu.last_submit_ms();
        println!("{commands} dependent dispatches (each timed: {each}): record and submit {submit:.3} ms, of it recording {record_ms:.3}, device {device:.3}");
    }
    let mut items = vec![0f32; 4 << 20];
    let up = median_ms(9, || gpu.upload(x, 0, &items).unwrap());
    let down = median_ms(9, || gpu.download(x, 0, &mut items).unwrap());
    let small = median_ms(51, || gpu.download(x, 0, &mut items[..16]).unwrap());
    println!("16 MiB up {up:.2} ms, down {down:.2} ms; 64 B down {small:.3} ms");
    let n = 4 << 20;
    let wide = median_ms(9, || {
        let mut rec = gpu.record();
        let bind = axpy::Bind { x: x.read(), y: y.read_write() };
        rec.dispatch(&k, bind, axpy::Push { n, a: 0.0 }, Threads::d1(n));
        gpu.submit(rec).unwrap();
    });
    let device = gpu.last_submit_ms();
    println!("axpy of {n}: {wide:.3} ms, device {device:.3}, {:.1} GB/s", 12.0 * f64::from(n) / device * 1e-6);
}
