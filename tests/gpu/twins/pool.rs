//! Twins of prune.comp, repack.comp, importance.comp, move_block.comp and the word of importance.glsl.

use glam::{DMat3, DQuat, DVec3, DVec4};
use stipple_drivers::Pose;

/// A Gaussian and its Adam moments: mean, log scale, quaternion; first and second moments of mean and quaternion.
#[derive(Clone, Copy, Debug)]
pub struct Moved {
    pub mean: DVec3,
    pub quat: DVec4,
    pub m_mean: DVec3,
    pub v_mean: DVec3,
    pub m_quat: DVec4,
    pub v_quat: DVec4,
}

pub fn move_block(s: &Moved, by: &Pose) -> Moved {
    let turn = by.rotation();
    let squared = DMat3::from_cols_array(&turn.to_cols_array().map(|v| v * v));
    // Column i of q ⊗ · is q ⊗ e_i.
    let basis: [DVec4; 4] = std::array::from_fn(|i| DVec4::from(by.q * DQuat::from_vec4(DVec4::AXES[i])));
    let left = |p: DVec4, f: fn(f64) -> f64| {
        (0..4).fold(DVec4::ZERO, |sum, i| sum + basis[i].to_array().map(f).into_vec() * p[i])
    };
    Moved {
        mean: by.transform(s.mean),
        quat: left(s.quat, |v| v),
        m_mean: turn * s.m_mean,
        v_mean: squared * s.v_mean,
        m_quat: left(s.m_quat, |v| v),
        v_quat: left(s.v_quat, |v| v * v),
    }
}

trait IntoVec {
    fn into_vec(self) -> DVec4;
}

impl IntoVec for [f64; 4] {
    fn into_vec(self) -> DVec4 {
        DVec4::from_array(self)
    }
}

pub fn steps_of(state: u32) -> u32 {
    state & 0xffff
}

pub fn importance_of(state: u32) -> f64 {
    f64::from(f32::from_bits(state & 0xffff_0000))
}

/// In f64 but for the rounding to the upper half of a float.
pub fn after_step(state: u32, worth: f64) -> u32 {
    let count = (steps_of(state) + 1).min(65535);
    let before = importance_of(state);
    let importance = if count == 1 { worth } else { before + (worth - before) / 16.0 };
    ((importance as f32).to_bits() + 0x8000) & 0xffff_0000 | count
}

/// Quarter octaves from 2^-63 of the judged.
pub fn importance(states: &[u32], steps_min: u32) -> [u32; 256] {
    let mut bins = [0; 256];
    for s in states.iter().filter(|s| steps_of(**s) >= steps_min) {
        let v = importance_of(*s);
        // Within an octave bins are linear, as the mantissa is.
        let octave = v.log2().floor();
        let bin = 4.0 * (octave + 63.0) + (4.0 * (v / octave.exp2() - 1.0)).floor();
        bins[if v > 0.0 { bin.clamp(0.0, 255.0) as usize } else { 0 }] += 1;
    }
    bins
}

/// What is kept, in order.
pub fn repack<T: Copy>(items: &[T], kept: &[bool]) -> Vec<T> {
    items.iter().zip(kept).filter(|(_, k)| **k).map(|(item, _)| *item).collect()
}
