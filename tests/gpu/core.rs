//! The Vulkan core: transfers, barriers, dispatches, capacities, and a validation layer with nothing to say.
//!
//! NVIDIA's driver can deadlock when threads that used it end while others of the process use it (seen with
//! an H200: a dozen devices opened by a dozen short-lived threads). Run it there with `--test-threads 1`.
#![allow(clippy::unwrap_used)]

#[path = "../../shaders-glsl/emit.rs"]
mod emit;
mod interface;
#[path = "../../shaders-glsl/reflect.rs"]
mod reflect;
mod timings;

use stipple::config::GpuConfig;
use stipple::gpu::kernels::{self, axpy, group_sum, layouts, types};
use stipple::gpu::{
    capability, Buf, Gpu, GpuError, GpuOptions, Kernel, Recorder, Threads, ALIGN, COMMANDS_MAX, REPORTS, STAGING_BYTES,
};
use stipple::mem;
use stipple_drivers::FaultKind;

#[global_allocator]
static ALLOCATOR: mem::CountingAllocator = mem::CountingAllocator;

/// A `Gpu` under validation that fails the test, on drop, if the layer said anything.
struct Silent(Gpu);

impl std::ops::Deref for Silent {
    type Target = Gpu;
    fn deref(&self) -> &Gpu {
        &self.0
    }
}

impl std::ops::DerefMut for Silent {
    fn deref_mut(&mut self) -> &mut Gpu {
        &mut self.0
    }
}

impl Drop for Silent {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            assert_eq!(self.0.validation_messages(), Vec::<String>::new());
        }
    }
}

fn open(arena_bytes: u64) -> Silent {
    Silent(Gpu::open_with(&GpuConfig::default(), arena_bytes, GpuOptions { validation: true }).unwrap())
}

fn floats(gpu: &mut Gpu, name: &'static str, items: &[f32]) -> Buf<f32> {
    let buf = gpu.alloc(name, items.len()).unwrap();
    gpu.upload(buf, 0, items).unwrap();
    buf
}

fn read<T: bytemuck::Pod>(gpu: &mut Gpu, buf: Buf<T>) -> Vec<T> {
    let mut items = vec![T::zeroed(); buf.len()];
    gpu.download(buf, 0, &mut items).unwrap();
    items
}

fn axpy(rec: &mut Recorder, k: &Kernel<axpy::K>, x: Buf<f32>, y: Buf<f32>, a: f32) {
    let n = x.len() as u32;
    rec.dispatch(k, axpy::Bind { x: x.read(), y: y.read_write() }, axpy::Push { n, a }, Threads::d1(n));
}

#[test]
fn arena_starts_as_zero_and_transfers_pass_the_staging_size() {
    let mut gpu = open(16 << 20);
    let n = STAGING_BYTES / 4 * 2 + 12345;
    let buf = gpu.alloc::<u32>("long", n).unwrap();
    assert!(read(&mut gpu, buf).iter().all(|&v| v == 0));
    let items: Vec<u32> = (0..n as u32).map(|i| i.wrapping_mul(2654435761)).collect();
    gpu.upload(buf, 0, &items).unwrap();
    assert_eq!(read(&mut gpu, buf), items);
    // In the middle, unaligned, and as bytes.
    gpu.upload(buf, 7, &[1, 2, 3]).unwrap();
    let mut out = [0; 5];
    gpu.download(buf, 6, &mut out).unwrap();
    assert_eq!(out, [items[6], 1, 2, 3, items[10]]);
    gpu.upload(buf.cast::<u8>(), 29, &[0xff]).unwrap();
    gpu.download(buf, 7, &mut out[..1]).unwrap();
    assert_eq!(out[0], 0xff01);
}

