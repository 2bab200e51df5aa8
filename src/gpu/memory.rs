//! One buffer of device memory, handed out at boot by an `Arena`, and one staging buffer to fill and read it.
//!
//! `Buf<T>` is a plain copyable handle. Nothing is freed before the device is closed: capacity comes from the board's
//! budget, and a budget that does not fit is refused at boot. An arena is bookkeeping alone, so what allocates from one
//! can be run without a device first, to learn how large the buffer must be (`Arena::counting`).

use super::device::{boot, unavailable, Device};
use crate::mem::Footprint;
use ash::vk;
use std::marker::PhantomData;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::Arc;
use stipple_drivers::{Fault, FaultKind};

/// Every buffer starts here: the largest `minStorageBufferOffsetAlignment` Vulkan allows.
pub const ALIGN: u64 = 256;
/// Host side of every transfer; longer ones go in pieces.
pub const STAGING_BYTES: usize = 4 << 20;
/// Places at the end of staging that stay as they are until the next report to the same place, and their size.
pub const REPORTS: usize = 3;
pub const REPORT_BYTES: usize = 256;
/// What is left of it for transfers.
pub(super) const TRANSFER_BYTES: usize = STAGING_BYTES - REPORTS * REPORT_BYTES;

/// Where a report begins in staging, bytes.
pub(super) fn report_offset(place: usize) -> u64 {
    (TRANSFER_BYTES + place * REPORT_BYTES) as u64
}

/// `len` elements of `T` in the arena.
#[derive(Clone, Copy)]
pub struct Buf<T> {
    offset: u64,
    len: usize,
    of: PhantomData<fn() -> T>,
}

/// A buffer a kernel only reads.
#[derive(Clone, Copy)]
pub struct Read<T>(Buf<T>);
/// A buffer a kernel only writes.
#[derive(Clone, Copy)]
pub struct Write<T>(Buf<T>);
/// A buffer a kernel reads and writes.
#[derive(Clone, Copy)]
pub struct ReadWrite<T>(Buf<T>);

/// Bytes of the arena, `start..end`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Range {
    pub start: u64,
    pub end: u64,
}

impl Range {
    pub fn overlaps(&self, other: &Range) -> bool {
        self.start < other.end && other.start < self.end
    }
}

impl<T> Buf<T> {
    pub fn len(&self) -> usize {
        self.len
    }

    #[cfg(feature = "instruments")]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    pub fn bytes(&self) -> u64 {
        (self.len * size_of::<T>()) as u64
    }

    pub fn range(&self) -> Range {
        Range { start: self.offset, end: self.offset + self.bytes() }
    }

    pub fn read(self) -> Read<T> {
        Read(self)
    }

    pub fn write(self) -> Write<T> {
        Write(self)
    }

    pub fn read_write(self) -> ReadWrite<T> {
        ReadWrite(self)
    }

    /// `len` elements from `at`. To be bound to a kernel, a part must start at a multiple of `ALIGN` bytes.
    ///
    /// # Panics
    /// As a slice does, when the part is not inside.
    pub fn part(self, at: usize, len: usize) -> Buf<T> {
        assert!(at <= self.len && len <= self.len - at, "part {at}+{len} of a buffer of {}", self.len);
        Buf { offset: self.offset + (at * size_of::<T>()) as u64, len, of: PhantomData }
    }

    /// So many elements from a byte of the arena on.
    pub(super) fn at(offset: u64, len: usize) -> Buf<T> {
        Buf { offset, len, of: PhantomData }
    }

    /// The same bytes as elements of another type; a remainder is cut off.
    pub fn cast<U>(self) -> Buf<U> {
        Buf { offset: self.offset, len: self.bytes() as usize / size_of::<U>(), of: PhantomData }
    }
}

impl<T> std::fmt::Debug for Buf<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Buf {{ offset: {}, len: {} }}", self.offset, self.len)
    }
}

macro_rules! binding {
    ($($name:ident),+) => {$(
        impl<T> $name<T> {
            pub fn range(&self) -> Range {
                self.0.range()
            }
        }
    )+};
}
binding!(Read, Write, ReadWrite);

