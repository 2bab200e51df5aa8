//! Pipelines: a kernel's SPIR-V with its specialisation constants, made at boot and compiled together, on up to four cores.
//!
//! `KernelDef` is implemented by what the build writes from GLSL, never by hand. A kernel with faster
//! variants takes the last one whose SPIR-V capabilities the device has.

use super::cache::PipelineCache;
use super::device::{boot, Device};
use super::memory::{Backed, Range, ALIGN};
use super::{GpuError, COMMANDS_MAX};
use ash::vk;
use std::collections::HashMap;
use std::marker::PhantomData;
use std::mem::take;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{available_parallelism, scope, Builder};
use stipple_drivers::{Fault, FaultKind};

/// Storage buffers and specialisation constants of one kernel; the build refuses more.
pub const BUFFERS_MAX: usize = 8;
pub const SPECS_MAX: usize = 16;
/// Bytes of push constants every Vulkan device has.
pub const PUSH_MAX: usize = 128;
/// Distinct (kernel, buffers) combinations remembered; past it the cache starts over. Twice what one
/// recording can ask for, so that a recording always fits after a restart and restarts are rare.
const SETS_MAX: usize = 2 * COMMANDS_MAX;
/// Threads that compile at once, at most.
const COMPILERS_MAX: usize = 4;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    Read,
    Write,
    ReadWrite,
}

/// One SPIR-V module of a kernel.
#[derive(Clone, Copy, Debug)]
pub struct Variant {
    /// Preprocessor name it was compiled with; empty is the baseline.
    pub define: &'static str,
    pub name: &'static str,
    pub spirv: &'static [u8],
    pub shared_bytes: u32,
    pub capabilities: &'static [u32],
    /// VkFormat of the texels that a buffer is read as, by buffer; zero: it is a storage buffer.
    pub texels: [i32; BUFFERS_MAX],
}

/// What a module declares, for the test of the baseline.
#[cfg_attr(not(feature = "instruments"), allow(dead_code))]
#[derive(Clone, Copy, Debug)]
pub struct Reflected {
    pub name: &'static str,
    pub baseline: bool,
    pub local: [u32; 3],
    pub shared_bytes: u32,
    pub buffers: usize,
    pub push_bytes: u32,
    pub capabilities: &'static [u32],
}

/// A kernel as the build reflects it.
pub trait KernelDef: 'static {
    type Push: bytemuck::Pod;
    type Spec;
    type Bind;
    const NAME: &'static str;
    const BINDINGS: &'static [(u32, Access)];
    const SPEC_IDS: &'static [u32];
    const VARIANTS: &'static [Variant];
    fn local(spec: &Self::Spec) -> [u32; 3];
    fn spec_words(spec: &Self::Spec) -> [u32; SPECS_MAX];
    fn ranges(bind: &Self::Bind) -> [Range; BUFFERS_MAX];
}

/// A pipeline of one `Gpu`; a plain handle.
#[derive(Clone, Copy)]
pub struct Kernel<K> {
    pub(super) index: u32,
    pub(super) local: [u32; 3],
    name: &'static str,
    of: PhantomData<fn() -> K>,
}

impl<K> Kernel<K> {
    /// Name of the variant taken.
    pub fn name(&self) -> &'static str {
        self.name
    }
}

pub(super) struct ComputePipeline {
    pub raw: vk::Pipeline,
    pub layout: vk::PipelineLayout,
    pub push_bytes: usize,
    /// Whether a dispatch may be several, of a part of its workgroups each.
    pub in_pieces: bool,
    set_layout: vk::DescriptorSetLayout,
    module: vk::ShaderModule,
    bindings: &'static [(u32, Access)],
    variant: &'static Variant,
    spec_ids: &'static [u32],
    spec_words: [u32; SPECS_MAX],
}

impl ComputePipeline {
    fn descriptor_type(&self, buffer: usize) -> vk::DescriptorType {
        match self.variant.texels[buffer] {
            0 => vk::DescriptorType::STORAGE_BUFFER,
            _ => vk::DescriptorType::UNIFORM_TEXEL_BUFFER,
        }
    }
}

