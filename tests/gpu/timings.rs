//! Times that the core tells of its commands.

use super::{axpy, floats, open};

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
