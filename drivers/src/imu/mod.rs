//! Inertial units.

pub mod edges;