/// All pipelines, and the descriptor sets made for them so far.
pub(super) struct Pipelines {
    device: Arc<Device>,
    list: Vec<ComputePipeline>,
    /// How many of them are compiled.
    compiled: usize,
    pub cache: Option<PipelineCache>,
    pool: vk::DescriptorPool,
    sets: HashMap<SetKey, vk::DescriptorSet>,
    /// What the sets see of the arena as texels.
    views: Vec<vk::BufferView>,
}

type SetKey = (u32, [Range; BUFFERS_MAX]);

impl Pipelines {
    pub fn new(device: &Arc<Device>) -> Result<Pipelines, Fault> {
        let buffers = SETS_MAX * BUFFERS_MAX;
        let size = |ty| vk::DescriptorPoolSize::default().ty(ty).descriptor_count(buffers as u32);
        let sizes = [vk::DescriptorType::STORAGE_BUFFER, vk::DescriptorType::UNIFORM_TEXEL_BUFFER].map(size);
        let texels = device.caps.texel_buffers;
        let sizes = &sizes[..if texels { 2 } else { 1 }];
        let info = vk::DescriptorPoolCreateInfo::default().max_sets(SETS_MAX as u32).pool_sizes(sizes);
        // SAFETY: the device is alive.
        let pool = unsafe { device.raw.create_descriptor_pool(&info, None) }.map_err(boot("vkCreateDescriptorPool"))?;
        Ok(Pipelines {
            device: device.clone(),
            list: Vec::new(),
            compiled: 0,
            cache: None,
            pool,
            sets: HashMap::with_capacity(SETS_MAX),
            views: Vec::with_capacity(if texels { buffers } else { 0 }),
        })
    }

    pub fn get(&self, index: u32) -> &ComputePipeline {
        &self.list[index as usize]
    }

    /// Makes the pipeline of variant `define`, or of the fastest the device has. `compile` must come before its use, and says whether
    /// the driver takes it.
    pub fn make<K: KernelDef>(
        &mut self,
        spec: &K::Spec,
        define: Option<&str>,
        in_pieces: bool,
    ) -> Result<Kernel<K>, Fault> {
        let refuse = |what: String| {
            Fault::new(FaultKind::Unavailable, format!("kernel {}", K::NAME), what, "use another device")
        };
        let caps = &self.device.caps;
        let runs = |v: &&Variant| v.capabilities.iter().all(|&c| caps.allows(c));
        let variant = match define {
            Some(d) => K::VARIANTS.iter().find(|v| v.define.eq_ignore_ascii_case(d)).filter(runs),
            // The baseline is first in the list; variants pay, so they are tried from the end.
            None => K::VARIANTS.iter().rev().find(runs),
        }
        .ok_or_else(|| refuse(format!("{} runs no such variant of it", caps.name)))?;
        let local = K::local(spec);
        let invocations = local.iter().product::<u32>();
        if invocations == 0 || invocations > caps.invocations_max || variant.shared_bytes > caps.shared_max_bytes {
            return Err(refuse(format!(
                "{invocations} invocations and {} B of shared memory; {} has {} and {}",
                variant.shared_bytes, caps.name, caps.invocations_max, caps.shared_max_bytes
            )));
        }
        self.list.push(ComputePipeline {
            raw: vk::Pipeline::null(),
            layout: vk::PipelineLayout::null(),
            push_bytes: size_of::<K::Push>(),
            in_pieces,
            set_layout: vk::DescriptorSetLayout::null(),
            module: vk::ShaderModule::null(),
            bindings: K::BINDINGS,
            variant,
            spec_ids: K::SPEC_IDS,
            spec_words: K::spec_words(spec),
        });
        Ok(Kernel { index: self.list.len() as u32 - 1, local, name: variant.name, of: PhantomData })
    }

    /// Compiles what was made since it was last called. Mesa takes up to 50 ms of a core for each, and a map has 20 to 40.
    pub fn compile(&mut self) -> Result<(), Fault> {
        let all = self.list.len();
        let made = &mut self.list[self.compiled..];
        if made.is_empty() {
            return Ok(());
        }
        let (device, cache) = (&*self.device, self.cache.as_ref().map_or(vk::PipelineCache::null(), |c| c.raw));
        let threads = available_parallelism().map_or(1, |n| n.get()).min(COMPILERS_MAX).min(made.len());
        let rest = Mutex::new(made.iter_mut());
        let next = || rest.lock().unwrap_or_else(PoisonError::into_inner).next();
        let work = || std::iter::from_fn(next).try_for_each(|pipeline| pipeline.build(device, cache));
        scope(|scope| {
            // This thread compiles, too; alone where the system gives it no others.
            let spawn = |_| Builder::new().name("pipelines".into()).spawn_scoped(scope, work).ok();
            let others: Vec<_> = (1..threads).filter_map(spawn).collect();
            others.into_iter().fold(work(), |done, other| done.and(other.join().expect("nothing in it panics")))
        })?;
        self.compiled = all;
        Ok(())
    }