/// A Vulkan buffer with memory of its own.
pub(super) struct Backed {
    device: Arc<Device>,
    pub buffer: vk::Buffer,
    pub bytes: u64,
    memory: vk::DeviceMemory,
}

impl Backed {
    fn new(
        device: &Arc<Device>,
        name: &str,
        bytes: u64,
        usage: vk::BufferUsageFlags,
        preferences: &[(vk::MemoryPropertyFlags, vk::MemoryPropertyFlags)],
    ) -> Result<Backed, Fault> {
        let info = vk::BufferCreateInfo::default().size(bytes).usage(usage);
        // SAFETY: the device is alive, and `bytes` is positive.
        let buffer = unsafe { device.raw.create_buffer(&info, None) }.map_err(boot("vkCreateBuffer"))?;
        let mut backed = Backed { device: device.clone(), buffer, bytes, memory: vk::DeviceMemory::null() };
        // SAFETY: the buffer was just made.
        let needs = unsafe { device.raw.get_buffer_memory_requirements(buffer) };
        let kind = preferences
            .iter()
            .find_map(|&(wanted, unwanted)| device.memory_type(needs.memory_type_bits, wanted, unwanted))
            .ok_or_else(|| unavailable(format!("the device has no memory for the {name}")))?;
        let info = vk::MemoryAllocateInfo::default().allocation_size(needs.size).memory_type_index(kind);
        // SAFETY: the type is one the buffer allows; buffer and memory are bound once, at offset zero.
        unsafe {
            backed.memory = device.raw.allocate_memory(&info, None).map_err(|r| {
                Fault::new(
                    FaultKind::Unavailable,
                    "gpu arena",
                    format!("{} has no {} MiB for the {name}: {r}", device.caps.name, bytes >> 20),
                    "lower the board's [budget]",
                )
            })?;
            device.raw.bind_buffer_memory(buffer, backed.memory, 0).map_err(boot("vkBindBufferMemory"))?;
        }
        device.name(buffer, name);
        Ok(backed)
    }
}

impl Drop for Backed {
    fn drop(&mut self) {
        if self.device.abandoned.load(Relaxed) {
            return;
        }
        // SAFETY: `Gpu` waits for the device before its fields are dropped; null memory is ignored.
        unsafe {
            self.device.raw.destroy_buffer(self.buffer, None);
            self.device.raw.free_memory(self.memory, None);
        }
    }
}

/// Where in the one buffer the next part goes.
pub struct Arena {
    bytes: u64,
    used: u64,
    /// Largest part that a kernel can bind, bytes.
    binding_max: u64,
    rows: Vec<(&'static str, u64)>,
}

impl Arena {
    /// Without an end: to run what allocates and ask how many bytes it took.
    pub fn counting() -> Arena {
        Arena::new(u64::MAX, u64::MAX)
    }

    pub(super) fn new(bytes: u64, binding_max: u64) -> Arena {
        Arena { bytes, used: 0, binding_max, rows: Vec::new() }
    }

    /// Takes `len` elements. `name` should say which budget sizes it.
    pub fn alloc<T: bytemuck::Pod>(&mut self, name: &'static str, len: usize) -> Result<Buf<T>, Fault> {
        let refuse = |what: String| {
            let fix = format!("change the [budget] entry that sizes `{name}`");
            Fault::new(FaultKind::Config, format!("gpu arena: {name}"), what, fix)
        };
        let bytes = (len as u64)
            .checked_mul(size_of::<T>() as u64)
            .filter(|&b| b > 0)
            .ok_or_else(|| refuse(format!("{len} elements of {} bytes is no size", size_of::<T>())))?;
        if bytes > self.binding_max {
            return Err(refuse(format!("{bytes} bytes; the device binds at most {} at once", self.binding_max)));
        }
        let left = self.bytes - self.used;
        if bytes > left {
            return Err(refuse(format!("{bytes} bytes do not fit into the {left} left of {}", self.bytes)));
        }
        let offset = self.used;
        self.used = (self.used + bytes).next_multiple_of(ALIGN).min(self.bytes);
        self.rows.push((name, self.used - offset));
        Ok(Buf { offset, len, of: PhantomData })
    }

