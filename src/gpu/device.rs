//! Instance, device, queue: chosen once, destroyed last. One more instance stays until the process ends (`keep_loaded`).
//!
//! Everything that owns a Vulkan object holds an `Arc<Device>`, so that the device outlives it whatever
//! order things are dropped in. The loader is opened at run time: a machine without Vulkan gets a
//! sentence, not a linker error.

use crate::config::GpuConfig;
use ash::vk;
use std::ffi::{c_void, CStr, CString};
use std::sync::atomic::AtomicBool;
use std::sync::Mutex;
use stipple_drivers::{Fault, FaultKind};

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";
/// Width of subgroup that is asked for where the compiler would choose: that of a tile. With 32 an invocation on Intel's Gen12 has
/// half as many registers.
const SUBGROUP_SIZE: u32 = 16;
/// Validation messages kept; the rest are only counted out by the log of the layer itself.
const MESSAGES_MAX: usize = 256;

/// In the order devices are preferred.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceKind {
    Discrete,
    Integrated,
    Virtual,
    Cpu,
    Other,
}

impl DeviceKind {
    fn new(kind: vk::PhysicalDeviceType) -> DeviceKind {
        match kind {
            vk::PhysicalDeviceType::DISCRETE_GPU => DeviceKind::Discrete,
            vk::PhysicalDeviceType::INTEGRATED_GPU => DeviceKind::Integrated,
            vk::PhysicalDeviceType::VIRTUAL_GPU => DeviceKind::Virtual,
            vk::PhysicalDeviceType::CPU => DeviceKind::Cpu,
            _ => DeviceKind::Other,
        }
    }
}

/// What the device can do, as far as kernels and budgets care.
#[derive(Clone, Debug)]
pub struct Caps {
    pub name: String,
    pub kind: DeviceKind,
    /// Invocations of a subgroup, in kernels that use its operations.
    pub subgroup_size: u32,
    /// Bits of VkSubgroupFeatureFlagBits that compute kernels may use; none with `GpuConfig::subgroups = false`.
    pub subgroup_operations: u32,
    /// Whether kernels read buffers as texels where a variant does: on a CPU, whose driver gathers texels and loads a storage
    /// buffer lane by lane. Never with `GpuConfig::subgroups = false`.
    pub texel_buffers: bool,
    /// Whether kernels that use subgroups ask the compiler for `subgroup_size`, since it would pick a width for each.
    pub subgroup_size_required: bool,
    /// Whether the compiler picks a width of subgroup for each kernel, narrower than the one reported: Intel's.
    subgroup_size_varies: bool,
    /// The least and the greatest width that a kernel can ask for (VK_EXT_subgroup_size_control).
    subgroup_sizes: Option<[u32; 2]>,
    pub invocations_max: u32,
    pub shared_max_bytes: u32,
    /// Largest buffer a kernel can bind, bytes.
    pub binding_max_bytes: u64,
    /// Largest single allocation, bytes.
    pub allocation_max_bytes: u64,
    /// Nanoseconds of one timestamp tick; zero when the queue has no timestamps.
    pub timestamp_period_ns: f64,
    pub(super) timestamp_bits: u32,
}

/// SPIR-V capabilities of kernels. Those of subgroup operations follow `GROUP` in the order of VkSubgroupFeatureFlagBits.
pub mod capability {
    pub const MATRIX: u32 = 0;
    pub const SHADER: u32 = 1;
    pub const SAMPLED_BUFFER: u32 = 46;
    pub const GROUP: u32 = 61;
    pub const GROUP_VOTE: u32 = 62;
    #[cfg(feature = "instruments")]
    pub const GROUP_ARITHMETIC: u32 = 63;
    pub const GROUP_SHUFFLE: u32 = 65;
    pub const GROUP_QUAD: u32 = 68;
}