    /// Whether fewer than `commands` sets are left: `forget_sets` makes room.
    pub fn must_forget_sets(&self, commands: usize) -> bool {
        self.sets.len() + commands > SETS_MAX
    }

    /// Call only while the device is idle.
    pub fn forget_sets(&mut self) -> Result<(), GpuError> {
        self.sets.clear();
        self.destroy_views();
        // SAFETY: no submission that uses these sets is in flight.
        unsafe { self.device.raw.reset_descriptor_pool(self.pool, vk::DescriptorPoolResetFlags::empty()) }
            .map_err(GpuError::of("vkResetDescriptorPool"))
    }

    /// Call only while nothing in flight uses a set.
    fn destroy_views(&mut self) {
        for view in self.views.drain(..) {
            // SAFETY: it was made by this device, and no submission that uses it is in flight.
            unsafe { self.device.raw.destroy_buffer_view(view, None) };
        }
    }

    pub fn set(
        &mut self,
        index: u32,
        ranges: &[Range; BUFFERS_MAX],
        memory: &Backed,
    ) -> Result<vk::DescriptorSet, GpuError> {
        if let Some(&set) = self.sets.get(&(index, *ranges)) {
            return Ok(set);
        }
        let pipeline = &self.list[index as usize];
        for r in &ranges[..pipeline.bindings.len()] {
            let bindable =
                r.start % ALIGN == 0 && r.start < r.end && r.end - r.start <= self.device.caps.binding_max_bytes;
            if !bindable || r.end > memory.bytes {
                return Err(GpuError::Binding { kernel: pipeline.variant.name, start: r.start, end: r.end });
            }
        }
        let layouts = [pipeline.set_layout];
        let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(self.pool).set_layouts(&layouts);
        let mut set = [vk::DescriptorSet::null()];
        // SAFETY: pool and layout are alive; one set is asked for and one place is given.
        unsafe {
            (self.device.raw.fp_v1_0().allocate_descriptor_sets)(self.device.raw.handle(), &info, set.as_mut_ptr())
        }
        .result()
        .map_err(GpuError::of("vkAllocateDescriptorSets"))?;
        let mut infos = [vk::DescriptorBufferInfo::default(); BUFFERS_MAX];
        let mut writes = [vk::WriteDescriptorSet::default(); BUFFERS_MAX];
        let mut views = [vk::BufferView::null(); BUFFERS_MAX];
        for (i, r) in ranges.iter().enumerate().take(pipeline.bindings.len()) {
            let bytes = r.end - r.start;
            infos[i] = vk::DescriptorBufferInfo { buffer: memory.buffer, offset: r.start, range: bytes };
            if pipeline.variant.texels[i] != 0 {
                let info = vk::BufferViewCreateInfo::default()
                    .buffer(memory.buffer)
                    .format(vk::Format::from_raw(pipeline.variant.texels[i]))
                    .offset(r.start)
                    .range(bytes);
                // SAFETY: the range lies in the buffer; `forget_sets` or `Drop` destroys the view.
                views[i] = unsafe { self.device.raw.create_buffer_view(&info, None) }
                    .map_err(GpuError::of("vkCreateBufferView"))?;
                self.views.push(views[i]);
            }
        }
        for (i, (write, &(binding, _))) in writes.iter_mut().zip(pipeline.bindings).enumerate() {
            let empty = vk::WriteDescriptorSet::default()
                .dst_set(set[0])
                .dst_binding(binding)
                .descriptor_type(pipeline.descriptor_type(i));
            *write = match pipeline.variant.texels[i] {
                0 => empty.buffer_info(std::slice::from_ref(&infos[i])),
                _ => empty.texel_buffer_view(std::slice::from_ref(&views[i])),
            };
        }
        // SAFETY: the set is new, so nothing in flight uses it; the ranges were checked above.
        unsafe { self.device.raw.update_descriptor_sets(&writes[..pipeline.bindings.len()], &[]) };
        self.sets.insert((index, *ranges), set[0]);
        Ok(set[0])
    }
}

