//! Raw Vulkan compute core.
