//! The mapper.