impl ComputePipeline {
    /// Fills its handles step by step: a failure half-way leaves what is there to `Pipelines`, or to the next attempt.
    fn build(&mut self, device: &Device, cache: vk::PipelineCache) -> Result<(), Fault> {
        self.destroy(device);
        let (variant, ids, words) = (self.variant, self.spec_ids, self.spec_words);
        let code = ash::util::read_spv(&mut std::io::Cursor::new(variant.spirv))
            .map_err(|e| Fault::new(FaultKind::Internal, variant.name, format!("bad SPIR-V: {e}"), "build again"))?;
        let bindings: Vec<_> = self
            .bindings
            .iter()
            .enumerate()
            .map(|(i, &(binding, _))| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(binding)
                    .descriptor_type(self.descriptor_type(i))
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let entries: Vec<_> = ids
            .iter()
            .enumerate()
            .map(|(i, &id)| vk::SpecializationMapEntry { constant_id: id, offset: 4 * i as u32, size: 4 })
            .collect();
        let specialisation =
            vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::cast_slice(&words[..ids.len()]));
        let mut width = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default();
        let pushes = [vk::PushConstantRange {
            stage_flags: vk::ShaderStageFlags::COMPUTE,
            offset: 0,
            size: self.push_bytes as u32,
        }];
        let pushes = if self.push_bytes == 0 { &pushes[..0] } else { &pushes[..] };
        // SAFETY: the device is alive, each object is made from ones made just before, and every pointer
        // outlives its call. Vulkan lets several threads make objects of one device with one cache. The SPIR-V comes from the build's
        // own compiler.
        unsafe {
            let info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
            self.set_layout =
                device.raw.create_descriptor_set_layout(&info, None).map_err(boot("vkCreateDescriptorSetLayout"))?;
            let layouts = [self.set_layout];
            let info = vk::PipelineLayoutCreateInfo::default().set_layouts(&layouts).push_constant_ranges(pushes);
            self.layout = device.raw.create_pipeline_layout(&info, None).map_err(boot("vkCreatePipelineLayout"))?;
            let info = vk::ShaderModuleCreateInfo::default().code(&code);
            self.module = device.raw.create_shader_module(&info, None).map_err(boot("vkCreateShaderModule"))?;
            let mut stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(self.module)
                .name(c"main")
                .specialization_info(&specialisation);
            if let Some(size) = device.caps.asks_for(variant.capabilities) {
                width = width.required_subgroup_size(size);
                stage = stage.flags(vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS).push_next(&mut width);
            }
            let flags = match self.in_pieces {
                true => vk::PipelineCreateFlags::DISPATCH_BASE,
                false => vk::PipelineCreateFlags::empty(),
            };
            let info = [vk::ComputePipelineCreateInfo::default().flags(flags).stage(stage).layout(self.layout)];
            let made = device
                .raw
                .create_compute_pipelines(cache, &info, None)
                .map_err(|(_, r)| boot("vkCreateComputePipelines")(r))?;
            self.raw = made[0];
        }
        device.name(self.raw, variant.name);
        Ok(())
    }

    fn destroy(&mut self, device: &Device) {
        // SAFETY: nothing uses them: no recording starts before all kernels are compiled, and `Gpu` waits for the device before its
        // fields are dropped. Null handles are ignored.
        unsafe {
            device.raw.destroy_pipeline(take(&mut self.raw), None);
            device.raw.destroy_pipeline_layout(take(&mut self.layout), None);
            device.raw.destroy_shader_module(take(&mut self.module), None);
            device.raw.destroy_descriptor_set_layout(take(&mut self.set_layout), None);
        }
    }
}

impl Drop for Pipelines {
    fn drop(&mut self) {
        if self.device.abandoned.load(Relaxed) {
            return;
        }
        self.destroy_views();
        self.list.iter_mut().for_each(|p| p.destroy(&self.device));
        // SAFETY: `Gpu` waits for the device before its fields are dropped.
        unsafe { self.device.raw.destroy_descriptor_pool(self.pool, None) };
    }
}
