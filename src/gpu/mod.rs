//! Raw Vulkan compute: one device, one arena, pipelines, recordings. No engine.
//!
//! The kernels of shaders-glsl/ are Rust modules here (`kernels::<file stem>`): `Bind` has one field a buffer
//! block, named after the block (or its instance), `Push` is the push block, `Spec` the specialisation
//! constants. Layouts come from the SPIR-V, so host and shader cannot disagree.
//!
//! ```
//! use stipple::gpu::{kernels::axpy, Gpu, Threads};
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let mut gpu = Gpu::open(&Default::default(), 1 << 20)?;       // device, 1 MiB arena
//! let (x, y) = (gpu.alloc::<f32>("x", 1000)?, gpu.alloc::<f32>("y", 1000)?);
//! let k = gpu.kernel::<axpy::K>(axpy::Spec::default())?;         // pipeline
//! gpu.upload(x, 0, &[2.0; 1000])?;
//! let mut rec = gpu.record();
//! rec.fill(y, 1f32.to_bits());
//! rec.dispatch(&k, axpy::Bind { x: x.read(), y: y.read_write() }, axpy::Push { n: 1000, a: 3.0 }, Threads::d1(1000));
//! gpu.submit(rec)?;                                              // the barrier between the two is inserted
//! let mut out = [0f32; 1000];
//! gpu.download(y, 0, &mut out)?;
//! assert_eq!(out, [7.0; 1000]);
//! # Ok(()) }
//! ```
//!
//! A buffer that the shader writes cannot be bound as one it reads:
//! ```compile_fail
//! use stipple::gpu::{kernels::axpy, Buf};
//! fn bind(x: Buf<f32>, y: Buf<f32>) -> axpy::Bind { axpy::Bind { x: x.read(), y: y.read() } }
//! ```
//! nor one of another type, nor none at all:
//! ```compile_fail
//! use stipple::gpu::{kernels::axpy, Buf};
//! fn bind(x: Buf<u32>, y: Buf<f32>) -> axpy::Bind { axpy::Bind { x: x.read(), y: y.read_write() } }
//! ```
#![allow(unsafe_code)]

mod cache;
mod copies;
mod device;
mod kernel;
pub mod kernels;
mod memory;
mod pieces;
mod record;
mod submit;
#[cfg(test)]
mod tests;

pub use cache::cache_folder;
pub use device::{capability, Caps, DeviceKind};
pub use kernel::{Access, Kernel, KernelDef, Reflected, Variant, BUFFERS_MAX, SPECS_MAX};
pub use memory::{Arena, Buf, Range, Read, ReadWrite, Write, ALIGN, REPORTS, REPORT_BYTES};
pub use record::{Recorder, Threads};
pub use submit::{Ticket, Timing};
#[cfg(feature = "instruments")]
pub use {kernel::PUSH_MAX, memory::STAGING_BYTES, record::GROUPS_MAX};

use crate::config::GpuConfig;
use ash::vk;
use cache::PipelineCache;
use copies::Copies;
use device::Device;
use kernel::Pipelines;
use memory::{arena_buffer, report_offset, Backed, Staging, TRANSFER_BYTES};
use std::fmt;
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::Arc;
use stipple_drivers::{Fault, FaultKind};
use submit::Submitter;

/// Commands that one recording holds.
pub const COMMANDS_MAX: usize = 1024;

/// What can go wrong after boot. Plain data: making one allocates nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuError {
    /// A Vulkan call failed with this code.
    Vulkan { call: &'static str, code: i32 },
    /// The device is gone, or hung; every later call says so too.
    Lost,
    /// More commands than one recording holds.
    RecordingFull,
    /// Elements outside a buffer.
    OutOfRange { at: usize, len: usize, of: usize },
    /// Bytes that cannot be bound: unaligned, empty, overlapping, or more than a binding takes.
    Binding { kernel: &'static str, start: u64, end: u64 },
    /// More workgroups than a dispatch takes.
    Groups { kernel: &'static str },
}

impl GpuError {
    fn of(call: &'static str) -> impl Fn(vk::Result) -> GpuError {
        move |r| match r {
            vk::Result::ERROR_DEVICE_LOST | vk::Result::TIMEOUT => GpuError::Lost,
            _ => GpuError::Vulkan { call, code: r.as_raw() },
        }
    }
}

impl fmt::Display for GpuError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            GpuError::Vulkan { call, code } => write!(f, "{call} failed: {}", vk::Result::from_raw(*code)),
            GpuError::Lost => write!(f, "the Vulkan device is lost or hangs"),
            GpuError::RecordingFull => write!(f, "more than {COMMANDS_MAX} commands in one recording"),
            GpuError::OutOfRange { at, len, of } => write!(f, "elements {at}+{len} of a buffer of {of}"),
            GpuError::Binding { kernel, start, end } => write!(f, "{kernel}: cannot use arena bytes {start}..{end}"),
            GpuError::Groups { kernel } => write!(f, "{kernel}: too many workgroups"),
        }
    }
}

