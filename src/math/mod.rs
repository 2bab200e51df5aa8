//! Rotations and the small dense algebra of the estimator.

pub mod dense;
pub mod so3;