#[test]
fn uploads_that_gather_arrive_in_their_order() {
    let mut gpu = open(1 << 20);
    let buf = gpu.alloc::<u32>("words", 300).unwrap();
    // More than one submission holds, then one over several of them.
    (0..300u32).for_each(|i| gpu.upload(buf, i as usize, &[i]).unwrap());
    gpu.upload(buf, 100, &[7; 50]).unwrap();
    gpu.upload(buf, 120, &[8]).unwrap();
    let expected = |i: u32| {
        if i == 120 {
            8
        } else if (100..150).contains(&i) {
            7
        } else {
            i
        }
    };
    assert_eq!(read(&mut gpu, buf), (0..300).map(expected).collect::<Vec<_>>());
    // Parts come one after another, whatever their order in the arena.
    let mut bytes = [0u8; 12];
    let parts = [buf.part(299, 1), buf.part(120, 1), buf.part(3, 1)].map(|part| part.cast::<u8>());
    gpu.download_parts(parts.into_iter(), &mut bytes).unwrap();
    assert_eq!(bytemuck::cast_slice::<u8, u32>(&bytes), [299, 8, 3]);
    let refused = gpu.download_parts(parts.into_iter(), &mut bytes[..8]);
    assert_eq!(refused, Err(GpuError::OutOfRange { at: 0, len: 12, of: 8 }));
}

#[test]
fn transfers_outside_a_buffer_are_refused() {
    let mut gpu = open(1 << 16);
    let buf = gpu.alloc::<u32>("b", 10).unwrap();
    assert_eq!(gpu.upload(buf, 8, &[0; 3]), Err(GpuError::OutOfRange { at: 8, len: 3, of: 10 }));
    assert_eq!(
        gpu.download(buf, usize::MAX, &mut [0; 1]),
        Err(GpuError::OutOfRange { at: usize::MAX, len: 1, of: 10 })
    );
    gpu.upload(buf, 10, &[]).unwrap();
}

#[test]
fn chain_of_kernels_sees_what_came_before() {
    let mut gpu = open(1 << 20);
    let x = floats(&mut gpu, "x", &[1.0; 5000]);
    let [y, z, w] = ["y", "z", "w"].map(|name| gpu.alloc::<f32>(name, 5000).unwrap());
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let mut rec = gpu.record();
    let mut barriers = Vec::new();
    let mut note = |rec: &Recorder| barriers.push(rec.barriers());
    rec.fill(y, 2f32.to_bits());
    note(&rec);
    axpy(&mut rec, &k, x, y, 3.0); // y = 5: reads the fill
    note(&rec);
    axpy(&mut rec, &k, x, z, 1.0); // z = 1: shares only x, which both read
    note(&rec);
    axpy(&mut rec, &k, y, z, 2.0); // z = 11: reads y, adds to z
    note(&rec);
    rec.fill(w, 0); // w = 0: shares nothing
    note(&rec);
    axpy(&mut rec, &k, z, w, 1.0); // w = 11: reads z and the fill
    note(&rec);
    rec.fill(y, 0); // y = 0: the last barrier is after the kernel that reads it
    note(&rec);
    rec.fill(z, 0); // z = 0: the last kernel reads it
    note(&rec);
    gpu.submit(rec).unwrap();
    assert_eq!(barriers, [0, 1, 1, 2, 2, 3, 3, 4]);
    assert_eq!(read(&mut gpu, w), [11.0; 5000]);
    assert_eq!(read(&mut gpu, y), [0.0; 5000]);
    assert_eq!(read(&mut gpu, z), [0.0; 5000]);
}

#[test]
fn disjoint_parts_of_a_buffer_need_no_barrier() {
    let mut gpu = open(1 << 16);
    let buf = gpu.alloc::<f32>("b", 1024).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let quarter = |i: usize| buf.part(256 * i, 256);
    let mut rec = gpu.record();
    (0..4).for_each(|i| rec.fill(quarter(i), (i as f32).to_bits()));
    assert_eq!(rec.barriers(), 0);
    axpy(&mut rec, &k, quarter(1), quarter(0), 1.0);
    axpy(&mut rec, &k, quarter(3), quarter(2), 1.0);
    assert_eq!(rec.barriers(), 1);
    gpu.submit(rec).unwrap();
    assert_eq!(read(&mut gpu, buf).chunks(256).map(|c| c[9]).collect::<Vec<_>>(), [1.0, 1.0, 5.0, 3.0]);
}