impl Caps {
    /// Whether a module that declares this SPIR-V capability may run.
    pub fn allows(&self, capability: u32) -> bool {
        use capability::*;
        match capability {
            // Every Vulkan 1.1 compute queue.
            MATRIX | SHADER | GROUP => true,
            SAMPLED_BUFFER => self.texel_buffers,
            GROUP_VOTE..=GROUP_QUAD => self.subgroup_operations >> (capability - GROUP) & 1 != 0,
            _ => false,
        }
    }

    /// Has kernels ask for one width of subgroup where the compiler would pick one for each; where it takes no such request, or
    /// subgroups are not to be used, kernels do without them.
    fn settle_subgroup_size(&mut self) {
        if !self.subgroup_size_varies {
            return;
        }
        match self.subgroup_sizes {
            Some([least, most]) if self.allows(capability::GROUP_VOTE) => {
                self.subgroup_size = SUBGROUP_SIZE.clamp(least, most);
                self.subgroup_size_required = true;
            }
            _ => self.subgroup_operations &= vk::SubgroupFeatureFlags::BASIC.as_raw(),
        }
    }

    /// Width of subgroup that a module with these capabilities asks for; `None`: it takes what there is.
    pub(super) fn asks_for(&self, capabilities: &[u32]) -> Option<u32> {
        (self.subgroup_size_required && capabilities.contains(&capability::GROUP)).then_some(self.subgroup_size)
    }

    /// Limits what the device can do to the profile that the board names. Where the width of subgroup that the device reports is
    /// none of the profile's, subgroups are not used.
    #[cfg(feature = "instruments")]
    fn limit(&mut self, config: &GpuConfig) -> Result<(), Fault> {
        let Some(p) = crate::config::Profile::of(&config.profile)? else { return Ok(()) };
        self.name = format!("{} as {}", self.name, p.name);
        (self.kind, self.texel_buffers) = (DeviceKind::Integrated, false);
        let [least, most] = p.subgroup_sizes;
        self.subgroup_size_varies |= least < most;
        self.subgroup_sizes = self.subgroup_sizes.map(|[a, b]| [a.max(least), b.min(most)]);
        let has_width = (least..=most).contains(&self.subgroup_size);
        self.subgroup_operations &=
            if has_width { p.subgroup_operations } else { vk::SubgroupFeatureFlags::BASIC.as_raw() };
        self.invocations_max = self.invocations_max.min(p.invocations_max);
        self.shared_max_bytes = self.shared_max_bytes.min(p.shared_max_bytes);
        self.binding_max_bytes = self.binding_max_bytes.min(p.binding_max_bytes);
        self.allocation_max_bytes = self.allocation_max_bytes.min(p.allocation_max_bytes);
        if !p.timestamps {
            (self.timestamp_period_ns, self.timestamp_bits) = (0.0, 0);
        }
        Ok(())
    }
}

pub struct Device {
    pub raw: ash::Device,
    pub queue: vk::Queue,
    pub family: u32,
    pub caps: Caps,
    pub memory: vk::PhysicalDeviceMemoryProperties,
    pub properties: vk::PhysicalDeviceProperties,
    /// What is in flight may never end: nothing of the device is destroyed.
    pub abandoned: AtomicBool,
    names: Option<ash::ext::debug_utils::Device>,
    /// The last field: it goes after the device.
    instance: Instance,
}

/// The instance, and what the validation layer said.
struct Instance {
    raw: ash::Instance,
    /// Whether objects can be named.
    debug: bool,
    messenger: Option<Messenger>,
    /// Boxed: the messenger holds its address.
    messages: Box<Mutex<Vec<String>>>,
    /// The loaded library; its functions are used until the instance is gone.
    entry: ash::Entry,
}

pub(super) fn unavailable(what: impl Into<String>) -> Fault {
    Fault::new(
        FaultKind::Unavailable,
        "vulkan",
        what,
        "apt-get install mesa-vulkan-drivers (a CPU device and the integrated ones) or the vendor's driver; vulkaninfo lists devices",
    )
}

