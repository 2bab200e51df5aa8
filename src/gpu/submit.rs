//! Turns recordings into command buffers, runs them, and reads how long each command took.
//!
//! One submission is in flight at a time: the recording's own barriers order what is inside it, a fence
//! orders the host. Command buffers, fence and queries are made once.

use super::device::{boot, Device};
use super::kernel::Pipelines;
use super::memory::{Arena, Range};
use super::record::{Command, Recorder, Work, COMMANDS_MAX};
use super::GpuError;
use ash::vk;
use std::sync::Arc;
use std::time::Instant;
use stipple_drivers::Fault;

/// Far above any submission the budget allows, on the slowest CPU device: past it the device hangs.
const HUNG_NS: u64 = 60_000_000_000;
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
const COPY: usize = 1;
const READ_BACK: usize = 2;

pub(super) struct Submitter {
    device: Arc<Device>,
    pool: vk::CommandPool,
    commands: vk::CommandBuffer,
    fence: vk::Fence,
    queries: vk::QueryPool,
    /// Where read-backs go.
    staging: vk::Buffer,
    stamps: Vec<u64>,
    pub timings: Vec<Timing>,
    /// Row of each kernel, by index.
    rows: Vec<usize>,
    started: Instant,
    /// Of the last whole recording.
    pub last_ms: f64,
    /// Of a command of it, on average.
    mean_ms: f64,
    /// Of the parts of the recording in flight that have ended.
    total_ms: f64,
    /// Commands in flight, or last in flight.
    part: std::ops::Range<usize>,
    submission_max_ms: f64,
    pub submissions: u64,
    /// Time every command, or only the whole.
    pub each: bool,
}