    /// All of it, to be cleared.
    pub(super) fn whole(&self) -> Buf<u32> {
        Buf { offset: 0, len: self.bytes as usize / 4, of: PhantomData }
    }

    pub fn used(&self) -> u64 {
        self.used
    }

    /// Bytes by name, alignment included.
    pub fn footprint(&self) -> Footprint {
        let mut f = Footprint::default();
        self.rows.iter().for_each(|&(name, bytes)| f.gpu(name, bytes as usize));
        f
    }
}

/// The buffer that an arena of `bytes` hands out.
pub(super) fn arena_buffer(device: &Arc<Device>, bytes: u64) -> Result<Backed, Fault> {
    let caps = &device.caps;
    if bytes > caps.allocation_max_bytes {
        let mib = |bytes: u64| bytes >> 20;
        let most = mib(caps.allocation_max_bytes);
        let what = format!("{} MiB asked for; {} allocates at most {most} MiB at once", mib(bytes), caps.name);
        return Err(Fault::new(FaultKind::Config, "gpu arena", what, "lower the board's [budget]"));
    }
    let texels = match caps.texel_buffers {
        true => vk::BufferUsageFlags::UNIFORM_TEXEL_BUFFER,
        false => vk::BufferUsageFlags::empty(),
    };
    let usage = texels
        | vk::BufferUsageFlags::STORAGE_BUFFER
        | vk::BufferUsageFlags::TRANSFER_SRC
        | vk::BufferUsageFlags::TRANSFER_DST;
    let local = vk::MemoryPropertyFlags::DEVICE_LOCAL;
    // Memory the host also sees is scarce on discrete devices: taken only if there is no other.
    let preferences = [(local, vk::MemoryPropertyFlags::HOST_VISIBLE), (local, vk::MemoryPropertyFlags::empty())];
    Backed::new(device, "arena", bytes, usage, &preferences)
}

pub struct Staging {
    mapped: std::ptr::NonNull<u8>,
    backed: Backed,
}

// SAFETY: the pointer is to memory this struct owns alone, reached through &self and &mut self only.
unsafe impl Send for Staging {}

impl Staging {
    pub fn new(device: &Arc<Device>) -> Result<Staging, Fault> {
        let usage = vk::BufferUsageFlags::TRANSFER_SRC | vk::BufferUsageFlags::TRANSFER_DST;
        let plain = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
        let none = vk::MemoryPropertyFlags::empty();
        // Cached first: reading uncached memory costs about a hundred times more.
        let preferences = [(plain | vk::MemoryPropertyFlags::HOST_CACHED, none), (plain, none)];
        let backed = Backed::new(device, "staging", STAGING_BYTES as u64, usage, &preferences)?;
        // SAFETY: the memory is host-visible and not mapped yet; freeing it unmaps it.
        let mapped = unsafe { device.raw.map_memory(backed.memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty()) }
            .map_err(boot("vkMapMemory"))?;
        let mapped = std::ptr::NonNull::new(mapped.cast::<u8>()).ok_or_else(|| unavailable("vkMapMemory gave null"))?;
        Ok(Staging { mapped, backed })
    }

    pub fn buffer(&self) -> vk::Buffer {
        self.backed.buffer
    }

    /// Some of the staging bytes; valid to touch only while nothing in flight writes them.
    pub fn bytes(&self, at: usize, len: usize) -> &[u8] {
        assert!(at <= STAGING_BYTES && len <= STAGING_BYTES - at);
        // SAFETY: STAGING_BYTES are mapped and coherent, and callers have waited for what writes these.
        unsafe { std::slice::from_raw_parts(self.mapped.as_ptr().add(at), len) }
    }

    /// What transfers go through.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as for `bytes`; the exclusive borrow is the host's only view.
        unsafe { std::slice::from_raw_parts_mut(self.mapped.as_ptr(), TRANSFER_BYTES) }
    }
}