/// Turns a failed boot-time call into a fault that names it.
pub(super) fn boot(call: &'static str) -> impl Fn(vk::Result) -> Fault {
    move |r| unavailable(format!("{call} failed: {r}"))
}

impl Device {
    pub fn open(config: &GpuConfig, validation: bool) -> Result<Device, Fault> {
        let instance = Instance::new(validation)?;
        let (physical, family, mut caps) = choose(&instance.raw, config)?;
        if !config.subgroups {
            caps.subgroup_operations = 0;
            caps.texel_buffers = false;
        }
        #[cfg(feature = "instruments")]
        caps.limit(config)?;
        caps.settle_subgroup_size();
        let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(family).queue_priorities(&[1.0])];
        let mut info = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
        let extensions = [ash::ext::subgroup_size_control::NAME.as_ptr()];
        let mut features = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
            .subgroup_size_control(true)
            .compute_full_subgroups(true);
        if caps.subgroup_size_required {
            info = info.enabled_extension_names(&extensions).push_next(&mut features);
        }
        // SAFETY: `physical` belongs to `instance`, and `family` is one of its queue families.
        let raw = unsafe { instance.raw.create_device(physical, &info, None) }.map_err(boot("vkCreateDevice"))?;
        // SAFETY: one queue of this family was requested above; `physical` is alive.
        let (queue, memory, properties) = unsafe {
            let queue = raw.get_device_queue(family, 0);
            let memory = instance.raw.get_physical_device_memory_properties(physical);
            (queue, memory, instance.raw.get_physical_device_properties(physical))
        };
        keep_loaded(&instance.entry);
        let names = instance.debug.then(|| ash::ext::debug_utils::Device::new(&instance.raw, &raw));
        Ok(Device { raw, queue, family, caps, memory, properties, abandoned: AtomicBool::new(false), names, instance })
    }

    /// What the validation layer said so far, warnings and errors.
    pub fn messages(&self) -> Vec<String> {
        self.instance.messages.lock().map(|m| m.clone()).unwrap_or_default()
    }

    /// Names an object for validation messages and GPU debuggers.
    pub fn name<H: vk::Handle>(&self, object: H, name: &str) {
        let (Some(debug), Ok(name)) = (&self.names, CString::new(name)) else { return };
        let info = vk::DebugUtilsObjectNameInfoEXT::default().object_handle(object).object_name(&name);
        // SAFETY: the object is alive and of this device. A refused name changes nothing.
        let _ = unsafe { debug.set_debug_utils_object_name(&info) };
    }

    /// The first memory type among `allowed` that has `wanted` and none of `unwanted`.
    pub fn memory_type(
        &self,
        allowed: u32,
        wanted: vk::MemoryPropertyFlags,
        unwanted: vk::MemoryPropertyFlags,
    ) -> Option<u32> {
        (0..self.memory.memory_type_count).find(|&i| {
            let flags = self.memory.memory_types[i as usize].property_flags;
            allowed & (1 << i) != 0 && flags.contains(wanted) && !flags.intersects(unwanted)
        })
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // SAFETY: whoever made objects of this device held an Arc of it, so they are gone, and they waited
        // for their work. The instance (a field) goes after the device.
        unsafe { self.raw.destroy_device(None) };
        // Whoever asked for validation gets to see what it said, leaks at destruction included.
        self.messages().iter().for_each(|m| eprintln!("vulkan validation: {m}"));
    }
}

/// Holds one instance until the process ends, so that the driver stays loaded. A driver that is unloaded with its last instance
/// cannot always be loaded again: NVIDIA's was not found any more after some forty times, and a map that loses its device opens it anew.
fn keep_loaded(entry: &ash::Entry) {
    static KEPT: Mutex<Option<(ash::Entry, ash::Instance)>> = Mutex::new(None);
    let Ok(mut kept) = KEPT.lock() else { return };
    if kept.is_none() {
        *kept = instance(entry, false).ok().map(|(raw, _)| (entry.clone(), raw));
    }
}

