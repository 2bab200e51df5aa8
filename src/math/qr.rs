//! Rows of a linear least-squares problem, `‖A x + b‖²`, and their Householder QR.
//!
//! A row is `[A | b]`. Orthogonal transforms of the rows change neither the sum of squares nor its
//! minimum, and never square the condition of A. Columns that depend on earlier ones to working
//! precision are recognized (rank-revealing without column exchange, so that the caller's order of
//! elimination stands): what rounding left of them is dropped, so that a direction nobody observed
//! stays unobserved.

use super::wide::wide;

/// What is left of a column is rounding when it is under this many epsilons of its length before
/// elimination: a few roundings in each of a hundred reflections.
const RANK_EPSILONS: f64 = 200.0;
/// The same of squared lengths.
pub const RANK_SQUARE: f64 = RANK_EPSILONS * RANK_EPSILONS * f64::EPSILON * f64::EPSILON;
/// Elements a row is padded to: a whole number of the widest vectors.
const LANES: usize = 8;
/// Rows of the product computed together, to use each load several times.
const GRAM_ROWS: usize = 4;

/// `[A | b]`, row-major, with capacity bought once.
#[derive(Clone, Debug)]
pub struct Rows {
    a: Vec<f64>,
    /// The reflection's combination of rows, and its vector.
    combination: Vec<f64>,
    reflection: Vec<f64>,
    /// Squared length of each column when elimination began.
    lengths: Vec<f64>,
    rows: usize,
    cols: usize,
    stride: usize,
    rows_max: usize,
    /// Columns that were not finite in the last elimination, and were taken for zero.
    not_finite: u64,
}

const fn padded(n: usize) -> usize {
    n.div_ceil(LANES) * LANES
}

impl Rows {
    /// Room for `rows_max` rows of `cols_max` columns, b included.
    pub fn new(rows_max: usize, cols_max: usize) -> Rows {
        let stride = padded(cols_max);
        Rows {
            a: vec![0.0; rows_max * stride],
            combination: vec![0.0; stride],
            reflection: vec![0.0; rows_max],
            lengths: vec![0.0; stride],
            rows: 0,
            cols: 0,
            stride: 0,
            rows_max,
            not_finite: 0,
        }
    }

    /// Empties, for rows of `cols` columns, b included.
    pub fn clear(&mut self, cols: usize) {
        (self.rows, self.cols, self.stride) = (0, cols, padded(cols));
        debug_assert!(self.rows_max * self.stride <= self.a.len());
    }

    /// Rows there are.
    pub fn count(&self) -> usize {
        self.rows
    }

    /// Columns there are, b included.
    pub fn cols(&self) -> usize {
        self.cols
    }

    /// Rows that can still be pushed.
    pub fn room(&self) -> usize {
        self.rows_max - self.rows
    }

    /// A new row of zeros.
    #[inline]
    pub fn push(&mut self) -> &mut [f64] {
        debug_assert!(self.rows < self.rows_max);
        let row = &mut self.a[self.rows * self.stride..][..self.stride];
        row.fill(0.0);
        self.rows += 1;
        &mut row[..self.cols]
    }

    #[inline]
    pub fn row(&self, i: usize) -> &[f64] {
        &self.a[i * self.stride..][..self.cols]
    }

    #[inline]
    pub fn row_mut(&mut self, i: usize) -> &mut [f64] {
        &mut self.a[i * self.stride..][..self.cols]
    }

    /// Eliminates columns `0..n`: afterwards the first `rank` rows are triangular in them, and the others
    /// do not contain them. Answers the rank.
    pub fn eliminate(&mut self, n: usize) -> usize {
        self.measure(n);
        reflect(self, 0, n, 0)
    }

    /// Eliminates columns `0..n` and drops the rows that hold them; makes what is left triangular and drops the
    /// rows in which no column is left. Answers how many columns were not finite, and were taken for zero.
    pub fn marginalize(&mut self, n: usize) -> u64 {
        self.not_finite = 0;
        self.measure(self.cols);
        let rank = reflect(self, 0, n, 0);
        let last = reflect(self, n, self.cols - 1, rank);
        self.a.copy_within(rank * self.stride..last * self.stride, 0);
        self.rows = last - rank;
        self.not_finite
    }

