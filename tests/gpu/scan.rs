//! Prefix sum against its CPU twin, bit for bit.

use super::splat::Rng;
use stipple::gpu::Gpu;
use stipple::map::scan::{Buffers, Scan};

/// Twin of `Scan::record`, scan_reduce.comp and scan_apply.comp, on the first `count`.
fn scanned(data: &[u32], count: usize) -> Vec<u32> {
    let mut sum = 0u32;
    let mut out = data.to_vec();
    for v in out.iter_mut().take(count) {
        (*v, sum) = (sum, sum.wrapping_add(*v));
    }
    out
}

#[test]
fn scan_equals_its_twin() {
    let n = 300_000;
    let mut gpu = Gpu::open(&crate::config(), 4 * n as u64 + (1 << 16)).unwrap();
    let buffers = Buffers::new(gpu.arena()).unwrap();
    let scan = Scan::new(&mut gpu, &buffers).unwrap();
    let on_gpu = gpu.alloc("data", n).unwrap();
    let mut r = Rng(5);
    let data: Vec<u32> = (0..n).map(|_| r.uniform(0.0, 4294967296.0) as u32).collect(); // wraps around many times
    for count in [1, 15, 16, 17, 4095, 4096, 4097, 65_537, 70_001, n] {
        gpu.upload(on_gpu, 0, &data).unwrap();
        let mut rec = gpu.record();
        scan.record(&mut rec, on_gpu.part(0, count));
        gpu.submit(rec).unwrap();
        let mut out = vec![0; n];
        gpu.download(on_gpu, 0, &mut out).unwrap();
        assert!(out == scanned(&data, count), "{count}");
    }
}