impl std::error::Error for GpuError {}

impl From<GpuError> for Fault {
    fn from(e: GpuError) -> Fault {
        Fault::new(FaultKind::Unavailable, "gpu", e.to_string(), "see the counters of the report and the kernel log")
    }
}

/// How a device is opened, beside the board's `[gpu]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GpuOptions {
    /// Khronos validation with synchronisation checks; `Gpu::validation_messages` collects what it says.
    pub validation: bool,
}

/// Words of a submission that clears the arena: 16 MiB, 4 ms at 4 GB/s, the memory of the slowest boards.
const CLEARED_AT_ONCE: usize = 4 << 20;

/// A Vulkan device with its arena and pipelines. One thread at a time uses it.
pub struct Gpu {
    submitter: Submitter,
    pipelines: Pipelines,
    staging: Staging,
    /// Uploads that wait in staging.
    uploads: Copies,
    /// What the arena hands out.
    memory: Backed,
    arena: Arena,
    /// The recording's memory while nobody records.
    spare: Option<Recorder>,
    lost: bool,
    device: Arc<Device>,
}

const _: () = {
    const fn is_send<T: Send>() {}
    is_send::<Gpu>()
};

impl Gpu {
    /// Opens the device `config` names with an arena of `arena_bytes`, all zero. `STIPPLE_VALIDATION=1` in
    /// the environment turns validation on; what it said is printed when the device is closed.
    pub fn open(config: &GpuConfig, arena_bytes: u64) -> Result<Gpu, Fault> {
        let validation = std::env::var_os("STIPPLE_VALIDATION").is_some_and(|v| v == "1");
        Gpu::open_with(config, arena_bytes, GpuOptions { validation })
    }

    pub fn open_with(config: &GpuConfig, arena_bytes: u64, options: GpuOptions) -> Result<Gpu, Fault> {
        let device = Arc::new(Device::open(config, options.validation)?);
        let staging = Staging::new(&device)?;
        let arena_bytes = arena_bytes.next_multiple_of(ALIGN).max(ALIGN);
        let mut gpu = Gpu {
            submitter: Submitter::new(&device, staging.buffer(), config.submission_max_ms)?,
            pipelines: Pipelines::new(&device)?,
            staging,
            uploads: Copies::default(),
            memory: arena_buffer(&device, arena_bytes)?,
            arena: Arena::new(arena_bytes, device.caps.binding_max_bytes),
            spare: Some(Recorder::new()),
            lost: false,
            device,
        };
        let whole = gpu.arena.whole();
        for at in (0..whole.len()).step_by(CLEARED_AT_ONCE) {
            let mut rec = gpu.record();
            rec.fill(whole.part(at, CLEARED_AT_ONCE.min(whole.len() - at)), 0);
            gpu.submit(rec)?;
        }
        Ok(gpu)
    }

    pub fn caps(&self) -> &Caps {
        &self.device.caps
    }

    /// Where buffers are taken from, at boot.
    pub fn arena(&mut self) -> &mut Arena {
        &mut self.arena
    }

    /// Takes `len` elements from the arena.
    #[cfg(feature = "instruments")]
    pub fn alloc<T: bytemuck::Pod>(&mut self, name: &'static str, len: usize) -> Result<Buf<T>, Fault> {
        self.arena.alloc(name, len)
    }

    /// Takes from `folder` what the driver compiled in earlier runs, for the kernels compiled from now on; how many bytes there were.
    pub fn reuse_pipelines(&mut self, folder: &Path) -> usize {
        self.pipelines.cache = PipelineCache::open(&self.device, folder).ok();
        self.pipelines.cache.as_ref().map_or(0, |c| c.taken)
    }

    /// Compiles the kernels made so far; those made later are compiled when a recording is started.
    pub fn compile(&mut self) -> Result<(), Fault> {
        self.pipelines.compile()
    }

    /// Writes to the folder of `reuse_pipelines` what was compiled since, and ends its use.
    pub fn keep_pipelines(&mut self) -> Result<(), Fault> {
        self.compile()?;
        self.pipelines.cache.take().map_or(Ok(()), |mut cache| cache.keep())
    }

