//! Rotations and the small dense algebra of the estimator.

pub mod block;
pub mod dense;
pub mod qr;
pub mod so3;
pub(crate) mod wide;