/// Random programs of fills and kernels over parts of one buffer leave what a sequential CPU
/// leaves, and synchronisation validation finds no hazard in them.
#[test]
fn random_recordings_match_sequential_execution() {
    const PARTS: usize = 6;
    const LEN: usize = 64;
    let mut gpu = open(1 << 20);
    let all = gpu.alloc::<f32>("all", PARTS * LEN).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let mut twin = vec![0f32; PARTS * LEN];
    let mut state = 1u32;
    let mut random = |n: u32| {
        state = state.wrapping_mul(1664525).wrapping_add(1013904223);
        (state >> 16) % n
    };
    for _ in 0..20 {
        let mut rec = gpu.record();
        for _ in 0..60 {
            let (i, j) = (random(PARTS as u32) as usize, random(PARTS as u32 - 1) as usize);
            let j = if j >= i { j + 1 } else { j };
            let (from, to) = (all.part(i * LEN, LEN), all.part(j * LEN, LEN));
            let source = twin[i * LEN..][..LEN].to_vec();
            let target = &mut twin[j * LEN..][..LEN];
            match random(3) {
                0 => {
                    let value = random(100) as f32;
                    rec.fill(to, value.to_bits());
                    target.fill(value);
                }
                _ => {
                    axpy(&mut rec, &k, from, to, 0.5);
                    target.iter_mut().zip(&source).for_each(|(y, x)| *y += 0.5 * x);
                }
            }
        }
        gpu.submit(rec).unwrap();
        assert_eq!(read(&mut gpu, all), twin);
    }
}

#[test]
fn a_device_opens_as_often_as_it_is_lost() {
    (0..60).for_each(|_| drop(open(1 << 16)));
}

#[test]
fn rows_past_65535_groups_wrap() {
    assert_eq!(Threads::d1(64 * 65535).workgroups([64, 1, 1]), Some([65535, 1, 1]));
    let n = 64 * 65535 + 100;
    assert_eq!(Threads::d1(n as u32).workgroups([64, 1, 1]), Some([32769, 2, 1]));
    assert_eq!(Threads::d1(u32::MAX).workgroups([1, 1, 1]), None);
    assert_eq!(Threads::d2(17, 9).workgroups([8, 4, 1]), Some([3, 3, 1]));
    assert_eq!(Threads::d2(70000, 2).workgroups([1, 1, 1]), None);
    assert_eq!(Threads::groups(70000, 1, 1).workgroups([64, 1, 1]), Some([35000, 2, 1]));
    let mut gpu = open(40 << 20);
    let (x, y) = (gpu.alloc::<f32>("x", n).unwrap(), gpu.alloc::<f32>("y", n).unwrap());
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let mut rec = gpu.record();
    rec.fill(x, 1f32.to_bits());
    axpy(&mut rec, &k, x, y, 2.0);
    gpu.submit(rec).unwrap();
    assert!(read(&mut gpu, y).iter().all(|&v| v == 2.0));
}

#[test]
fn push_and_specialisation_constants_arrive_in_every_type() {
    let mut gpu = open(1 << 16);
    let out = gpu.alloc::<types::Wide>("out", 8).unwrap();
    let totals = gpu.alloc::<types::Totals>("totals", 1).unwrap();
    let spare = [0.0, 0.0, 0.0, 0.0, 100.0];
    gpu.upload(totals, 0, &[types::Totals { half_sum: [0.25, 0.75], count: 9, spare }]).unwrap();
    let defaults = layouts::Spec::default();
    assert_eq!(defaults, layouts::Spec { width: 8, scale: 0.5, offset: -3, flip: true });
    let inner = types::Inner { v: [1.0, 2.0, 3.0, 4.0], i: [-5, 6], u: [7, 8] };
    let m = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [9.0; 4], [0.5; 4]];
    let push = layouts::Push { m, inner, c: [1.0, 2.0, 3.0], d: -11, b: [12, 13] };
    let narrow = layouts::Spec { width: 4, scale: 3.0, offset: -70, flip: false };
    for (spec, a) in [(defaults, [0.5, 1.0, 1.5, 2.0]), (narrow, [3.0, 6.0, 9.0, 12.0])] {
        let k = gpu.kernel::<layouts::K>(spec).unwrap();
        let mut rec = gpu.record();
        let bind = layouts::Bind { wide_out: out.write(), totals: totals.read() };
        rec.fill(out, 0);
        rec.dispatch(&k, bind, push, Threads::d2(4, 2));
        gpu.submit(rec).unwrap();
        let expected = types::Wide {
            m,
            a,
            b: [0.25, 0.75],
            c: 103.0,
            d: 9,
            e: [-11, spec.offset, spec.flip as i32],
            group_width: spec.width,
            inner: types::Inner { v: [4.0, 3.0, 2.0, 1.0], i: [6, -5], u: [8, 7] },
            f: [-5, 6, -1, -2],
            g: [12, 13, 1, 2],
        };
        // A group is width x 2; with 4 threads asked for in a row, both widths run one group.
        let written = 2 * spec.width as usize;
        let all = read(&mut gpu, out);
        assert!(all[..written.min(8)].iter().all(|w| *w == expected), "{:?}", all[0]);
    }
}

