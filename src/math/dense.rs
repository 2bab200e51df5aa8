//! Symmetric systems in fixed storage: `½ xᵀ H x + bᵀ x`, dimension up to a capacity bought once.
//!
//! Only the lower triangle of H is written and read. Solving scales the diagonal to one first, so
//! that metres, radians and biases do not cost digits, and factors LDLᵀ without exchange, skipping
//! pivots that are zero to working precision: an unobserved direction is dropped, not divided by
//! rounding noise.

use super::wide::wide;

/// A pivot that elimination brought under so many epsilons of its diagonal is rounding noise.
const PIVOT_EPSILONS: f64 = 100.0;

/// H and b of `½ xᵀ H x + bᵀ x`.
#[derive(Clone, Debug)]
pub struct System {
    h: Vec<f64>,
    pub b: Vec<f64>,
    scale: Vec<f64>,
    column: Vec<f64>,
    capacity: usize,
    pub dim: usize,
}

/// Consecutive columns: where they are in the system, and how many.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Columns {
    pub at: usize,
    pub len: usize,
}

impl System {
    pub fn new(capacity: usize) -> System {
        let (h, zeros) = (vec![0.0; capacity * capacity], || vec![0.0; capacity]);
        System { h, b: zeros(), scale: zeros(), column: zeros(), capacity, dim: 0 }
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

    /// Adds `AᵀB` of two rows, `of_rows` of A in the columns `rows`, and B in `columns`, which are not after them; of
    /// the same columns only the lower triangle.
    #[inline(always)]
    pub fn add_product(&mut self, rows: Columns, of_rows: [&[f64]; 2], columns: Columns, of_columns: [&[f64]; 2]) {
        for (p, (x, y)) in of_rows[0].iter().zip(of_rows[1]).enumerate() {
            let n = if rows.at == columns.at { p + 1 } else { columns.len };
            let to = &mut self.h[(rows.at + p) * self.capacity + columns.at..][..n];
            let pairs = of_columns[0].iter().zip(of_columns[1]);
            to.iter_mut().zip(pairs).for_each(|(h, (a, b))| *h += x * a + y * b);
        }
    }

    /// Adds `Aᵀr` of two rows.
    #[inline(always)]
    pub fn add_linear(&mut self, rows: Columns, of_rows: [&[f64]; 2], r: [f64; 2]) {
        let pairs = of_rows[0].iter().zip(of_rows[1]);
        self.b[rows.at..].iter_mut().zip(pairs).for_each(|(to, (x, y))| *to += x * r[0] + y * r[1]);
    }

    /// Scales the diagonal to one and factors, for `substitute`. Destroys the system.
    fn factor(&mut self) {
        let (n, c) = (self.dim, self.capacity);
        for i in 0..n {
            let d = self.h[i * c + i];
            self.b[i] = if d > 0.0 { 1.0 / d.sqrt() } else { 0.0 };
        }
        for i in 0..n {
            let s = self.b[i];
            let row = &mut self.h[i * c..][..=i];
            row.iter_mut().zip(&self.b[..=i]).for_each(|(h, t)| *h *= s * *t);
        }
        // The scales are kept where b was; elimination mixes b, so it gets them back.
        let mut scales = [0.0; crate::limits::WINDOW_DIM];
        scales[..n].copy_from_slice(&self.b[..n]);
        eliminate(self, n);
        self.b[..n].copy_from_slice(&scales[..n]);
    }

    /// Solves `H x = -r` with the factors. Skipped directions get zero.
    fn substitute(&self, r: &[f64], x: &mut [f64]) {
        let (n, c) = (self.dim, self.capacity);
        for i in 0..n {
            let mut s = -r[i] * self.b[i];
            let row = &self.h[i * c..][..i];
            row.iter().zip(&*x).for_each(|(l, x)| s -= *l * *x);
            x[i] = s;
        }
        for k in (0..n).rev() {
            let d = self.h[k * c + k];
            if d == 0.0 {
                x[k] = 0.0;
                continue;
            }
            let mut s = x[k] / d;
            (k + 1..n).for_each(|i| s -= self.h[i * c + k] * x[i]);
            x[k] = s;
        }
        x[..n].iter_mut().zip(&self.b).for_each(|(x, s)| *x *= *s);
    }

    /// Solves `(H + diag) x = -b`, factored in `factor`, refined once with the residual, which takes
    /// back most of what rounding cost.
    pub fn solve_damped(&self, diag: impl Fn(f64) -> f64, factor: &mut System, x: &mut [f64]) {
        let n = self.dim;
        factor.copy_from(self);
        for i in 0..n {
            factor.add(i, i, diag(self.at(i, i)));
        }
        factor.factor();
        let mut part = [0.0; crate::limits::WINDOW_DIM];
        let mut r = [0.0; crate::limits::WINDOW_DIM];
        x[..n].fill(0.0);
        for _ in 0..2 {
            (0..n).for_each(|i| r[i] = self.b[i]);
            for i in 0..n {
                let row = &self.h[i * self.capacity..][..=i];
                let mut s = (row[i] + diag(row[i])) * x[i];
                for j in 0..i {
                    s += row[j] * x[j];
                    r[j] += row[j] * x[i];
                }
                r[i] += s;
            }
            factor.substitute(&r, &mut part);
            x.iter_mut().zip(&part).for_each(|(x, d)| *x += d);
        }
    }

    /// Standard deviations of the first variables, were this the information of all; infinite where there is
    /// none. Factored in `factor`.
    pub fn deviations(&self, factor: &mut System, out: &mut [f64]) {
        factor.copy_from(self);
        factor.factor();
        let mut x = [0.0; crate::limits::WINDOW_DIM];
        let mut r = [0.0; crate::limits::WINDOW_DIM];
        for (i, out) in out.iter_mut().enumerate() {
            r[i] = -1.0;
            factor.substitute(&r, &mut x);
            r[i] = 0.0;
            *out = if x[i] > 0.0 { x[i].sqrt() } else { f64::INFINITY };
        }
    }
}

wide! {
    /// Eliminates the first `m` variables in place: the trailing block of (H, b) becomes the Schur
    /// complement, the leading columns hold L and the leading diagonal D (0 where skipped).
    pub fn eliminate<'a>(system: &'a mut System, m: usize) -> () {
        let (n, c) = (system.dim, system.capacity);
        let least = PIVOT_EPSILONS * f64::EPSILON;
        for i in 0..n {
            system.scale[i] = system.h[i * c + i];
        }
        for k in 0..m {
            let d = system.h[k * c + k];
            if !(d > least * system.scale[k]) {
                system.h[k * c + k] = 0.0;
                (k + 1..n).for_each(|i| system.h[i * c + k] = 0.0);
                continue;
            }
            // Column k, contiguous, so that the update below vectorises.
            for i in k + 1..n {
                system.column[i] = system.h[i * c + k];
            }
            let bk = system.b[k];
            for i in k + 1..n {
                let l = system.column[i] / d;
                if l == 0.0 {
                    continue;
                }
                let row = &mut system.h[i * c..][..=i];
                for (x, y) in row[k + 1..].iter_mut().zip(&system.column[k + 1..=i]) {
                    *x -= l * *y;
                }
                row[k] = l;
                system.b[i] -= l * bk;
            }
        }
    }
}

