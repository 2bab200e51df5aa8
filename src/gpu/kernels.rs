//! The kernels of shaders-glsl/, one module each, written by the build from their SPIR-V.
#![allow(clippy::all, dead_code, unused_imports, unused_mut)]

include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
