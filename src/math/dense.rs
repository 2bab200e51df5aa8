//! Symmetric systems in fixed storage: `½ xᵀ H x + bᵀ x`, dimension up to a capacity bought once.
//!
//! Only the lower triangle of H is written and read. Factorisation is an unpivoted LDLᵀ that skips
//! pivots that are zero to working precision, so eliminating an unobserved direction drops it
//! instead of dividing by rounding noise.

/// A pivot smaller than this fraction of its diagonal before elimination is rounding noise.
const PIVOT_MIN: f64 = 1e-13;

#[derive(Clone, Debug)]
pub struct System {
    h: Vec<f64>,
    pub b: Vec<f64>,
    capacity: usize,
    pub dim: usize,
}

impl System {
    pub fn new(capacity: usize) -> System {
        System { h: vec![0.0; capacity * capacity], b: vec![0.0; capacity], capacity, dim: 0 }
    }

    pub fn bytes(capacity: usize) -> usize {
        (capacity * capacity + capacity) * size_of::<f64>()
    }

    /// Sets the dimension and zeroes.
    pub fn clear(&mut self, dim: usize) {
        debug_assert!(dim <= self.capacity);
        self.dim = dim;
        self.b[..dim].fill(0.0);
        for i in 0..dim {
            self.h[i * self.capacity..][..dim].fill(0.0);
        }
    }

    pub fn copy_from(&mut self, other: &System) {
        self.dim = other.dim;
        self.b[..other.dim].copy_from_slice(&other.b[..other.dim]);
        for i in 0..other.dim {
            self.h[i * self.capacity..][..=i].copy_from_slice(&other.h[i * other.capacity..][..=i]);
        }
    }

    /// Element of the symmetric matrix.
    #[inline]
    pub fn at(&self, i: usize, j: usize) -> f64 {
        let (i, j) = if i >= j { (i, j) } else { (j, i) };
        self.h[i * self.capacity + j]
    }

    /// Adds to the pair (i, j) = (j, i).
    #[inline]
    pub fn add(&mut self, i: usize, j: usize, x: f64) {
        let (i, j) = if i >= j { (i, j) } else { (j, i) };
        self.h[i * self.capacity + j] += x;
    }

    /// The first `n` entries of row `i` from column `j`; inside the lower triangle or a diagonal block.
    #[inline]
    pub fn row_mut(&mut self, i: usize, j: usize, n: usize) -> &mut [f64] {
        &mut self.h[i * self.capacity + j..][..n]
    }

    /// `y = H x`.
    pub fn multiply(&self, x: &[f64], y: &mut [f64]) {
        y[..self.dim].fill(0.0);
        for i in 0..self.dim {
            let row = &self.h[i * self.capacity..][..=i];
            let mut s = row[i] * x[i];
            for j in 0..i {
                s += row[j] * x[j];
                y[j] += row[j] * x[i];
            }
            y[i] += s;
        }
    }

    /// Eliminates the first `m` variables in place: the trailing block of (H, b) becomes the Schur
    /// complement, the leading columns hold L and the leading diagonal D (0 where skipped).
    pub fn eliminate(&mut self, m: usize) {
        let (n, c) = (self.dim, self.capacity);
        let mut diagonal = [0.0; crate::limits::WINDOW_DIM];
        for i in 0..n {
            diagonal[i] = self.h[i * c + i];
        }
        for k in 0..m {
            let d = self.h[k * c + k];
            if !(d > PIVOT_MIN * diagonal[k]) {
                self.h[k * c + k] = 0.0;
                (k + 1..n).for_each(|i| self.h[i * c + k] = 0.0);
                continue;
            }
            // Column k, contiguous, so that the update below vectorises.
            let mut column = [0.0; crate::limits::WINDOW_DIM];
            for i in k + 1..n {
                column[i] = self.h[i * c + k];
            }
            let bk = self.b[k];
            for i in k + 1..n {
                let l = column[i] / d;
                if l == 0.0 {
                    continue;
                }
                let row = &mut self.h[i * c..][..=i];
                for (x, y) in row[k + 1..].iter_mut().zip(&column[k + 1..=i]) {
                    *x -= l * y;
                }
                row[k] = l;
                self.b[i] -= l * bk;
            }
        }
    }

    /// Solves `H x = -b` into `x`, destroying the system. Skipped directions get zero.
    pub fn solve(&mut self, x: &mut [f64]) {
        let (n, c) = (self.dim, self.capacity);
        self.eliminate(n);
        // After elimination b = D Lᵀ(-x) row by row.
        for k in (0..n).rev() {
            let d = self.h[k * c + k];
            let mut s = if d == 0.0 { 0.0 } else { -self.b[k] / d };
            for i in k + 1..n {
                s -= self.h[i * c + k] * x[i];
            }
            x[k] = if d == 0.0 { 0.0 } else { s };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example(n: usize) -> System {
        let mut s = System::new(n);
        s.clear(n);
        // Gram matrix of a fixed full-rank set of rows.
        for r in 0..3 * n {
            let row: Vec<f64> = (0..n).map(|i| ((r * 7 + i * 13 + r * i) as f64).sin()).collect();
            for i in 0..n {
                s.b[i] += row[i] * (r as f64).cos();
                (0..=i).for_each(|j| s.add(i, j, row[i] * row[j]));
            }
        }
        s
    }

    #[test]
    fn solve_satisfies_the_system() {
        let s = example(20);
        let (mut x, mut y) = (vec![0.0; 20], vec![0.0; 20]);
        s.clone().solve(&mut x);
        s.multiply(&x, &mut y);
        assert!((0..20).all(|i| (y[i] + s.b[i]).abs() < 1e-10));
    }

    #[test]
    fn eliminated_system_has_the_solution_of_the_full_one() {
        let s = example(12);
        let mut x = vec![0.0; 12];
        s.clone().solve(&mut x);
        let mut e = s.clone();
        e.eliminate(5);
        let mut kept = System::new(7);
        kept.clear(7);
        for i in 0..7 {
            kept.b[i] = e.b[5 + i];
            (0..=i).for_each(|j| kept.add(i, j, e.at(5 + i, 5 + j)));
        }
        let mut z = vec![0.0; 7];
        kept.solve(&mut z);
        assert!((0..7).all(|i| (z[i] - x[5 + i]).abs() < 1e-9));
    }

    #[test]
    fn unobserved_direction_is_dropped() {
        let mut s = System::new(3);
        s.clear(3);
        // Only x0 + x1 and x2 are observed.
        for (i, j) in [(0, 0), (1, 0), (1, 1)] {
            s.add(i, j, 1.0);
        }
        s.add(2, 2, 4.0);
        s.b.copy_from_slice(&[-1.0, -1.0, -4.0]);
        let mut x = vec![f64::NAN; 3];
        s.solve(&mut x);
        assert!((x[0] + x[1] - 1.0).abs() < 1e-12 && (x[2] - 1.0).abs() < 1e-12);
    }
}