#[test]
fn variants_agree_and_are_taken_by_the_device() {
    let mut gpu = open(1 << 16);
    let items: Vec<u32> = (0..1024).map(|i| i * i % 977).collect();
    let buf = gpu.alloc("items", 1024).unwrap();
    gpu.upload(buf, 0, &items).unwrap();
    let sums = gpu.alloc::<u32>("sums", 4).unwrap();
    let expected: Vec<u32> = items.chunks(256).map(|c| c.iter().sum()).collect();
    for variant in ["", "subgroup"] {
        if variant == "subgroup" && !gpu.caps().allows(capability::GROUP_ARITHMETIC) {
            continue;
        }
        let k = gpu.kernel_variant::<group_sum::K>(group_sum::Spec {}, variant).unwrap();
        let mut rec = gpu.record();
        rec.dispatch(&k, group_sum::Bind { items: buf.read(), sums: sums.write() }, (), Threads::d1(1024));
        gpu.submit(rec).unwrap();
        assert_eq!(read(&mut gpu, sums), expected, "variant {variant:?}");
    }
    let taken = gpu.kernel::<group_sum::K>(group_sum::Spec {}).unwrap().name();
    assert_eq!(taken, if gpu.caps().allows(capability::GROUP_ARITHMETIC) { "group_sum_subgroup" } else { "group_sum" });
    let config = GpuConfig { subgroups: false, ..Default::default() };
    let mut plain = Gpu::open(&config, 1 << 16).unwrap();
    assert_eq!(plain.kernel::<group_sum::K>(group_sum::Spec {}).unwrap().name(), "group_sum");
    assert_eq!(
        plain.kernel_variant::<group_sum::K>(group_sum::Spec {}, "subgroup").map(|_| ()).unwrap_err().kind,
        FaultKind::Unavailable
    );
}

#[test]
fn full_arena_is_a_fault_that_names_the_buffer() {
    let mut gpu = open(4 * ALIGN);
    gpu.alloc::<u8>("one", 1).unwrap();
    gpu.alloc::<[f32; 4]>("two", 17).unwrap();
    assert_eq!(gpu.arena_used(), 3 * ALIGN);
    let fault = gpu.alloc::<u32>("splats", 65).unwrap_err();
    assert_eq!(fault.kind, FaultKind::Config);
    assert!(fault.to_string().contains("splats") && fault.to_string().contains("[budget]"), "{fault}");
    gpu.alloc::<u32>("fits", 64).unwrap();
    assert!(gpu.alloc::<u32>("nothing", 0).is_err());
    assert!(gpu.alloc::<[u32; 4]>("overflow", usize::MAX / 2).is_err());
    let rows: Vec<_> = gpu.arena().footprint().rows.iter().map(|r| (r.name, r.bytes)).collect();
    assert_eq!(rows, [("one", 256), ("two", 512), ("fits", 256)]);
    assert!(Gpu::open(&GpuConfig::default(), u64::MAX / 2).is_err());
}

#[test]
fn buffer_larger_than_a_binding_is_a_fault() {
    let mut gpu = Gpu::open(&GpuConfig::default(), 1 << 12).unwrap();
    let most = gpu.caps().binding_max_bytes;
    let fault = gpu.alloc::<u8>("intersections", most as usize + 1).unwrap_err();
    assert!(fault.what.contains("at once"), "{fault}");
}

