//! Controls: what the tests of the public interface rely on to notice mistakes does notice them.
#![allow(clippy::unwrap_used)]

use super::kernel::{Access, KernelDef, Variant, BUFFERS_MAX, SPECS_MAX};
use super::kernels::axpy;
use super::memory::Range;
use super::*;

fn open() -> Gpu {
    Gpu::open_with(&GpuConfig::default(), 1 << 16, GpuOptions { validation: true }).unwrap()
}

#[test]
fn validation_reports_a_wrong_call() {
    let gpu = open();
    let info = vk::BufferCreateInfo::default().size(0).usage(vk::BufferUsageFlags::STORAGE_BUFFER);
    // SAFETY: deliberately invalid; the layer reports it, and the CPU device survives it.
    if let Ok(buffer) = unsafe { gpu.device.raw.create_buffer(&info, None) } {
        // SAFETY: just made.
        unsafe { gpu.device.raw.destroy_buffer(buffer, None) };
    }
    assert!(gpu.validation_messages().iter().any(|m| m.contains("VUID-VkBufferCreateInfo-size")));
}

#[test]
fn validation_names_kernels_and_reports_a_missing_barrier() {
    let mut gpu = open();
    let [x, y, z] = ["x", "y", "z"].map(|name| gpu.alloc::<f32>(name, 64).unwrap());
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    let mut rec = gpu.record();
    for (from, to) in [(x, y), (y, z)] {
        let bind = axpy::Bind { x: from.read(), y: to.read_write() };
        rec.dispatch(&k, bind, axpy::Push { n: 64, a: 1.0 }, Threads::d1(64));
    }
    assert!(rec.commands[1].barrier_before);
    rec.commands[1].barrier_before = false;
    gpu.submit(rec).unwrap();
    let said = gpu.validation_messages();
    assert!(said.iter().any(|m| m.contains("SYNC-HAZARD")), "{said:?}");
    assert!(said.iter().any(|m| m.contains("axpy")), "{said:?}");
}

#[test]
fn a_device_that_hangs_is_lost_and_closing_it_does_not_wait() {
    const N: usize = 1 << 20;
    let mut gpu = Gpu::open(&GpuConfig { submission_max_ms: 1e9, ..GpuConfig::default() }, 16 << 20).unwrap();
    let [x, y] = ["x", "y"].map(|name| gpu.alloc::<f32>(name, N).unwrap());
    let k = gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    gpu.submitter.hung_ns = 1;
    let mut rec = gpu.record();
    for _ in 0..200 {
        let bind = axpy::Bind { x: x.read(), y: y.read_write() };
        rec.dispatch(&k, bind, axpy::Push { n: N as u32, a: 1.0 }, Threads::d1(N as u32));
    }
    assert_eq!(gpu.submit(rec), Err(GpuError::Lost));
    assert_eq!(gpu.wait(), Err(GpuError::Lost));
    let closing = std::time::Instant::now();
    drop(gpu);
    assert!(closing.elapsed().as_millis() < 50, "{:?}", closing.elapsed());
}

/// A kernel that no driver takes.
struct Bad;

impl KernelDef for Bad {
    type Push = u32;
    type Spec = ();
    type Bind = ();
    const NAME: &'static str = "bad";
    const BINDINGS: &'static [(u32, Access)] = &[];
    const SPEC_IDS: &'static [u32] = &[];
    const VARIANTS: &'static [Variant] = &[Variant {
        define: "",
        name: "bad",
        spirv: b"bad",
        shared_bytes: 0,
        capabilities: &[],
        texels: [0; BUFFERS_MAX],
    }];

    fn local(_: &()) -> [u32; 3] {
        [1; 3]
    }

    fn spec_words(_: &()) -> [u32; SPECS_MAX] {
        [0; SPECS_MAX]
    }

    fn ranges(_: &()) -> [Range; BUFFERS_MAX] {
        unreachable!("it is never dispatched")
    }
}

#[test]
fn a_kernel_that_does_not_compile_is_a_fault_each_time_and_nothing_starts() {
    let mut gpu = open();
    gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    gpu.kernel::<Bad>(()).unwrap();
    for _ in 0..2 {
        assert!(gpu.compile().unwrap_err().to_string().contains("bad SPIR-V"));
        assert!(gpu.keep_pipelines().is_err());
        let rec = gpu.record();
        assert!(matches!(gpu.submit(rec), Err(GpuError::Vulkan { .. })));
    }
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
