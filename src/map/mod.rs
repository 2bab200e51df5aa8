//! The mapper.

pub mod buffers;
pub mod pipeline;
pub mod pool;
pub mod sort;