#[test]
fn wrong_recordings_are_errors_and_the_next_one_runs() {
    let mut gpu = open(1 << 16);
    let x = floats(&mut gpu, "x", &[1.0; 256]);
    let y = gpu.alloc::<f32>("y", 256).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let mut rec = gpu.record();
    (0..=COMMANDS_MAX).for_each(|_| rec.fill(y, 0));
    assert_eq!(gpu.submit(rec), Err(GpuError::RecordingFull));
    let mut rec = gpu.record();
    axpy(&mut rec, &k, x.part(1, 8), y, 1.0);
    assert!(matches!(gpu.submit(rec), Err(GpuError::Binding { kernel: "axpy", .. })));
    let mut rec = gpu.record();
    axpy(&mut rec, &k, x.part(0, 0), y, 1.0); // no threads
    let bind = axpy::Bind { x: x.part(0, 0).read(), y: y.read_write() };
    rec.dispatch(&k, bind, axpy::Push { n: 0, a: 0.0 }, Threads::d1(1));
    assert!(matches!(gpu.submit(rec), Err(GpuError::Binding { kernel: "axpy", .. })));
    let mut rec = gpu.record();
    rec.dispatch(
        &k,
        axpy::Bind { x: x.read(), y: y.read_write() },
        axpy::Push { n: 1, a: 0.0 },
        Threads::d2(1, 1 << 20),
    );
    assert_eq!(gpu.submit(rec), Err(GpuError::Groups { kernel: "axpy" }));
    let mut rec = gpu.record();
    rec.fill(y.cast::<u8>().part(1, 4), 0);
    assert!(matches!(gpu.submit(rec), Err(GpuError::Binding { kernel: "fill", .. })));
    // A buffer of a larger arena is refused by a smaller one.
    let foreign = open(1 << 20).alloc::<f32>("foreign", 1 << 16).unwrap();
    let mut rec = gpu.record();
    rec.fill(foreign, 0);
    assert!(matches!(gpu.submit(rec), Err(GpuError::Binding { kernel: "fill", .. })));
    let empty = gpu.record();
    gpu.submit(empty).unwrap();
    let mut rec = gpu.record();
    axpy(&mut rec, &k, x, y, 4.0);
    gpu.submit(rec).unwrap();
    assert_eq!(read(&mut gpu, y), [4.0; 256]);
}

#[test]
fn more_bindings_than_remembered_still_run() {
    let mut gpu = open(4 << 20);
    let x = floats(&mut gpu, "x", &[1.0; 64]);
    let y = gpu.alloc::<f32>("y", 64 * 3000).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    for batch in 0..3 {
        let mut rec = gpu.record();
        for i in 0..1000 {
            axpy(&mut rec, &k, x, y.part(64 * (1000 * batch + i), 64), 1.0);
        }
        assert_eq!(rec.barriers(), 0);
        gpu.submit(rec).unwrap();
    }
    assert!(read(&mut gpu, y).iter().all(|&v| v == 1.0));
}

#[test]
fn submission_without_waiting_is_waited_for_by_what_follows() {
    let mut gpu = open(1 << 20);
    let x = floats(&mut gpu, "x", &[1.0; 1000]);
    let y = gpu.alloc::<f32>("y", 1000).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    for _ in 0..5 {
        let mut rec = gpu.record();
        axpy(&mut rec, &k, x, y, 1.0);
        gpu.start(rec).unwrap();
    }
    assert_eq!(read(&mut gpu, y), [5.0; 1000]);
    gpu.wait().unwrap();
    let mut rec = gpu.record();
    axpy(&mut rec, &k, x, y, 1.0);
    gpu.start(rec).unwrap();
    // Dropped with work in flight.
}

#[test]
fn reports_stay_until_the_next_to_their_place() {
    let mut gpu = open(1 << 20);
    let x = floats(&mut gpu, "x", &[1.0; 64]);
    let y = gpu.alloc::<f32>("y", 64).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let start = |gpu: &mut Gpu, place: usize| {
        let mut rec = gpu.record();
        axpy(&mut rec, &k, x, y, 1.0);
        rec.report(y.part(0, 4), place);
        gpu.start(rec)
    };
    let tickets: Vec<_> = (0..5).map(|i| start(&mut gpu, i % REPORTS).unwrap()).collect();
    let mut seen = [0f32; 4];
    gpu.report(tickets[4], 4 % REPORTS, &mut seen).unwrap();
    assert_eq!(seen, [5.0; 4]);
    assert!(read(&mut gpu, y).iter().all(|&v| v == 5.0));
    gpu.report(tickets[3], 3 % REPORTS, &mut seen).unwrap();
    assert_eq!(seen, [4.0; 4]);
    assert!(matches!(start(&mut gpu, REPORTS), Err(GpuError::Binding { .. })));
    assert!(matches!(gpu.report(tickets[4], 0, &mut [0u32; 100]), Err(GpuError::OutOfRange { .. })));
}