    /// Leaves as few rows as hold the same information.
    pub fn triangularize(&mut self) {
        self.marginalize(0);
    }

    fn measure(&mut self, columns: usize) {
        let (stride, n) = (self.stride, padded(columns));
        self.lengths[..n].fill(0.0);
        for row in self.a[..self.rows * stride].chunks_exact(stride) {
            for (l, x) in self.lengths[..n].iter_mut().zip(row) {
                *l += *x * *x;
            }
        }
    }

    /// `[A | b]ᵀ [A | b]` of the rows from `first`, lower triangle, into `out` with the stride it answers.
    pub fn gram(&self, first: usize, out: &mut [f64]) -> usize {
        let stride = self.stride;
        gram(&self.a[first * stride..self.rows * stride], stride, self.cols, out);
        stride
    }

    /// Elements `gram` writes at most.
    pub const fn gram_len(cols_max: usize) -> usize {
        padded(cols_max) * padded(cols_max)
    }
}

wide! {
    /// Householder reflections of columns `from..to`, the first of them to row `pivot`; answers the row after the
    /// last. A column that depends on earlier ones takes no row.
    fn reflect<'a>(rows: &'a mut Rows, from: usize, to: usize, pivot: usize) -> usize {
        let mut pivot = pivot;
        let stride = rows.stride;
        for c in from..to {
            if pivot == rows.rows {
                break;
            }
            let v = &mut rows.reflection[..rows.rows];
            let mut square = 0.0;
            for i in pivot..rows.rows {
                v[i] = rows.a[i * stride + c];
                square += v[i] * v[i];
            }
            // Also false where anything is not finite.
            if !(square > RANK_SQUARE * rows.lengths[c]) {
                rows.not_finite += u64::from(!(square + rows.lengths[c]).is_finite());
                (pivot..rows.rows).for_each(|i| rows.a[i * stride + c] = 0.0);
                continue;
            }
            let norm = square.sqrt();
            let x = v[pivot];
            let (alpha, size) = if x > 0.0 { (-norm, x) } else { (norm, -x) };
            v[pivot] = x - alpha;
            let scale = 1.0 / (norm * (norm + size));
            // From the lane c is in, so that the loops below stay aligned.
            let begin = c / LANES * LANES;
            let w = &mut rows.combination[begin..stride];
            w.fill(0.0);
            for i in pivot..rows.rows {
                // Rows are sparse before they are mixed.
                if v[i] != 0.0 {
                    let row = &rows.a[i * stride + begin..(i + 1) * stride];
                    w.iter_mut().zip(row).for_each(|(w, x)| *w += v[i] * *x);
                }
            }
            w.iter_mut().for_each(|w| *w *= scale);
            w[..c - begin].fill(0.0);
            for i in pivot..rows.rows {
                if v[i] != 0.0 {
                    let row = &mut rows.a[i * stride + begin..(i + 1) * stride];
                    row.iter_mut().zip(&*w).for_each(|(x, w)| *x -= v[i] * *w);
                }
            }
            rows.a[pivot * stride + c] = alpha;
            (pivot + 1..rows.rows).for_each(|i| rows.a[i * stride + c] = 0.0);
            pivot += 1;
        }
        pivot
    }
}

