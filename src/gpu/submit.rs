//! Turns recordings into command buffers, runs them, and reads how long each command took.
//!
//! Up to `SLOTS` submissions are under way at once: while the device runs one, the host encodes the next, so that the
//! device goes from one to the other without waiting for the host. Each command buffer begins with a barrier against
//! all that was submitted before, so they run as if one after another; a fence each tells the host. A recording that
//! takes long is cut into parts, each a submission; so is a long dispatch of a kernel made for it (`pieces`).
//!
//! Command buffers, fences and queries are made once; what a command buffer holds is encoded anew for each part, since
//! cameras, targets and rates are push constants. Kept encodings would gain nothing: to record, encode and submit a step
//! takes 0.05 ms on the host of an NVIDIA H200, behind the 0.25 ms of the step before it, and a step of 0.14 ms has the
//! same 0.02 ms from its end to the beginning of the next as one of 0.78 (`stipple-bench kernels`: wall less device).

use super::device::{boot, Device};
use super::kernel::Pipelines;
use super::memory::{report_offset, Backed, Range};
use super::pieces::{axis, PieceTiming};
use super::record::{Command, Recorder, Work};
use super::{GpuError, COMMANDS_MAX};
use ash::vk;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::Arc;
use std::time::Instant;
use stipple_drivers::Fault;

/// Submissions under way at once: one runs, one waits. A third would only make answers older.
const SLOTS: usize = 2;
/// Ten times what the slowest board allows a submission, lavapipe's second: past it the device hangs.
const HUNG_NS: u64 = 10_000_000_000;
const STAMPS: usize = COMMANDS_MAX + 1;

/// Time on the device of everything with one name.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    pub name: &'static str,
    pub count: u64,
    pub total_ms: f64,
    pub last_ms: f64,
}

/// Rows of `Submitter::timings` that are not kernels.
const FILL: usize = 0;
const REPORT: usize = 1;

/// A recording that was started: the number of its last part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ticket(u64);

/// What one submission needs of its own.
struct Slot {
    commands: vk::CommandBuffer,
    fence: vk::Fence,
    queries: vk::QueryPool,
    started: Instant,
    /// What each command is to `Submitter::timings`; empty where only the whole is timed.
    timed: Vec<Timed>,
    /// Whether the times are for the table; otherwise for the pace alone.
    each: bool,
    /// Commands of the recording that this is the last part of; zero of the other parts.
    ends: usize,
}

/// A command whose time is taken: its row, and its workgroups if it is a dispatch.
#[derive(Clone, Copy)]
struct Timed {
    row: usize,
    groups: u32,
    /// Whether it is the first piece of its command, and the last.
    begins: bool,
    ends: bool,
}

/// What one submission holds: commands, or the slabs of workgroups `slabs` of one.
struct Part {
    from: usize,
    to: usize,
    slabs: Option<std::ops::Range<u32>>,
}

pub(super) struct Submitter {
    device: Arc<Device>,
    pool: vk::CommandPool,
    /// Part n is in slot n % SLOTS.
    slots: [Slot; SLOTS],
    /// Parts started, and those of them waited for.
    started: u64,
    ended: u64,
    /// Where reports go.
    staging: vk::Buffer,
    stamps: Vec<u64>,
    pub timings: Vec<Timing>,
    /// Row of each kernel, by index.
    rows: Vec<usize>,
    /// How long a workgroup of each row takes.
    paces: Vec<PieceTiming>,
    /// When the host last saw a part end.
    seen: Instant,
    /// Time of the last whole recording.
    pub last_ms: f64,
    /// Mean time of its commands.
    mean_ms: f64,
    /// Time so far of the recording whose parts are ending.
    total_ms: f64,
    submission_max_ms: f64,
    /// A submission that takes longer hangs.
    pub hung_ns: u64,
    pub submissions: u64,
    /// Time of the longest part so far.
    pub longest_ms: f64,
    recordings: u64,
    /// Every command of one recording in so many is timed; zero: of none.
    pub timed_in: u64,
}

