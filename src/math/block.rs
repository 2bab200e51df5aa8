//! Three by three blocks of larger matrices, from and to the vector types the rest of the program uses.

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SMatrix, Vector3};

/// The block whose first row and column these are.
pub fn block<const R: usize, const C: usize>(m: &SMatrix<f64, R, C>, row: usize, col: usize) -> DMat3 {
    DMat3::from_cols_array_2d(&std::array::from_fn(|c| std::array::from_fn(|r| m[(row + r, col + c)])))
}

/// Sets that block.
pub fn put<const R: usize, const C: usize>(m: &mut SMatrix<f64, R, C>, row: usize, col: usize, x: DMat3) {
    for c in 0..3 {
        for r in 0..3 {
            m[(row + r, col + c)] = x.col(c)[r];
        }
    }
}

/// The same vector for nalgebra.
pub fn vector(v: DVec3) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}

/// The same matrix for nalgebra.
pub fn matrix(m: DMat3) -> Matrix3<f64> {
    Matrix3::from_fn(|i, j| m.col(j)[i])
}
