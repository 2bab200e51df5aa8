//! Kernels against their twins, on whatever Vulkan device there is (lavapipe in CI).
#![allow(clippy::unwrap_used)]

mod exposure;
mod fisheye;
mod harmonics;
mod held_out;
mod occupancy;
mod pool;
mod raster;
mod sort;
mod speed;
mod splat;
mod stiff;
mod twins;