    /// Makes a pipeline, of the fastest variant of the kernel that the device has; compiled later (`compile`).
    pub fn kernel<K: KernelDef>(&mut self, spec: K::Spec) -> Result<Kernel<K>, Fault> {
        self.make(&spec, None, false)
    }

    /// Does what `kernel` does for one that may take long: a dispatch that would pass `submission_max_ms` is several. Its workgroups
    /// must not ask how many there are, but for the width of a wrapped row (`Threads::d1`).
    pub fn kernel_in_pieces<K: KernelDef>(&mut self, spec: K::Spec) -> Result<Kernel<K>, Fault> {
        self.make(&spec, None, true)
    }

    /// Does what `kernel_in_pieces` does with one variant: `""` is the baseline.
    pub fn kernel_variant<K: KernelDef>(&mut self, spec: K::Spec, variant: &str) -> Result<Kernel<K>, Fault> {
        self.make(&spec, Some(variant), true)
    }

    fn make<K: KernelDef>(
        &mut self,
        spec: &K::Spec,
        variant: Option<&str>,
        in_pieces: bool,
    ) -> Result<Kernel<K>, Fault> {
        let kernel = self.pipelines.make::<K>(spec, variant, in_pieces)?;
        self.submitter.add_kernel(kernel.name());
        Ok(kernel)
    }

    /// An empty recording. Its memory comes back with `submit`; a second one at the same time allocates.
    pub fn record(&mut self) -> Recorder {
        self.spare.take().unwrap_or_else(Recorder::new)
    }

    /// Runs a recording and waits for it.
    pub fn submit(&mut self, rec: Recorder) -> Result<(), GpuError> {
        let ticket = self.start(rec)?;
        self.finish(ticket)
    }

    /// Starts a recording; the one before may still be running. What is recorded sees all that was started before it.
    pub fn start(&mut self, mut rec: Recorder) -> Result<Ticket, GpuError> {
        let failed = GpuError::of("vkCreateComputePipelines");
        let compiled = self.compile().map_err(|_| failed(vk::Result::ERROR_UNKNOWN));
        let flushed = self.flush();
        let started = match rec.error.or(compiled.err()).or(flushed.err()) {
            _ if self.lost => Err(GpuError::Lost),
            Some(e) => Err(e),
            None => self.submitter.start(&rec, &mut self.pipelines, &self.memory),
        };
        rec.clear();
        self.spare = Some(rec);
        self.note(started)
    }

    /// Waits for a recording, and so for all before it.
    pub fn finish(&mut self, ticket: Ticket) -> Result<(), GpuError> {
        if self.lost {
            return Err(GpuError::Lost);
        }
        let done = self.submitter.finish(ticket);
        self.note(done)
    }

    /// Waits for all that was started.
    pub fn wait(&mut self) -> Result<(), GpuError> {
        self.finish(self.submitter.latest())
    }

    /// Copies `items` to `buf[at..]`: before the next recording that is started and the next download. Small uploads gather in
    /// staging until then and go as one.
    pub fn upload<T: bytemuck::Pod>(&mut self, buf: Buf<T>, at: usize, items: &[T]) -> Result<(), GpuError> {
        let start = checked(&buf, at, items.len())?;
        let mut done = 0;
        for piece in bytemuck::cast_slice::<T, u8>(items).chunks(TRANSFER_BYTES) {
            let (size, to) = (piece.len() as u64, start + done);
            if !self.uploads.fit(piece.len(), to) {
                self.flush()?;
            }
            let from = self.uploads.add(piece.len(), to);
            self.staging.bytes_mut()[from..from + piece.len()].copy_from_slice(piece);
            done += size;
        }
        match self.lost {
            true => Err(GpuError::Lost),
            false => Ok(()),
        }
    }

    /// Does the uploads that have gathered, and waits.
    fn flush(&mut self) -> Result<(), GpuError> {
        if self.uploads.regions().is_empty() {
            return Ok(());
        }
        let moved = match self.lost {
            true => Err(GpuError::Lost),
            false => self.submitter.transfer(self.staging.buffer(), self.memory.buffer, self.uploads.regions()),
        };
        self.uploads.clear();
        self.note(moved)
    }

    /// Copies `buf[at..]` to `items` and waits.
    pub fn download<T: bytemuck::Pod>(&mut self, buf: Buf<T>, at: usize, items: &mut [T]) -> Result<(), GpuError> {
        let start = checked(&buf, at, items.len())?;
        let bytes = Buf::<u8>::at(start, std::mem::size_of_val(items));
        self.download_parts(std::iter::once(bytes), bytemuck::cast_slice_mut(items))
    }