impl Submitter {
    pub fn new(device: &Arc<Device>, staging: vk::Buffer, submission_max_ms: f64) -> Result<Submitter, Fault> {
        let slot = || Slot {
            commands: vk::CommandBuffer::null(),
            fence: vk::Fence::null(),
            queries: vk::QueryPool::null(),
            started: Instant::now(),
            timed: Vec::with_capacity(COMMANDS_MAX),
            each: false,
            ends: 0,
        };
        let mut s = Submitter {
            device: device.clone(),
            pool: vk::CommandPool::null(),
            slots: std::array::from_fn(|_| slot()),
            started: 0,
            ended: 0,
            staging,
            stamps: vec![0; STAMPS],
            timings: Vec::new(),
            rows: Vec::new(),
            paces: Vec::new(),
            seen: Instant::now(),
            last_ms: 0.0,
            mean_ms: 0.0,
            total_ms: 0.0,
            submission_max_ms,
            hung_ns: HUNG_NS,
            submissions: 0,
            longest_ms: 0.0,
            recordings: 0,
            timed_in: 1,
        };
        s.row("fill");
        s.row("report");
        let raw = &device.raw;
        // SAFETY: the device is alive; each object is destroyed by `Drop`, also after a failure here.
        unsafe {
            let info = vk::CommandPoolCreateInfo::default()
                .queue_family_index(device.family)
                .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER);
            s.pool = raw.create_command_pool(&info, None).map_err(boot("vkCreateCommandPool"))?;
            let info = vk::CommandBufferAllocateInfo::default().command_pool(s.pool).command_buffer_count(1);
            for slot in &mut s.slots {
                slot.commands = raw.allocate_command_buffers(&info).map_err(boot("vkAllocateCommandBuffers"))?[0];
                slot.fence = raw.create_fence(&vk::FenceCreateInfo::default(), None).map_err(boot("vkCreateFence"))?;
                if device.caps.timestamp_bits > 0 {
                    let info = vk::QueryPoolCreateInfo::default()
                        .query_type(vk::QueryType::TIMESTAMP)
                        .query_count(STAMPS as u32);
                    slot.queries = raw.create_query_pool(&info, None).map_err(boot("vkCreateQueryPool"))?;
                }
            }
        }
        Ok(s)
    }

    /// Gives the next kernel its row; kernels of one name share it.
    pub fn add_kernel(&mut self, name: &'static str) {
        let row = self.timings.iter().position(|t| t.name == name).unwrap_or_else(|| self.row(name));
        self.rows.push(row);
    }

    fn row(&mut self, name: &'static str) -> usize {
        self.timings.push(Timing { name, count: 0, total_ms: 0.0, last_ms: 0.0 });
        self.paces.push(PieceTiming::default());
        self.timings.len() - 1
    }

    /// Encodes a recording and starts it, part after part, waiting for the oldest where all slots are taken.
    pub fn start(&mut self, rec: &Recorder, pipelines: &mut Pipelines, memory: &Backed) -> Result<Ticket, GpuError> {
        if pipelines.must_forget_sets(rec.commands.len()) {
            self.finish_all()?;
            pipelines.forget_sets()?;
        }
        let each = self.timed_in > 0 && self.recordings % self.timed_in == 0;
        self.recordings += 1;
        let all = rec.commands.len();
        // The next command, and how many slabs of it are done.
        let (mut from, mut done) = (0, 0);
        while from < all {
            let part = self.cut(rec, from, done, pipelines)?;
            (from, done) = match &part.slabs {
                Some(slabs) if part.to == part.from => (from, slabs.end),
                _ => (part.to, 0),
            };
            let slot = self.free_slot()?;
            self.slots[slot].ends = if from == all { all } else { 0 };
            self.begin(slot)?;
            if let Err(e) = self.encode_part(rec, &part, slot, each, pipelines, memory) {
                // SAFETY: recording, not in flight: back to where the next `begin` expects it.
                unsafe {
                    self.device
                        .raw
                        .reset_command_buffer(self.slots[slot].commands, vk::CommandBufferResetFlags::empty())
                }
                .map_err(GpuError::of("vkResetCommandBuffer"))?;
                return Err(e);
            }
            self.end(slot)?;
            self.submissions += 1;
        }
        Ok(Ticket(self.started))
    }

    /// The slot of the next part; its submission, if any, has ended.
    fn free_slot(&mut self) -> Result<usize, GpuError> {
        if self.started - self.ended == SLOTS as u64 {
            self.end_oldest()?;
        }
        Ok((self.started % SLOTS as u64) as usize)
    }

    /// Waits for a recording, and so for all before it.
    pub fn finish(&mut self, ticket: Ticket) -> Result<(), GpuError> {
        while self.ended < ticket.0 {
            self.end_oldest()?;
        }
        Ok(())
    }

    /// The last that was started.
    pub fn latest(&self) -> Ticket {
        Ticket(self.started)
    }

    fn finish_all(&mut self) -> Result<(), GpuError> {
        self.finish(self.latest())
    }

    /// Waits for the oldest part under way and adds its times to the table.
    fn end_oldest(&mut self) -> Result<(), GpuError> {
        let slot = (self.ended % SLOTS as u64) as usize;
        self.wait(slot)?;
        self.ended += 1;
        self.read_stamps(slot)?;
        if self.slots[slot].ends > 0 {
            self.last_ms = self.total_ms;
            self.mean_ms = self.total_ms / self.slots[slot].ends as f64;
            self.total_ms = 0.0;
        }
        Ok(())
    }

    /// The part that begins with command `from`, `done` of whose slabs were in the part before. Integrated GPUs reset on
    /// long submissions, so a part is what took `submission_max_ms` when its commands were last timed; one command at
    /// least, or a piece of one that may be cut.
    fn cut(&mut self, rec: &Recorder, from: usize, done: u32, pipelines: &Pipelines) -> Result<Part, GpuError> {
        let max_ms = self.submission_max_ms;
        if let Some(groups) = divisible(&rec.commands[from], pipelines) {
            let row = self.row_of(&rec.commands[from]);
            let all = groups[axis(groups)];
            let slab = groups.iter().product::<u32>() / all;
            if done > 0 || self.paces[row].estimate(all * slab) > max_ms {
                // The pace of what is under way counts.
                self.finish_all()?;
                let end = done + self.paces[row].piece(all - done, slab, max_ms);
                return Ok(Part { from, to: from + usize::from(end == all), slabs: Some(done..end) });
            }
        }
        let mut ms = 0.0;
        let fitting = rec.commands[from..].iter().take_while(|command| {
            let row = self.row_of(command);
            let t = &self.timings[row];
            ms += match divisible(command, pipelines) {
                Some(groups) => self.paces[row].estimate(groups.iter().product()),
                None if self.timed_in > 0 && t.count > 0 => t.last_ms,
                None => self.mean_ms,
            };
            ms <= max_ms
        });
        Ok(Part { from, to: from + fitting.count().max(1), slabs: None })
    }

    fn row_of(&self, command: &Command) -> usize {
        match command.work {
            Work::Dispatch { kernel, .. } => self.rows[kernel as usize],
            Work::Fill { .. } => FILL,
            Work::Report { .. } => REPORT,
        }
    }

    fn encode_part(
        &mut self,
        rec: &Recorder,
        part: &Part,
        slot: usize,
        each: bool,
        pipelines: &mut Pipelines,
        memory: &Backed,
    ) -> Result<(), GpuError> {
        let commands = &rec.commands[part.from..part.to.max(part.from + 1)];
        let each = each && self.has_stamps();
        // Two stamps are what a lone command needs.
        let timed = each || commands.len() == 1;
        self.slots[slot].timed.clear();
        self.slots[slot].each = each;
        if self.has_stamps() {
            let queries = self.slots[slot].queries;
            let stamps = if timed { commands.len() as u32 + 1 } else { 2 };
            // SAFETY: recording; no submission that uses the queries is in flight.
            unsafe { self.device.raw.cmd_reset_query_pool(self.slots[slot].commands, queries, 0, stamps) };
            self.stamp(slot, 0);
        }
        for (i, command) in commands.iter().enumerate() {
            let groups = self.encode(command, part.slabs.as_ref(), self.slots[slot].commands, pipelines, memory)?;
            if timed {
                let row = self.row_of(command);
                let begins = part.slabs.as_ref().is_none_or(|slabs| slabs.start == 0);
                self.slots[slot].timed.push(Timed { row, groups, begins, ends: part.to > part.from });
                if self.has_stamps() {
                    self.stamp(slot, i + 1);
                }
            }
        }
        if self.has_stamps() && !timed {
            self.stamp(slot, 1);
        }
        Ok(())
    }

    fn has_stamps(&self) -> bool {
        self.slots[0].queries != vk::QueryPool::null()
    }

    /// A timestamp when all before has ended.
    fn stamp(&self, slot: usize, i: usize) {
        let Slot { commands, queries, .. } = self.slots[slot];
        // SAFETY: recording; the pool has a query for each command and one more, reset when the part began.
        unsafe {
            let stage = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
            self.device.raw.cmd_write_timestamp(commands, stage, queries, i as u32);
        }
    }

    /// A command, or the slabs of its workgroups that are asked for. Answers how many workgroups a dispatch has.
    fn encode(
        &self,
        command: &Command,
        slabs: Option<&std::ops::Range<u32>>,
        cb: vk::CommandBuffer,
        pipelines: &mut Pipelines,
        memory: &Backed,
    ) -> Result<u32, GpuError> {
        let raw = &self.device.raw;
        if command.barrier_before {
            self.barrier(cb);
        }
        if let Work::Dispatch { kernel, ranges, push, .. } = &command.work {
            let set = pipelines.set(*kernel, ranges, memory)?;
            let p = pipelines.get(*kernel);
            let point = vk::PipelineBindPoint::COMPUTE;
            // SAFETY: recording; pipeline, layout and set belong together, and live as long as `Gpu`.
            unsafe {
                raw.cmd_bind_pipeline(cb, point, p.raw);
                raw.cmd_bind_descriptor_sets(cb, point, p.layout, 0, &[set], &[]);
                if p.push_bytes > 0 {
                    raw.cmd_push_constants(cb, p.layout, vk::ShaderStageFlags::COMPUTE, 0, &push[..p.push_bytes]);
                }
            }
        }
        let inside = |kernel: &'static str, r: Range| match r.end <= memory.bytes {
            true => Ok(()),
            false => Err(GpuError::Binding { kernel, start: r.start, end: r.end }),
        };
        match command.work {
            Work::Dispatch { .. } => {}
            Work::Fill { range, .. } => inside("fill", range)?,
            Work::Report { from, .. } => inside("report", from)?,
        }
        let memory = memory.buffer;
        let mut dispatched = 0;
        // SAFETY: recording; ranges lie in the arena, and the recorder checked their alignment. Slabs are of kernels whose
        // pipeline may begin anywhere.
        unsafe {
            match command.work {
                Work::Dispatch { mut groups, .. } => {
                    let mut first = [0; 3];
                    if let Some(slabs) = slabs {
                        let axis = axis(groups);
                        (first[axis], groups[axis]) = (slabs.start, slabs.end - slabs.start);
                    }
                    let ([a, b, c], [x, y, z]) = (first, groups);
                    match first {
                        [0, 0, 0] => raw.cmd_dispatch(cb, x, y, z),
                        _ => raw.cmd_dispatch_base(cb, a, b, c, x, y, z),
                    }
                    dispatched = x * y * z;
                }
                Work::Fill { range, value } => {
                    raw.cmd_fill_buffer(cb, memory, range.start, range.end - range.start, value);
                }
                Work::Report { from, place } => {
                    let dst_offset = report_offset(place);
                    let region = [vk::BufferCopy { src_offset: from.start, dst_offset, size: from.end - from.start }];
                    raw.cmd_copy_buffer(cb, memory, self.staging, &region);
                    self.barrier_to_host(cb);
                }
            }
        }
        Ok(dispatched)
    }

    fn read_stamps(&mut self, slot: usize) -> Result<(), GpuError> {
        let Slot { queries, started, ref timed, each, .. } = self.slots[slot];
        let before = std::mem::replace(&mut self.seen, Instant::now());
        if !self.has_stamps() {
            let ms = self.seen.duration_since(started.max(before)).as_secs_f64() * 1e3;
            self.total_ms += ms;
            self.longest_ms = self.longest_ms.max(ms);
            timed.iter().for_each(|t| self.paces[t.row].note(t.groups, ms));
            return Ok(());
        }
        let last = timed.len().max(1);
        let stamps = &mut self.stamps[..last + 1];
        let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
        // SAFETY: these queries were reset and written by the submission that has just ended.
        unsafe { self.device.raw.get_query_pool_results(queries, 0, stamps, flags) }
            .map_err(GpuError::of("vkGetQueryPoolResults"))?;
        let caps = &self.device.caps;
        let (mask, period_ms) = (u64::MAX >> (64 - caps.timestamp_bits.min(64)), caps.timestamp_period_ns * 1e-6);
        let ms = |a: u64, b: u64| (b.wrapping_sub(a) & mask) as f64 * period_ms;
        let whole = ms(self.stamps[0], self.stamps[last]);
        self.total_ms += whole;
        self.longest_ms = self.longest_ms.max(whole);
        for (i, timed) in timed.iter().enumerate() {
            let ms = ms(self.stamps[i], self.stamps[i + 1]);
            self.paces[timed.row].note(timed.groups, ms);
            if each {
                let t = &mut self.timings[timed.row];
                t.last_ms = if timed.begins { ms } else { t.last_ms + ms };
                t.total_ms += ms;
                t.count += u64::from(timed.ends);
            }
        }
        Ok(())
    }

    /// Copies between staging and the arena, waited for as all before them.
    pub fn transfer(&mut self, from: vk::Buffer, to: vk::Buffer, regions: &[vk::BufferCopy]) -> Result<(), GpuError> {
        self.finish_all()?;
        let slot = self.free_slot()?;
        self.begin(slot)?;
        let cb = self.slots[slot].commands;
        // SAFETY: recording; the caller keeps the regions inside both buffers and apart.
        unsafe { self.device.raw.cmd_copy_buffer(cb, from, to, regions) };
        self.barrier_to_host(cb);
        self.end(slot)?;
        self.wait(slot)?;
        self.ended += 1;
        Ok(())
    }

    /// What was copied is visible to the host after the fence.
    fn barrier_to_host(&self, cb: vk::CommandBuffer) {
        let barrier = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ)];
        // SAFETY: recording.
        unsafe {
            self.device.raw.cmd_pipeline_barrier(
                cb,
                vk::PipelineStageFlags::TRANSFER,
                vk::PipelineStageFlags::HOST,
                vk::DependencyFlags::empty(),
                &barrier,
                &[],
                &[],
            );
        }
    }

    fn begin(&self, slot: usize) -> Result<(), GpuError> {
        let cb = self.slots[slot].commands;
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the command buffer is not in flight, since a slot is only used again after its end; beginning resets
        // it.
        unsafe { self.device.raw.begin_command_buffer(cb, &info) }.map_err(GpuError::of("vkBeginCommandBuffer"))?;
        // Against all earlier submissions, ended or not.
        self.barrier(cb);
        Ok(())
    }

    fn end(&mut self, slot: usize) -> Result<(), GpuError> {
        let s = &mut self.slots[slot];
        s.started = Instant::now();
        let buffers = [s.commands];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        // SAFETY: recording has begun; the fence is unsignalled, and the queue is used by this thread alone.
        unsafe {
            self.device.raw.end_command_buffer(s.commands).map_err(GpuError::of("vkEndCommandBuffer"))?;
            self.device.raw.queue_submit(self.device.queue, &submit, s.fence).map_err(GpuError::of("vkQueueSubmit"))?;
        }
        self.started += 1;
        Ok(())
    }

    fn wait(&self, slot: usize) -> Result<(), GpuError> {
        let fence = [self.slots[slot].fence];
        // SAFETY: the fence was given to a submission.
        unsafe {
            self.device.raw.wait_for_fences(&fence, true, self.hung_ns).map_err(GpuError::of("vkWaitForFences"))?;
            self.device.raw.reset_fences(&fence).map_err(GpuError::of("vkResetFences"))
        }
    }

    /// Everything before is done and visible to everything after: kernels, copies.
    fn barrier(&self, cb: vk::CommandBuffer) {
        let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
        let barrier = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(
                vk::AccessFlags::SHADER_READ
                    | vk::AccessFlags::SHADER_WRITE
                    | vk::AccessFlags::TRANSFER_READ
                    | vk::AccessFlags::TRANSFER_WRITE,
            )];
        // SAFETY: recording.
        unsafe {
            self.device.raw.cmd_pipeline_barrier(cb, stages, stages, vk::DependencyFlags::empty(), &barrier, &[], &[]);
        }
    }
}

/// Workgroups of a command that may be cut.
fn divisible(command: &Command, pipelines: &Pipelines) -> Option<[u32; 3]> {
    match command.work {
        Work::Dispatch { kernel, groups, .. } => pipelines.get(kernel).in_pieces.then_some(groups),
        _ => None,
    }
}

impl Drop for Submitter {
    fn drop(&mut self) {
        if self.device.abandoned.load(Relaxed) {
            return;
        }
        // SAFETY: `Gpu` waits for the device before its fields are dropped; null handles are ignored.
        unsafe {
            for slot in &self.slots {
                self.device.raw.destroy_query_pool(slot.queries, None);
                self.device.raw.destroy_fence(slot.fence, None);
            }
            self.device.raw.destroy_command_pool(self.pool, None);
        }
    }
}