type Messenger = (ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT);

impl Instance {
    fn new(validation: bool) -> Result<Instance, Fault> {
        // SAFETY: the library found is the system's Vulkan loader; it has no unsound initialiser.
        let entry = unsafe { ash::Entry::load() }
            .map_err(|e| unavailable(format!("no Vulkan loader (libvulkan.so.1): {e}")))?;
        let messages = Box::new(Mutex::new(Vec::with_capacity(MESSAGES_MAX)));
        let (raw, debug) = instance(&entry, validation)?;
        let mut instance = Instance { raw, debug, messenger: None, messages, entry };
        if validation && debug {
            instance.messenger = Some(messenger(&instance.entry, &instance.raw, &instance.messages)?);
        }
        Ok(instance)
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: the messenger is of this instance, and no device of it is left: `Device` destroys its own first.
        unsafe {
            if let Some((debug, m)) = &self.messenger {
                debug.destroy_debug_utils_messenger(*m, None);
            }
            self.raw.destroy_instance(None);
        }
    }
}

fn instance(entry: &ash::Entry, validation: bool) -> Result<(ash::Instance, bool), Fault> {
    // SAFETY: plain queries of the loader.
    let (version, layers, extensions) = unsafe {
        (
            entry.try_enumerate_instance_version().map_err(boot("vkEnumerateInstanceVersion"))?,
            entry.enumerate_instance_layer_properties().map_err(boot("vkEnumerateInstanceLayerProperties"))?,
            entry
                .enumerate_instance_extension_properties(None)
                .map_err(boot("vkEnumerateInstanceExtensionProperties"))?,
        )
    };
    if version.unwrap_or(vk::API_VERSION_1_0) < vk::API_VERSION_1_1 {
        return Err(unavailable("the Vulkan loader is older than 1.1"));
    }
    let has_layer = layers.iter().any(|l| l.layer_name_as_c_str() == Ok(VALIDATION_LAYER));
    if validation && !has_layer {
        return Err(Fault::new(
            FaultKind::Unavailable,
            "vulkan",
            "validation was asked for and its layer is not installed",
            "apt-get install vulkan-validationlayers, or unset STIPPLE_VALIDATION",
        ));
    }
    let debug = extensions.iter().any(|e| e.extension_name_as_c_str() == Ok(ash::ext::debug_utils::NAME));
    let mut names = Vec::new();
    if debug {
        names.push(ash::ext::debug_utils::NAME.as_ptr());
    }
    let mut layer_names = Vec::new();
    let enabled = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enabled);
    let app = vk::ApplicationInfo::default().application_name(c"stipple").api_version(vk::API_VERSION_1_1);
    if validation {
        layer_names.push(VALIDATION_LAYER.as_ptr());
        names.push(ash::ext::validation_features::NAME.as_ptr());
    }
    let mut info = vk::InstanceCreateInfo::default()
        .application_info(&app)
        .enabled_layer_names(&layer_names)
        .enabled_extension_names(&names);
    if validation {
        info = info.push_next(&mut features);
    }
    // SAFETY: every pointer in `info` outlives the call.
    let instance = unsafe { entry.create_instance(&info, None) }.map_err(boot("vkCreateInstance"))?;
    Ok((instance, debug))
}

fn messenger(entry: &ash::Entry, instance: &ash::Instance, messages: &Mutex<Vec<String>>) -> Result<Messenger, Fault> {
    let debug = ash::ext::debug_utils::Instance::new(entry, instance);
    let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(vk::DebugUtilsMessageSeverityFlagsEXT::WARNING | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR)
        // Not GENERAL: the loader reports every driver that does not match this machine there.
        .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE)
        .pfn_user_callback(Some(collect))
        .user_data(std::ptr::from_ref(messages).cast_mut().cast());
    // SAFETY: `messages` is boxed by the caller and outlives the messenger; the callback only locks it.
    let m =
        unsafe { debug.create_debug_utils_messenger(&info, None) }.map_err(boot("vkCreateDebugUtilsMessengerEXT"))?;
    Ok((debug, m))
}

