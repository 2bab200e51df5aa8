//! Radix sort and prefix sum against their CPU twins, bit for bit.

use stipple::gpu::{Buf, Gpu};
use stipple::map::sort::{Buffers, Cut, Pairs, Scan, Sorter, CPU, GPU, NONE};

const CAPACITY: usize = 40_000;

/// Twin of `Sorter::record`, passes of radix_count.comp and radix_scatter.comp or of share_count.comp and share_scatter.comp: a stable sort of the first `count` keys that are not NONE by the low `bits`.
fn sorted(keys: &[u32], count: usize, bits: u32) -> (Vec<u32>, Vec<u32>) {
    let n = count.min(keys.len());
    let mask = u32::MAX >> (32 - bits);
    let mut order: Vec<u32> = (0..n as u32).filter(|&i| keys[i as usize] != NONE).collect();
    order.sort_by_key(|&i| keys[i as usize] & mask);
    (order.iter().map(|&i| keys[i as usize]).collect(), order)
}

/// Twin of `Scan::record`, scan_reduce.comp and scan_apply.comp, on the first `count`.
fn scanned(data: &[u32], count: usize) -> Vec<u32> {
    let mut sum = 0u32;
    let mut out = data.to_vec();
    for v in out.iter_mut().take(count) {
        (*v, sum) = (sum, sum.wrapping_add(*v));
    }
    out
}

fn noise(seed: u32, n: usize) -> Vec<u32> {
    let mut s = seed;
    (0..n)
        .map(|_| {
            s ^= s << 13;
            s ^= s >> 17;
            s ^= s << 5;
            s
        })
        .collect()
}

struct Rig {
    gpu: Gpu,
    sorter: Sorter,
    scan: Scan,
    pairs: Pairs,
    spare: Pairs,
    count: Buf<u32>,
    sorted: Buf<u32>,
}

impl Rig {
    fn new(capacity: usize) -> Rig {
        Rig::cut(capacity, None)
    }

    fn cut(capacity: usize, cut: Option<Cut>) -> Rig {
        let mut gpu = Gpu::open(&crate::config(), (capacity as u64) * 16 + (2 << 20)).expect("a Vulkan device");
        let buffers = Buffers::new(gpu.arena()).unwrap();
        let cut = cut.unwrap_or_else(|| Cut::of(gpu.caps()));
        let sorter = Sorter::new(&mut gpu, &buffers, cut).unwrap();
        let scan = Scan::new(&mut gpu, &buffers).unwrap();
        let mut pairs =
            || Pairs { keys: gpu.alloc("keys", capacity).unwrap(), payload: gpu.alloc("payload", capacity).unwrap() };
        let (pairs, spare) = (pairs(), pairs());
        let (count, sorted) = (gpu.alloc("count", 1).unwrap(), gpu.alloc("sorted", 1).unwrap());
        Rig { gpu, sorter, scan, pairs, spare, count, sorted }
    }

    /// Sorts `keys[..count]`, with their indices; milliseconds on the device beside it.
    fn sort(&mut self, keys: &[u32], count: u32, bits: u32) -> (Vec<u32>, Vec<u32>, f64) {
        self.gpu.upload(self.pairs.keys, 0, keys).unwrap();
        self.gpu.upload(self.count, 0, &[count]).unwrap();
        let mut rec = self.gpu.record();
        let at = self.sorter.record(&mut rec, (self.pairs, self.spare), self.count, self.sorted, bits);
        self.gpu.submit(rec).unwrap();
        let ms = self.gpu.last_submit_ms();
        let mut n = [0];
        self.gpu.download(self.sorted, 0, &mut n).unwrap();
        let n = n[0] as usize;
        let (mut k, mut p) = (vec![0; n], vec![0; n]);
        self.gpu.download(at.keys, 0, &mut k).unwrap();
        self.gpu.download(at.payload, 0, &mut p).unwrap();
        (k, p, ms)
    }

    fn check(&mut self, what: &str, keys: &[u32], count: u32, bits: u32) {
        let (k, p, _) = self.sort(keys, count, bits);
        let twin = sorted(keys, count as usize, bits);
        assert!((k, p) == twin, "{what}, {count} keys of {bits} bits");
    }
}

#[test]
fn sort_is_stable_and_equals_its_twin_as_cut_for_either_kind_of_device() {
    [CPU, GPU].into_iter().for_each(sort_equals_its_twin);
}

fn sort_equals_its_twin(cut: Cut) {
    let mut rig = Rig::cut(CAPACITY, Some(cut));
    for count in [0, 1, 31, 32, 33, 255, 256, 257, 1023, 1024, 1025, 10_000, CAPACITY] {
        let keys = noise(count as u32 + 1, count);
        for bits in [1, 8, 11, 12, 16, 22, 31, 32] {
            rig.check("noise", &keys, count as u32, bits);
        }
    }
    let n = CAPACITY as u32;
    rig.check("equal", &vec![7; CAPACITY], n, 11);
    rig.check("few values", &noise(3, CAPACITY).iter().map(|k| k % 3).collect::<Vec<_>>(), n, 11);
    rig.check("sorted", &(0..n).collect::<Vec<_>>(), n, 16);
    rig.check("reversed", &(0..n).rev().collect::<Vec<_>>(), n, 16);
    rig.check(
        "extremes",
        &noise(4, CAPACITY).iter().map(|k| if k & 1 == 0 { 0 } else { u32::MAX }).collect::<Vec<_>>(),
        n,
        32,
    );
}

#[test]
fn count_on_the_device_bounds_the_sort() {
    let mut rig = Rig::new(CAPACITY);
    let keys = noise(9, CAPACITY);
    rig.check("part", &keys, 12_345, 16);
    rig.check("more than there is room for", &keys, CAPACITY as u32 + 1000, 16);
    let (_, _, _) = rig.sort(&keys, 5000, 16);
    let mut rest = vec![0; CAPACITY - 5000];
    rig.gpu.download(rig.pairs.keys, 5000, &mut rest).unwrap();
    assert_eq!(rest, keys[5000..], "pairs past the count are left alone");
}

#[test]
fn keys_left_out_make_the_sorted_list_shorter() {
    let mut rig = Rig::new(CAPACITY);
    let keys: Vec<u32> = noise(7, CAPACITY).iter().map(|k| if k % 3 == 0 { NONE } else { k >> 16 }).collect();
    rig.check("some", &keys, CAPACITY as u32, 16);
    rig.check("all", &[NONE; 5000], 5000, 16);
}

#[test]
fn scan_equals_its_twin() {
    let n = 300_000;
    let mut rig = Rig::new(n);
    let data = noise(5, n); // wraps around many times
    for count in [1, 15, 16, 17, 4095, 4096, 4097, 65_537, 70_001, n] {
        rig.gpu.upload(rig.pairs.keys, 0, &data).unwrap();
        let mut rec = rig.gpu.record();
        rig.scan.record(&mut rec, rig.pairs.keys.part(0, count));
        rig.gpu.submit(rec).unwrap();
        let mut out = vec![0; n];
        rig.gpu.download(rig.pairs.keys, 0, &mut out).unwrap();
        assert!(out == scanned(&data, count), "{count}");
    }
}