wide! {
    /// Adds a product of rows `[A | b]` (lower triangle, see `qr::Rows::gram`) whose columns, from
    /// `first`, belong to `parts`, ascending, with b after them.
    pub fn add_gram<'a>(
        system: &'a mut System,
        gram: &'a [f64],
        stride: usize,
        first: usize,
        parts: &'a [Columns],
    ) -> () {
        let mut i = first;
        for (k, rows) in parts.iter().enumerate() {
            for r in 0..rows.len {
                let from = &gram[i * stride..][..stride];
                let to = &mut system.h[(rows.at + r) * system.capacity..][..system.capacity];
                let mut j = first;
                for columns in &parts[..k] {
                    let pairs = to[columns.at..].iter_mut().zip(&from[j..]);
                    pairs.take(columns.len).for_each(|(to, from)| *to += *from);
                    j += columns.len;
                }
                let pairs = to[rows.at..].iter_mut().zip(&from[j..]);
                pairs.take(r + 1).for_each(|(to, from)| *to += *from);
                i += 1;
            }
        }
        let from = &gram[i * stride..][..stride];
        let mut j = first;
        for part in parts {
            let pairs = system.b[part.at..].iter_mut().zip(&from[j..]);
            pairs.take(part.len).for_each(|(to, from)| *to += *from);
            j += part.len;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example(n: usize) -> System {
        let mut s = System::new(n);
        s.clear(n);
        // Gram matrix of a fixed full-rank set of rows, with columns of very different units.
        for r in 0..3 * n {
            let unit = |i: usize| if i % 3 == 0 { 1e3 } else { 1e-2 };
            let row: Vec<f64> = (0..n).map(|i| ((r * 7 + i * 13 + r * i) as f64).sin() * unit(i)).collect();
            for i in 0..n {
                s.b[i] += row[i] * (r as f64).cos();
                (0..=i).for_each(|j| s.add(i, j, row[i] * row[j]));
            }
        }
        s
    }

    fn solved(s: &System) -> Vec<f64> {
        let mut x = vec![f64::NAN; s.dim];
        s.solve_damped(|_| 0.0, &mut s.clone(), &mut x);
        x
    }

    fn residual() -> f64 {
        let s = example(20);
        let x = solved(&s);
        let row = |i: usize| (0..20).map(|j| s.at(i, j) * x[j]).sum::<f64>();
        (0..20).map(|i| (row(i) + s.b[i]).abs() / s.at(i, i).sqrt()).fold(0.0, f64::max)
    }

    #[test]
    fn solution_satisfies_the_system() {
        assert!(residual() < 1e-12, "{}", residual());
    }

    #[test]
    fn eliminated_system_has_the_solution_of_the_full_one() {
        let s = example(12);
        let x = solved(&s);
        let mut e = s.clone();
        eliminate(&mut e, 5);
        let mut kept = System::new(7);
        kept.clear(7);
        for i in 0..7 {
            kept.b[i] = e.b[5 + i];
            (0..=i).for_each(|j| kept.add(i, j, e.at(5 + i, 5 + j)));
        }
        let z = solved(&kept);
        assert!((0..7).all(|i| (z[i] - x[5 + i]).abs() < 1e-9 * (1.0 + x[5 + i].abs())));
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
        let x = solved(&s);
        assert!((x[0] + x[1] - 1.0).abs() < 1e-12 && (x[2] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn product_of_rows_lands_in_its_spans() {
        let mut rows = super::super::qr::Rows::new(5, 5);
        rows.clear(5);
        for r in 0..5 {
            let row = rows.push();
            (0..5).for_each(|c| row[c] = ((r * 3 + c * c) as f64).cos());
        }
        let mut gram = vec![0.0; super::super::qr::Rows::gram_len(5)];
        let stride = rows.gram(0, &mut gram);
        let mut s = System::new(8);
        s.clear(8);
        // The first column is left out, the second goes to 1, the others to 4 and 5.
        add_gram(&mut s, &gram, stride, 1, &[Columns { at: 1, len: 1 }, Columns { at: 4, len: 2 }]);
        let dot = |i: usize, j: usize| (0..5).map(|r| rows.row(r)[i] * rows.row(r)[j]).sum::<f64>();
        for (i, a) in [(1, 1), (4, 2), (5, 3)] {
            assert!((s.b[i] - dot(a, 4)).abs() < 1e-14);
            for (j, b) in [(1, 1), (4, 2), (5, 3)] {
                assert!((s.at(i, j) - dot(a, b)).abs() < 1e-14, "{i} {j}");
            }
        }
        assert_eq!((s.at(0, 0), s.at(2, 1)), (0.0, 0.0));
    }
}