impl Submitter {
    pub fn new(device: &Arc<Device>, staging: vk::Buffer, submission_max_ms: f64) -> Result<Submitter, Fault> {
        let mut s = Submitter {
            device: device.clone(),
            pool: vk::CommandPool::null(),
            commands: vk::CommandBuffer::null(),
            fence: vk::Fence::null(),
            queries: vk::QueryPool::null(),
            staging,
            stamps: vec![0; STAMPS],
            timings: Vec::new(),
            rows: Vec::new(),
            started: Instant::now(),
            last_ms: 0.0,
            mean_ms: 0.0,
            total_ms: 0.0,
            part: 0..0,
            submission_max_ms,
            submissions: 0,
            each: true,
        };
        s.row("fill");
        s.row("copy");
        s.row("read back");
        let raw = &device.raw;
        // SAFETY: the device is alive; each object is destroyed by `Drop`, also after a failure here.
        unsafe {
            let info = vk::CommandPoolCreateInfo::default()
                .queue_family_index(device.family)
                .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER);
            s.pool = raw.create_command_pool(&info, None).map_err(boot("vkCreateCommandPool"))?;
            let info = vk::CommandBufferAllocateInfo::default().command_pool(s.pool).command_buffer_count(1);
            s.commands = raw.allocate_command_buffers(&info).map_err(boot("vkAllocateCommandBuffers"))?[0];
            s.fence = raw.create_fence(&vk::FenceCreateInfo::default(), None).map_err(boot("vkCreateFence"))?;
            if device.caps.timestamp_bits > 0 {
                let info =
                    vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(STAMPS as u32);
                s.queries = raw.create_query_pool(&info, None).map_err(boot("vkCreateQueryPool"))?;
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
        self.timings.len() - 1
    }

    /// Encodes a recording and starts its first part; `finish` goes on with the others.
    pub fn start(&mut self, rec: &Recorder, pipelines: &mut Pipelines, arena: &Arena) -> Result<(), GpuError> {
        pipelines.reserve_sets(rec.commands.len())?;
        self.total_ms = 0.0;
        self.part = 0..0;
        self.start_part(rec, pipelines, arena)
    }

    /// Starts what follows the last part.
    fn start_part(&mut self, rec: &Recorder, pipelines: &mut Pipelines, arena: &Arena) -> Result<(), GpuError> {
        self.part = self.part.end..self.cut(rec, self.part.end);
        self.begin()?;
        if let Err(e) = self.encode_part(rec, pipelines, arena) {
            // SAFETY: recording, not in flight: back to where the next `begin` expects it.
            unsafe { self.device.raw.reset_command_buffer(self.commands, vk::CommandBufferResetFlags::empty()) }
                .map_err(GpuError::of("vkResetCommandBuffer"))?;
            return Err(e);
        }
        self.submissions += 1;
        self.end()
    }

    /// Where the part that begins at `from` ends: integrated GPUs reset on long submissions, so a part is
    /// what took `submission_max_ms` when its commands last ran, and at least one command.
    fn cut(&self, rec: &Recorder, from: usize) -> usize {
        let mut ms = 0.0;
        let fitting = rec.commands[from..].iter().take_while(|command| {
            ms += if self.each { self.timings[self.row_of(command)].last_ms } else { self.mean_ms };
            ms <= self.submission_max_ms
        });
        from + fitting.count().max(1)
    }

    fn row_of(&self, command: &Command) -> usize {
        match command.work {
            Work::Dispatch { kernel, .. } | Work::Indirect { kernel, .. } => self.rows[kernel as usize],
            Work::Fill { .. } => FILL,
            Work::Copy { .. } => COPY,
            Work::ReadBack { .. } => READ_BACK,
        }
    }

    fn encode_part(&self, rec: &Recorder, pipelines: &mut Pipelines, arena: &Arena) -> Result<(), GpuError> {
        let timed = self.queries != vk::QueryPool::null();
        let stamp = |i: usize| {
            // SAFETY: recording; the pool has a query for each command and one more, reset just below.
            unsafe {
                let stage = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
                self.device.raw.cmd_write_timestamp(self.commands, stage, self.queries, i as u32);
            }
        };
        if timed {
            // SAFETY: recording; no submission that uses the queries is in flight.
            unsafe {
                self.device.raw.cmd_reset_query_pool(self.commands, self.queries, 0, self.stamped() as u32 + 1);
            }
            stamp(0);
        }
        for (i, command) in rec.commands[self.part.clone()].iter().enumerate() {
            self.encode(command, pipelines, arena)?;
            if timed && self.each {
                stamp(i + 1);
            }
        }
        if timed && !self.each {
            stamp(1);
        }
        Ok(())
    }

    /// Timestamps of the part beside its first.
    fn stamped(&self) -> usize {
        if self.each {
            self.part.len()
        } else {
            1
        }
    }

    fn encode(&self, command: &Command, pipelines: &mut Pipelines, arena: &Arena) -> Result<(), GpuError> {
        let (raw, cb) = (&self.device.raw, self.commands);
        if command.barrier_before {
            self.barrier();
        }
        if let Work::Dispatch { kernel, ranges, push, .. } | Work::Indirect { kernel, ranges, push, .. } = &command.work
        {
            let set = pipelines.set(*kernel, ranges, arena)?;
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
        let inside = |kernel: &'static str, r: Range| match r.end <= arena.bytes() {
            true => Ok(()),
            false => Err(GpuError::Binding { kernel, start: r.start, end: r.end }),
        };
        match command.work {
            Work::Dispatch { .. } => {}
            Work::Indirect { at, .. } => inside("indirect", Range { start: at, end: at + 12 })?,
            Work::Fill { range, .. } => inside("fill", range)?,
            Work::Copy { from, to } => inside("copy", from).and(inside("copy", to))?,
            Work::ReadBack { from } => inside("read back", from)?,
        }
        let arena = arena.buffer();
        // SAFETY: recording; ranges lie in the arena, and the recorder checked their alignment.
        unsafe {
            match command.work {
                Work::Dispatch { groups: [x, y, z], .. } => raw.cmd_dispatch(cb, x, y, z),
                Work::Indirect { at, .. } => raw.cmd_dispatch_indirect(cb, arena, at),
                Work::Fill { range, value } => {
                    raw.cmd_fill_buffer(cb, arena, range.start, range.end - range.start, value);
                }
                Work::Copy { from, to } => {
                    let region =
                        [vk::BufferCopy { src_offset: from.start, dst_offset: to.start, size: from.end - from.start }];
                    raw.cmd_copy_buffer(cb, arena, arena, &region);
                }
                Work::ReadBack { from } => {
                    let region =
                        [vk::BufferCopy { src_offset: from.start, dst_offset: 0, size: from.end - from.start }];
                    raw.cmd_copy_buffer(cb, arena, self.staging, &region);
                    self.barrier_to_host();
                }
            }
        }
        Ok(())
    }

    /// Waits for what `start` started, part after part, and adds its times to the table.
    pub fn finish(&mut self, rec: &Recorder, pipelines: &mut Pipelines, arena: &Arena) -> Result<(), GpuError> {
        loop {
            self.wait()?;
            self.read_stamps(rec)?;
            if self.part.end == rec.commands.len() {
                break;
            }
            self.start_part(rec, pipelines, arena)?;
        }
        self.last_ms = self.total_ms;
        self.mean_ms = self.total_ms / rec.commands.len().max(1) as f64;
        Ok(())
    }

    fn read_stamps(&mut self, rec: &Recorder) -> Result<(), GpuError> {
        if self.queries == vk::QueryPool::null() {
            self.total_ms += self.started.elapsed().as_secs_f64() * 1e3;
            return Ok(());
        }
        let last = self.stamped();
        let stamps = &mut self.stamps[..last + 1];
        let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
        // SAFETY: these queries were reset and written by the submission that has just ended.
        unsafe { self.device.raw.get_query_pool_results(self.queries, 0, stamps, flags) }
            .map_err(GpuError::of("vkGetQueryPoolResults"))?;
        let caps = &self.device.caps;
        let (mask, period_ms) = (u64::MAX >> (64 - caps.timestamp_bits.min(64)), caps.timestamp_period_ns * 1e-6);
        let ms = |a: u64, b: u64| (b.wrapping_sub(a) & mask) as f64 * period_ms;
        self.total_ms += ms(self.stamps[0], self.stamps[last]);
        if !self.each {
            return Ok(());
        }
        for (i, command) in rec.commands[self.part.clone()].iter().enumerate() {
            let row = self.row_of(command);
            let t = &mut self.timings[row];
            t.last_ms = ms(self.stamps[i], self.stamps[i + 1]);
            t.total_ms += t.last_ms;
            t.count += 1;
        }
        Ok(())
    }

    /// One copy between staging and the arena, waited for.
    pub fn transfer(&mut self, from: vk::Buffer, to: vk::Buffer, region: vk::BufferCopy) -> Result<(), GpuError> {
        self.begin()?;
        // SAFETY: recording; the caller keeps the region inside both buffers.
        unsafe { self.device.raw.cmd_copy_buffer(self.commands, from, to, &[region]) };
        self.barrier_to_host();
        self.end()?;
        self.wait()
    }

    /// What was copied is visible to the host after the fence.
    fn barrier_to_host(&self) {
        let barrier = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ)];
        // SAFETY: recording.
        unsafe {
            self.device.raw.cmd_pipeline_barrier(
                self.commands,
                vk::PipelineStageFlags::TRANSFER,
                vk::PipelineStageFlags::HOST,
                vk::DependencyFlags::empty(),
                &barrier,
                &[],
                &[],
            );
        }
    }

    fn begin(&mut self) -> Result<(), GpuError> {
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the command buffer is not in flight, since every start is waited for; beginning resets it.
        unsafe { self.device.raw.begin_command_buffer(self.commands, &info) }
            .map_err(GpuError::of("vkBeginCommandBuffer"))?;
        // The fence made earlier submissions available; this makes them visible to this one.
        self.barrier();
        Ok(())
    }

    fn end(&mut self) -> Result<(), GpuError> {
        self.started = Instant::now();
        let buffers = [self.commands];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        // SAFETY: recording has begun; the fence is unsignalled, and the queue is used by this thread alone.
        unsafe {
            self.device.raw.end_command_buffer(self.commands).map_err(GpuError::of("vkEndCommandBuffer"))?;
            self.device.raw.queue_submit(self.device.queue, &submit, self.fence).map_err(GpuError::of("vkQueueSubmit"))
        }
    }

    fn wait(&mut self) -> Result<(), GpuError> {
        // SAFETY: the fence was given to a submission.
        unsafe {
            self.device.raw.wait_for_fences(&[self.fence], true, HUNG_NS).map_err(GpuError::of("vkWaitForFences"))?;
            self.device.raw.reset_fences(&[self.fence]).map_err(GpuError::of("vkResetFences"))
        }
    }

    /// Everything before is done and visible to everything after: kernels, copies, indirect arguments.
    fn barrier(&self) {
        let stages = vk::PipelineStageFlags::COMPUTE_SHADER
            | vk::PipelineStageFlags::TRANSFER
            | vk::PipelineStageFlags::DRAW_INDIRECT;
        let barrier = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(
                vk::AccessFlags::SHADER_READ
                    | vk::AccessFlags::SHADER_WRITE
                    | vk::AccessFlags::TRANSFER_READ
                    | vk::AccessFlags::TRANSFER_WRITE
                    | vk::AccessFlags::INDIRECT_COMMAND_READ,
            )];
        // SAFETY: recording.
        unsafe {
            self.device.raw.cmd_pipeline_barrier(
                self.commands,
                stages,
                stages,
                vk::DependencyFlags::empty(),
                &barrier,
                &[],
                &[],
            );
        }
    }
}

impl Drop for Submitter {
    fn drop(&mut self) {
        // SAFETY: `Gpu` waits for the device before its fields are dropped; null handles are ignored.
        unsafe {
            self.device.raw.destroy_query_pool(self.queries, None);
            self.device.raw.destroy_fence(self.fence, None);
            self.device.raw.destroy_command_pool(self.pool, None);
        }
    }
}