wide! {
    /// Lower triangle of the product of rows `stride` long, of which `cols` columns count.
    fn gram<'a>(rows: &'a [f64], stride: usize, cols: usize, out: &'a mut [f64]) -> () {
        for i in (0..cols).step_by(GRAM_ROWS) {
            for j in (0..i + GRAM_ROWS).step_by(LANES) {
                let mut sum = [[0.0; LANES]; GRAM_ROWS];
                for row in rows.chunks_exact(stride) {
                    let right: &[f64; LANES] = row[j..j + LANES].try_into().expect("rows are padded to lanes");
                    let left: &[f64; GRAM_ROWS] = row[i..i + GRAM_ROWS].try_into().expect("lanes are whole");
                    for (sum, x) in sum.iter_mut().zip(left) {
                        for (s, y) in sum.iter_mut().zip(right) {
                            *s += *x * *y;
                        }
                    }
                }
                for (k, sum) in sum.iter().enumerate() {
                    out[(i + k) * stride + j..][..LANES].copy_from_slice(sum);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example(rows: usize, cols: usize) -> Rows {
        let mut a = Rows::new(rows, cols);
        a.clear(cols);
        for r in 0..rows {
            let row = a.push();
            (0..cols).for_each(|c| row[c] = ((r * 7 + c * 13 + r * c) as f64).sin());
        }
        a
    }

    fn gram(a: &Rows, first: usize) -> Vec<Vec<f64>> {
        let mut out = vec![0.0; Rows::gram_len(a.cols())];
        let stride = a.gram(first, &mut out);
        (0..a.cols()).map(|i| (0..=i).map(|j| out[i * stride + j]).collect()).collect()
    }

    fn close(a: &[Vec<f64>], b: &[Vec<f64>], tolerance: f64) {
        for (a, b) in a.iter().flatten().zip(b.iter().flatten()) {
            assert!((a - b).abs() <= tolerance, "{a} {b}");
        }
    }

    #[test]
    fn column_that_is_not_finite_is_told() {
        let mut rows = Rows::new(4, 4);
        rows.clear(4);
        rows.push().copy_from_slice(&[1.0, 2.0, 3.0, 4.0]);
        rows.push().copy_from_slice(&[0.0, 1.0, 2.0, 3.0]);
        let mut broken = rows.clone();
        broken.row_mut(1)[1] = f64::NAN;
        assert_eq!(rows.marginalize(1), 0);
        assert!(broken.marginalize(1) > 0);
    }

    #[test]
    fn product_is_that_of_the_rows() {
        let a = example(11, 13);
        let dot = |i: usize, j: usize| (0..11).map(|r| a.row(r)[i] * a.row(r)[j]).sum::<f64>();
        let expected: Vec<Vec<f64>> = (0..13).map(|i| (0..=i).map(|j| dot(i, j)).collect()).collect();
        close(&gram(&a, 0), &expected, 1e-13);
    }

    #[test]
    fn elimination_and_triangularization_keep_the_product() {
        let tolerance = 1e-12;
        let a = example(30, 12);
        let mut b = a.clone();
        assert_eq!(b.eliminate(5), 5);
        close(&gram(&a, 0), &gram(&b, 0), tolerance);
        assert!((0..30).all(|r| (0..5.min(r)).all(|c| b.row(r)[c] == 0.0)));
        // What no column explains is dropped: all but b's own square stays.
        let mut c = a.clone();
        c.triangularize();
        assert_eq!(c.count(), 11);
        let (before, after) = (gram(&a, 0), gram(&c, 0));
        close(&before[..11], &after[..11], tolerance);
        assert!(after[11][11] < before[11][11]);
        (0..11).for_each(|j| assert!((after[11][j] - before[11][j]).abs() < tolerance));
    }

    #[test]
    fn dependent_columns_are_recognised() {
        // The third column is the sum of the first two, the fourth is nobody's.
        let mut a = example(40, 8);
        let n = a.stride;
        for r in 0..40 {
            let row = &mut a.a[r * n..][..n];
            (row[2], row[3]) = (row[0] + row[1], 0.0);
        }
        let rank = a.eliminate(5);
        assert!((rank..40).all(|r| a.row(r)[2] == 0.0 && a.row(r)[3] == 0.0));
        assert_eq!(rank, 3);
    }

    #[test]
    fn rows_that_are_not_finite_are_not_made_worse() {
        let mut a = example(6, 4);
        a.a[3] = f64::NAN;
        assert!(a.eliminate(3) <= 3);
    }
}