unsafe extern "system" fn collect(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: `user` is the boxed list given to the messenger; `data` is valid during the call.
    let (messages, data) = unsafe { (&*user.cast::<Mutex<Vec<String>>>(), &*data) };
    // SAFETY: the layer passes a zero-terminated string or null.
    let text = unsafe { data.message_as_c_str() }.map(|s| s.to_string_lossy().into_owned());
    if let Ok(mut list) = messages.lock() {
        if list.len() < MESSAGES_MAX {
            list.push(text.unwrap_or_default());
        }
    }
    vk::FALSE
}

/// The least and the greatest width of subgroup that a compute kernel can ask for; `None` where it cannot.
fn subgroup_sizes(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<[u32; 2]> {
    let mut features = vk::PhysicalDeviceSubgroupSizeControlFeatures::default();
    let mut sizes = vk::PhysicalDeviceSubgroupSizeControlProperties::default();
    // SAFETY: `physical` is of this instance and has Vulkan 1.1; the structures are those of an extension that it has.
    unsafe {
        let extensions = instance.enumerate_device_extension_properties(physical).ok()?;
        let name = Ok(ash::ext::subgroup_size_control::NAME);
        extensions.iter().find(|e| e.extension_name_as_c_str() == name)?;
        let mut all = vk::PhysicalDeviceFeatures2::default().push_next(&mut features);
        instance.get_physical_device_features2(physical, &mut all);
        let mut all = vk::PhysicalDeviceProperties2::default().push_next(&mut sizes);
        instance.get_physical_device_properties2(physical, &mut all);
    }
    let able = [features.subgroup_size_control, features.compute_full_subgroups] == [vk::TRUE; 2];
    let in_compute = sizes.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE);
    (able && in_compute).then_some([sizes.min_subgroup_size, sizes.max_subgroup_size])
}

type Choice = (vk::PhysicalDevice, u32, Caps);

fn choose(instance: &ash::Instance, config: &GpuConfig) -> Result<Choice, Fault> {
    // SAFETY: the instance is alive.
    let all = unsafe { instance.enumerate_physical_devices() }.map_err(boot("vkEnumeratePhysicalDevices"))?;
    let usable: Vec<Choice> = all.into_iter().filter_map(|d| describe(instance, d)).collect();
    if usable.is_empty() {
        return Err(unavailable("no Vulkan 1.1 device with a compute queue"));
    }
    let names: Vec<String> = usable.iter().map(|(_, _, caps)| format!("\"{}\"", caps.name)).collect();
    let wanted = config.device.to_lowercase();
    usable
        .into_iter()
        .filter(|(_, _, caps)| caps.name.to_lowercase().contains(&wanted))
        .min_by_key(|c| c.2.kind)
        .ok_or_else(|| {
            Fault::new(
                FaultKind::Unavailable,
                "gpu.device",
                format!("no Vulkan device has \"{}\" in its name", config.device),
                format!("devices here: {}", names.join(", ")),
            )
        })
}

