//! What one submission does, as plain data: kernels, fills and copies, with the barriers between them.
//!
//! The recorder remembers which bytes were read and written since the last barrier; a command that
//! touches what an earlier one wrote, or writes what it read, is preceded by one global barrier. Placed as
//! late as possible, that is the fewest barriers the order of commands allows. It is all the synchronisation
//! there is.

use super::kernel::{Access, Kernel, KernelDef, BUFFERS_MAX, PUSH_MAX};
use super::memory::{Buf, Range, REPORTS, REPORT_BYTES};
use super::{GpuError, COMMANDS_MAX};

/// Workgroups every device takes in one dimension.
pub const GROUPS_MAX: u32 = 65535;

/// How many invocations, or workgroups, a dispatch starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Threads {
    count: [u32; 3],
    groups: bool,
}

impl Threads {
    /// `n` invocations in a row. Past 65535 workgroups the row wraps into the second dimension, so a kernel
    /// that may get that long reads its index as
    /// `(gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x) * gl_WorkGroupSize.x + gl_LocalInvocationID.x`
    /// and compares it with the count.
    pub fn d1(n: u32) -> Threads {
        Threads { count: [n, 1, 1], groups: false }
    }

    #[cfg(feature = "instruments")]
    pub fn d2(x: u32, y: u32) -> Threads {
        Threads { count: [x, y, 1], groups: false }
    }

    pub fn d3(x: u32, y: u32, z: u32) -> Threads {
        Threads { count: [x, y, z], groups: false }
    }

    /// Workgroups instead of invocations, wrapping as `d1` does when only `x` is above one.
    pub fn groups(x: u32, y: u32, z: u32) -> Threads {
        Threads { count: [x, y, z], groups: true }
    }

    /// Workgroups of size `local` that cover the threads, or nothing if there are too many.
    pub fn workgroups(self, local: [u32; 3]) -> Option<[u32; 3]> {
        let mut g = self.count;
        if !self.groups {
            (0..3).for_each(|i| g[i] = g[i].div_ceil(local[i]));
        }
        if g[0] > GROUPS_MAX && g[1] == 1 && g[2] == 1 {
            g[1] = g[0].div_ceil(GROUPS_MAX);
            g[0] = g[0].div_ceil(g[1]);
        }
        g.iter().all(|&n| n <= GROUPS_MAX).then_some(g)
    }
}

// Recordings keep their room, so a boxed dispatch would gain nothing.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Copy)]
pub(super) enum Work {
    Dispatch { kernel: u32, ranges: [Range; BUFFERS_MAX], push: [u8; PUSH_MAX], groups: [u32; 3] },
    Fill { range: Range, value: u32 },
    Report { from: Range, place: usize },
}

#[derive(Clone, Copy)]
pub(super) struct Command {
    pub barrier_before: bool,
    pub work: Work,
}

/// A recording; made by `Gpu::record`, spent by `Gpu::submit`. Its memory is reused.
pub struct Recorder {
    pub(super) commands: Vec<Command>,
    /// Bytes touched since the last barrier, and whether they were written.
    open: Vec<(Range, bool)>,
    reports: bool,
    pub(super) error: Option<GpuError>,
}

/// Ranges open at most: every buffer of every command.
const OPEN_MAX: usize = COMMANDS_MAX * BUFFERS_MAX;

impl Recorder {
    pub(super) fn new() -> Recorder {
        Recorder {
            commands: Vec::with_capacity(COMMANDS_MAX),
            open: Vec::with_capacity(OPEN_MAX),
            reports: false,
            error: None,
        }
    }

    pub(super) fn clear(&mut self) {
        self.commands.clear();
        self.open.clear();
        self.reports = false;
        self.error = None;
    }

    /// Starts `threads` invocations of a kernel. None is nothing.
    pub fn dispatch<K: KernelDef>(&mut self, kernel: &Kernel<K>, bind: K::Bind, push: K::Push, threads: Threads) {
        match threads.workgroups(kernel.local) {
            Some([x, y, z]) if x == 0 || y == 0 || z == 0 => {}
            Some(groups) => {
                let ranges = K::ranges(&bind);
                let push = padded(&push);
                self.push(Work::Dispatch { kernel: kernel.index, ranges, push, groups }, bound::<K>(&ranges));
            }
            None => self.fail(GpuError::Groups { kernel: kernel.name() }),
        }
    }

    /// Sets every 32-bit word of `buf`.
    pub fn fill<T>(&mut self, buf: Buf<T>, value: u32) {
        let range = buf.range();
        if range.start % 4 != 0 || range.end % 4 != 0 {
            return self.fail(GpuError::Binding { kernel: "fill", start: range.start, end: range.end });
        }
        if range.start < range.end {
            self.push(Work::Fill { range, value }, std::iter::once((range, Access::Write)));
        }
    }

    /// Brings `buf` to the host within this submission, to a place below `REPORTS`, where it stays until the next report
    /// to it: `Gpu::report` has it. One a recording.
    pub fn report<T>(&mut self, buf: Buf<T>, place: usize) {
        let from = buf.range();
        if buf.bytes() > REPORT_BYTES as u64 || place >= REPORTS || self.reports {
            return self.fail(GpuError::Binding { kernel: "report", start: from.start, end: from.end });
        }
        self.reports = true;
        if from.start < from.end {
            self.push(Work::Report { from, place }, std::iter::once((from, Access::Read)));
        }
    }

    /// Commands recorded so far.
    #[cfg(feature = "instruments")]
    pub fn len(&self) -> usize {
        self.commands.len()
    }

    #[cfg(feature = "instruments")]
    pub fn is_empty(&self) -> bool {
        self.commands.is_empty()
    }

    /// Barriers inserted so far.
    #[cfg(feature = "instruments")]
    pub fn barriers(&self) -> usize {
        self.commands.iter().filter(|c| c.barrier_before).count()
    }

    /// Commands that it still has room for.
    pub fn room(&self) -> usize {
        COMMANDS_MAX - self.commands.len()
    }

    /// The first error is kept, and `Gpu::submit` returns it.
    fn fail(&mut self, error: GpuError) {
        self.error.get_or_insert(error);
    }

    fn push(&mut self, work: Work, touched: impl Iterator<Item = (Range, Access)> + Clone) {
        if self.commands.len() == COMMANDS_MAX {
            return self.fail(GpuError::RecordingFull);
        }
        let conflicts = |(range, access): (Range, Access)| {
            self.open.iter().any(|(other, written)| (*written || access != Access::Read) && range.overlaps(other))
        };
        let barrier_before = touched.clone().any(conflicts);
        if barrier_before {
            self.open.clear();
        }
        self.open.extend(touched.map(|(range, access)| (range, access != Access::Read)));
        self.commands.push(Command { barrier_before, work });
    }
}

fn bound<K: KernelDef>(ranges: &[Range; BUFFERS_MAX]) -> impl Iterator<Item = (Range, Access)> + Clone + use<'_, K> {
    ranges.iter().zip(K::BINDINGS).map(|(&range, &(_, access))| (range, access))
}

fn padded<P: bytemuck::Pod>(push: &P) -> [u8; PUSH_MAX] {
    let mut bytes = [0; PUSH_MAX];
    let from = bytemuck::bytes_of(push);
    bytes[..from.len()].copy_from_slice(from);
    bytes
}
