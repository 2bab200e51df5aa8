//! Kernels against their f64 twins, on whatever Vulkan device there is (lavapipe in CI).
#![allow(clippy::unwrap_used)]

mod speed;
mod splat;
mod twins;
