//! Limits of the GPUs of small boards, applied to another device: a kernel, a buffer or a budget that the board's GPU would
//! refuse is refused, and what is chosen by the kind of device is chosen as there. Memory types and heaps stay the device's.
//! Numbers are those of Mesa's drivers (v3dv, panvk, anv) and, for Orin, of reports and of NVIDIA's desktop driver; where
//! versions of a driver differ, the tighter one.

use stipple_drivers::{Fault, FaultKind};

const KIB: u32 = 1 << 10;
const GIB: u64 = 1 << 30;
/// Vulkan 1.1's, in the order of the bits: basic, vote, arithmetic, ballot, shuffle, relative shuffle, clustered, quad.
const OPERATIONS_ALL: u32 = 0xff;
/// All but arithmetic, which newer versions of v3dv have, and clustered.
const OPERATIONS_V3D: u32 = 0xbb;

/// Limits of a GPU for compute kernels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Profile {
    pub name: &'static str,
    /// The least and the greatest width of subgroup; where they differ, the compiler picks one for each kernel.
    pub subgroup_sizes: [u32; 2],
    /// Bits of VkSubgroupFeatureFlagBits.
    pub subgroup_operations: u32,
    pub invocations_max: u32,
    /// Invocations of a workgroup in each dimension; like `buffers_max`, `push_max_bytes` and `alignment` for tests alone, as
    /// the build or `gpu::ALIGN` keeps every kernel within the least of them.
    pub local_max: [u32; 3],
    pub shared_max_bytes: u32,
    /// Storage buffers of one kernel.
    pub buffers_max: u32,
    pub push_max_bytes: u32,
    pub binding_max_bytes: u64,
    /// What the start of a bound buffer is a multiple of, bytes.
    pub alignment: u64,
    /// Largest single buffer and allocation, bytes.
    pub allocation_max_bytes: u64,
    /// Whether its queue has timestamps under every driver.
    pub timestamps: bool,
}

/// Raspberry Pi 5, RK3588, N100 and its like, Orin. 16-bit floats and 64-bit integers count as absent everywhere.
pub const PROFILES: [Profile; 4] = [
    Profile {
        name: "V3D 7.1",
        subgroup_sizes: [16; 2],
        subgroup_operations: OPERATIONS_V3D,
        invocations_max: 256,
        local_max: [256; 3],
        shared_max_bytes: 16 * KIB,
        buffers_max: 8,
        push_max_bytes: 128,
        binding_max_bytes: GIB / 8,
        alignment: 32,
        allocation_max_bytes: GIB,
        timestamps: true,
    },
    Profile {
        name: "Mali-G610",
        subgroup_sizes: [16; 2],
        subgroup_operations: OPERATIONS_ALL,
        invocations_max: 1024,
        local_max: [1024; 3],
        shared_max_bytes: 32 * KIB,
        buffers_max: 64,
        push_max_bytes: 256,
        binding_max_bytes: GIB,
        alignment: 4,
        allocation_max_bytes: GIB,
        timestamps: false,
    },
    Profile {
        name: "Intel Gen12",
        subgroup_sizes: [8, 32],
        subgroup_operations: OPERATIONS_ALL,
        invocations_max: 1024,
        local_max: [1024; 3],
        shared_max_bytes: 48 * KIB,
        buffers_max: 65_535,
        push_max_bytes: 128,
        binding_max_bytes: GIB,
        alignment: 64,
        allocation_max_bytes: 2 * GIB,
        timestamps: true,
    },
    Profile {
        name: "Orin",
        subgroup_sizes: [32; 2],
        subgroup_operations: OPERATIONS_ALL,
        invocations_max: 1024,
        local_max: [1024, 1024, 64],
        shared_max_bytes: 48 * KIB,
        buffers_max: 65_535,
        push_max_bytes: 256,
        binding_max_bytes: 4 * GIB - 1,
        alignment: 16,
        allocation_max_bytes: 2 * GIB,
        timestamps: true,
    },
];

impl Profile {
    /// The profile of a name; none of an empty one.
    pub fn of(name: &str) -> Result<Option<&'static Profile>, Fault> {
        let found = PROFILES.iter().find(|profile| profile.name == name);
        if found.is_none() && !name.is_empty() {
            let known = PROFILES.map(|profile| format!("\"{}\"", profile.name)).join(", ");
            let what = format!("no GPU is known as \"{name}\"");
            return Err(Fault::new(FaultKind::Config, "gpu.profile", what, format!("one of {known}")));
        }
        Ok(found)
    }
}
