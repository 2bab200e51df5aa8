//! The mapper.

pub mod anchors;
pub mod buffers;
pub mod evaluate;
pub mod keyframes;
pub mod occupancy;
pub mod pipeline;
pub mod pool;
pub mod pose;
pub mod schedule;
pub mod sort;