#[test]
fn steady_state_allocates_nothing() {
    let mut gpu = Gpu::open_with(&GpuConfig::default(), 1 << 20, GpuOptions::default()).unwrap();
    let x = floats(&mut gpu, "x", &[1.0; 1000]);
    let y = gpu.alloc::<f32>("y", 1000).unwrap();
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    gpu.compile().unwrap();
    let mut items = [0f32; 1000];
    let before = mem::heap_after_seal();
    let gpu = std::thread::spawn(move || {
        mem::seal_thread();
        for _ in 0..10 {
            let mut rec = gpu.record();
            rec.fill(y, 0);
            axpy(&mut rec, &k, x, y, 1.0);
            gpu.submit(rec).unwrap();
            for place in 0..REPORTS {
                let mut rec = gpu.record();
                axpy(&mut rec, &k, x, y, 1.0);
                rec.report(y.part(0, 4), place);
                gpu.start(rec).unwrap();
            }
            gpu.upload(x, 0, &items).unwrap();
            gpu.download(y, 0, &mut items).unwrap();
        }
        let after = mem::heap_after_seal();
        mem::unsealed(|| (gpu, after))
    });
    let (_gpu, after) = gpu.join().unwrap();
    assert_eq!(after - before, 0);
}

#[test]
fn absent_device_is_a_fault_that_lists_what_there_is() {
    let config = GpuConfig { device: "no such GPU".into(), ..Default::default() };
    let fault = Gpu::open(&config, 1 << 16).map(|_| ()).unwrap_err();
    assert_eq!((fault.kind, fault.place.as_str()), (FaultKind::Unavailable, "gpu.device"));
    let name = Gpu::open(&GpuConfig::default(), 1 << 16).unwrap().caps().name.clone();
    assert!(fault.fix.contains(&name), "{fault}");
    let by_name = GpuConfig { device: name[1..5].to_uppercase(), ..Default::default() };
    assert!(Gpu::open(&by_name, 1 << 16).unwrap().caps().name.contains(&name[1..5]));
}

#[test]
fn every_kernel_fits_the_baseline() {
    // The `Shader` and `GroupNonUniform` capabilities: no subgroup arithmetic, float atomics, int64 or fp16.
    const ALLOWED: [u32; 2] = [1, 61];
    let baseline: Vec<_> = kernels::ALL.iter().filter(|k| k.baseline).collect();
    assert!(baseline.len() >= 4);
    for k in baseline {
        assert!(k.local.iter().product::<u32>() <= 256, "{}: {:?} invocations", k.name, k.local);
        assert!(k.shared_bytes <= 16 << 10, "{}: {} B shared", k.name, k.shared_bytes);
        assert!(k.buffers <= 8, "{}: {} buffers", k.name, k.buffers);
        assert!(k.push_bytes <= 128, "{}: {} B of push constants", k.name, k.push_bytes);
        assert!(k.capabilities.iter().all(|c| ALLOWED.contains(c)), "{}: capabilities {:?}", k.name, k.capabilities);
    }
}

#[test]
fn long_recording_is_several_submissions_with_the_same_result() {
    let chain = |submission_max_ms: f64| {
        let config = GpuConfig { submission_max_ms, ..GpuConfig::default() };
        let mut gpu = Silent(Gpu::open_with(&config, 1 << 16, GpuOptions { validation: true }).unwrap());
        let (x, y) = (floats(&mut gpu, "x", &[1.0; 1000]), floats(&mut gpu, "y", &[0.0; 1000]));
        let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
        let before = gpu.submissions();
        for _ in 0..2 {
            let mut rec = gpu.record();
            for a in 1..=20 {
                let bind = axpy::Bind { x: x.read(), y: y.read_write() };
                rec.dispatch(&k, bind, axpy::Push { n: 1000, a: a as f32 }, Threads::d1(1000));
            }
            gpu.submit(rec).unwrap();
        }
        (gpu.submissions() - before, read(&mut gpu, y))
    };
    let (whole, parts) = (chain(1e6), chain(1e-9));
    assert_eq!(whole.0, 2);
    // The first recording is timed, from then on every command is a part of its own.
    assert!(parts.0 >= 21, "{}", parts.0);
    assert_eq!(whole.1, vec![420.0; 1000]);
    assert_eq!(whole.1, parts.1);
}