fn describe(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<Choice> {
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut maintenance = vk::PhysicalDeviceMaintenance3Properties::default();
    // SAFETY: `physical` is of this instance; the 1.1 query is made only of devices that have 1.1.
    let (families, properties) = unsafe {
        if instance.get_physical_device_properties(physical).api_version < vk::API_VERSION_1_1 {
            return None;
        }
        let mut all = vk::PhysicalDeviceProperties2::default().push_next(&mut subgroup).push_next(&mut maintenance);
        instance.get_physical_device_properties2(physical, &mut all);
        (instance.get_physical_device_queue_family_properties(physical), all.properties)
    };
    let in_compute = subgroup.supported_stages.contains(vk::ShaderStageFlags::COMPUTE);
    let family = families.iter().position(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE))?;
    let bits = families[family].timestamp_valid_bits;
    let kind = DeviceKind::new(properties.device_type);
    let limits = &properties.limits;
    let name = properties.device_name_as_c_str().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let caps = Caps {
        subgroup_size_required: false,
        subgroup_size_varies: name.contains("Intel"),
        subgroup_sizes: subgroup_sizes(instance, physical),
        name,
        kind,
        subgroup_size: subgroup.subgroup_size,
        subgroup_operations: if in_compute { subgroup.supported_operations.as_raw() } else { 0 },
        texel_buffers: kind == DeviceKind::Cpu
            && limits.max_texel_buffer_elements >= limits.max_storage_buffer_range / 4,
        invocations_max: limits.max_compute_work_group_invocations,
        shared_max_bytes: limits.max_compute_shared_memory_size,
        binding_max_bytes: u64::from(limits.max_storage_buffer_range),
        allocation_max_bytes: maintenance.max_memory_allocation_size,
        timestamp_period_ns: if bits == 0 { 0.0 } else { f64::from(limits.timestamp_period) },
        timestamp_bits: bits,
    };
    Some((physical, family as u32, caps))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Caps of an Intel GPU, as its driver reports them.
    fn intel() -> Caps {
        Caps {
            name: "Intel(R) Graphics".into(),
            kind: DeviceKind::Integrated,
            subgroup_size: 32,
            subgroup_operations: 0xff,
            texel_buffers: false,
            subgroup_size_required: false,
            subgroup_size_varies: true,
            subgroup_sizes: Some([8, 32]),
            invocations_max: 1024,
            shared_max_bytes: 48 << 10,
            binding_max_bytes: 1 << 30,
            allocation_max_bytes: 2 << 30,
            timestamp_period_ns: 0.0,
            timestamp_bits: 0,
        }
    }

    /// Width, and what kernels ask for with subgroups and without.
    fn settled(mut caps: Caps) -> (u32, [Option<u32>; 2]) {
        caps.settle_subgroup_size();
        let with = [capability::SHADER, capability::GROUP, capability::GROUP_VOTE];
        (caps.subgroup_size, [caps.asks_for(&with), caps.asks_for(&with[..1])])
    }

    #[test]
    fn one_width_is_asked_for_where_the_compiler_would_pick() {
        assert_eq!(settled(intel()), (16, [Some(16), None]));
        assert_eq!(settled(Caps { subgroup_sizes: Some([32, 32]), ..intel() }), (32, [Some(32), None]));
        assert_eq!(settled(Caps { subgroup_size_varies: false, ..intel() }), (32, [None; 2]));
        assert_eq!(settled(Caps { subgroup_operations: 0, ..intel() }), (32, [None; 2]), "the board forbids subgroups");
    }

    #[test]
    fn subgroups_are_not_used_where_their_width_varies_and_cannot_be_asked_for() {
        let mut caps = Caps { subgroup_sizes: None, ..intel() };
        assert!(caps.allows(capability::GROUP_VOTE));
        caps.settle_subgroup_size();
        assert!(!caps.allows(capability::GROUP_VOTE) && !caps.subgroup_size_required);
    }

    #[test]
    #[cfg(feature = "instruments")]
    fn a_profile_narrows_what_is_asked_for() {
        let limited = |profile: &str| {
            let mut caps = intel();
            let known = caps.limit(&GpuConfig { profile: profile.into(), ..GpuConfig::default() });
            assert!(known.is_ok(), "{profile}");
            settled(caps)
        };
        assert_eq!(limited("Intel Gen12"), (16, [Some(16), None]));
        assert_eq!(limited("Orin"), (32, [Some(32), None]));
        assert_eq!(limited("V3D 7.1"), (32, [None; 2]), "of another width");
    }
}
