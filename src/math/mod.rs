//! Rotations and rigid transforms (one perturbation convention).
pub mod so3;