    /// Copies buffers to `bytes`, one after another, with as few submissions as staging takes, and waits.
    pub fn download_parts(
        &mut self,
        parts: impl Iterator<Item = Buf<u8>>,
        mut bytes: &mut [u8],
    ) -> Result<(), GpuError> {
        self.flush()?;
        self.wait()?;
        let mut gathered = Copies::default();
        for part in parts {
            for at in (0..part.len()).step_by(TRANSFER_BYTES) {
                let piece = part.part(at, TRANSFER_BYTES.min(part.len() - at));
                if !gathered.fit(piece.len(), piece.range().start) {
                    bytes = self.bring(&mut gathered, bytes)?;
                }
                gathered.add(piece.len(), piece.range().start);
            }
        }
        self.bring(&mut gathered, bytes).map(|_| ())
    }

    /// Copies what has gathered to staging, and from there to the first of `bytes`; the rest of them.
    fn bring<'a>(&mut self, gathered: &mut Copies, bytes: &'a mut [u8]) -> Result<&'a mut [u8], GpuError> {
        let (len, of) = (gathered.bytes(), bytes.len());
        let Some((taken, rest)) = bytes.split_at_mut_checked(len) else {
            return Err(GpuError::OutOfRange { at: 0, len, of });
        };
        if taken.is_empty() {
            return Ok(rest);
        }
        gathered.reverse();
        let moved = self.submitter.transfer(self.memory.buffer, self.staging.buffer(), gathered.regions());
        gathered.clear();
        self.note(moved)?;
        taken.copy_from_slice(self.staging.bytes(0, taken.len()));
        Ok(rest)
    }

    /// What a recording's `Recorder::report` brought to `place`. Waits for that recording alone.
    pub fn report<T: bytemuck::Pod>(&mut self, ticket: Ticket, place: usize, items: &mut [T]) -> Result<(), GpuError> {
        self.finish(ticket)?;
        let bytes = bytemuck::cast_slice_mut::<T, u8>(items);
        if bytes.len() > REPORT_BYTES || place >= REPORTS {
            return Err(GpuError::OutOfRange { at: 0, len: bytes.len(), of: REPORT_BYTES });
        }
        bytes.copy_from_slice(self.staging.bytes(report_offset(place) as usize, bytes.len()));
        Ok(())
    }

    /// Time on the device of the last recording waited for, ms; without timestamps, until the host saw its end.
    #[cfg(feature = "instruments")]
    pub fn last_submit_ms(&self) -> f64 {
        self.submitter.last_ms
    }

    /// Time on the device, by kernel (and `fill`, `report`), since boot. A command's time runs from the end of the
    /// one before, so the times of a submission add up to the whole.
    pub fn timings(&self) -> &[Timing] {
        &self.submitter.timings
    }

    /// Times every command of one recording in `recordings`, as every one is after boot, or with zero only whole
    /// submissions: a timestamp drains the device, which costs lavapipe 50 µs a command.
    pub fn time_commands(&mut self, recordings: u64) {
        self.submitter.timed_in = recordings;
    }

    /// Submissions so far; a recording that takes longer than `submission_max_ms` is several.
    #[cfg(feature = "instruments")]
    pub fn submissions(&self) -> u64 {
        self.submitter.submissions
    }

    /// Time of the longest submission so far, ms on the device.
    #[cfg(feature = "instruments")]
    pub fn longest_submission_ms(&self) -> f64 {
        self.submitter.longest_ms
    }

    pub fn arena_used(&self) -> u64 {
        self.arena.used()
    }

    /// Warnings and errors of the validation layer so far; none without validation.
    #[cfg(feature = "instruments")]
    pub fn validation_messages(&self) -> Vec<String> {
        self.device.messages()
    }

    /// Remembers a loss: what is in flight then never ends.
    fn note<R>(&mut self, result: Result<R, GpuError>) -> Result<R, GpuError> {
        self.lost |= matches!(result, Err(GpuError::Lost));
        result
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        // To destroy a device that hangs waits for it without end, and what it uses must not go before it. It is left to the
        // end of the process.
        if self.wait().is_err() {
            self.device.abandoned.store(true, Relaxed);
            std::mem::forget(self.device.clone());
        }
    }
}

/// Arena offset of `buf[at]`, if `len` elements from there are inside.
fn checked<T>(buf: &Buf<T>, at: usize, len: usize) -> Result<u64, GpuError> {
    match at.checked_add(len) {
        Some(end) if end <= buf.len() => Ok(buf.range().start + (at * size_of::<T>()) as u64),
        _ => Err(GpuError::OutOfRange { at, len, of: buf.len() }),
    }
}
