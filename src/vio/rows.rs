//! The rows `[J | r]` of one factor: only the columns it touches, and how they go into a system or a stack.

use crate::limits::{CAMERAS_MAX, FRAMES, HEIGHT_DIM, LANDMARKS, OBSERVATIONS, RIG_DIM, WINDOW_DIM};
use crate::math::dense::{add_gram, Columns, System};
use crate::math::qr::Rows;
use crate::mem::List;

/// Columns of a point, first in the rows of a landmark.
pub const POINT_DIM: usize = 3;
/// Parts of the window that one factor can touch: the poses a landmark sees and the cameras, or all of two states and
/// the inertial unit.
pub const PARTS_MAX: usize = FRAMES + 2;
/// Columns besides those of the point.
const SHARED_DIM: usize = super::window::POSE_DIM * FRAMES + RIG_DIM;
/// Columns of the rows of the largest factor, the point's and r included.
pub const COLS_MAX: usize = POINT_DIM + SHARED_DIM + 1;
/// Rows of the largest factor.
pub const ROWS_MAX: usize = 2 * OBSERVATIONS + 1;
/// Rows `[W | g]` of the points of all landmarks, see `elimination.rs`.
const POINT_ROWS_MAX: usize = POINT_DIM * LANDMARKS;
/// Rows of the stack of a marginalization: what stays of it when triangular, and the largest factors. How many there are
/// decides when it is made triangular, and so the last bits: those of heights and of the second to last camera's time offset
/// have room among them.
pub const STACK_ROWS: usize = WINDOW_DIM - HEIGHT_DIM - (CAMERAS_MAX - 1) + 4 * ROWS_MAX;

/// The rows of one factor; reused for every factor.
#[derive(Clone, Debug)]
pub struct FactorRows {
    pub rows: Rows,
    /// Columns of the window, ascending; they follow each other in the rows after the point's.
    pub columns: List<Columns, PARTS_MAX>,
    /// Columns before them that are the factor's own.
    own: usize,
    /// A landmark's rows come in pairs, a view each. The columns of the window at which the poses of its two frames begin,
    /// ascending; `None` where the pair is about the point and the cameras alone.
    pub frames: List<Option<[usize; 2]>, OBSERVATIONS>,
    gram: Vec<f64>,
}

impl FactorRows {
    pub fn new() -> FactorRows {
        FactorRows::with_room(ROWS_MAX)
    }

    /// Room for the rows `[W | g]` of the points of all landmarks.
    pub fn of_points() -> FactorRows {
        FactorRows::with_room(POINT_ROWS_MAX)
    }

    fn with_room(rows_max: usize) -> FactorRows {
        FactorRows {
            rows: Rows::new(rows_max, COLS_MAX),
            columns: List::default(),
            own: 0,
            frames: List::default(),
            gram: vec![0.0; Rows::gram_len(COLS_MAX)],
        }
    }

    /// Empties, for rows with `own` columns before those of the window.
    pub fn begin(&mut self, own: usize, columns: impl Iterator<Item = Columns>) {
        self.columns.clear();
        for part in columns {
            self.columns.push(part).expect("PARTS_MAX is the most a factor touches");
        }
        self.columns.sort_unstable_by_key(|c| c.at);
        self.own = own;
        self.frames.clear();
        self.rows.clear(own + self.columns.iter().map(|c| c.len).sum::<usize>() + 1);
    }

    /// Column of the rows at which the columns of the window from `at` begin.
    pub fn offset(&self, at: usize) -> usize {
        self.own + self.columns.iter().take_while(|c| c.at != at).map(|c| c.len).sum::<usize>()
    }

    /// Adds the square of the rows from `first`, the factor's own columns left out.
    pub fn add_to(&mut self, first: usize, system: &mut System) {
        let stride = self.rows.gram(first, &mut self.gram);
        add_gram(system, &self.gram, stride, self.own, &self.columns);
    }

    /// Subtracts the square of all rows.
    pub fn subtract_from(&mut self, system: &mut System) {
        let stride = self.rows.gram(0, &mut self.gram);
        self.gram[..self.rows.cols() * stride].iter_mut().for_each(|x| *x = -*x);
        add_gram(system, &self.gram, stride, self.own, &self.columns);
    }

    /// Appends the rows from `first`, the factor's own columns left out; makes room when there is none.
    pub fn append_to(&self, first: usize, stack: &mut Rows) {
        if stack.room() < self.rows.count() - first {
            stack.triangularize();
        }
        for i in first..self.rows.count() {
            let row = &self.rows.row(i)[self.own..];
            scatter(row, &self.columns, stack.push());
        }
    }
}

/// Puts a row, whose columns belong to `columns` one after the other, into a wider one; the last stays the last.
pub fn scatter(row: &[f64], columns: &[Columns], out: &mut [f64]) {
    let mut from = 0;
    for c in columns {
        out[c.at..c.at + c.len].copy_from_slice(&row[from..from + c.len]);
        from += c.len;
    }
    out[out.len() - 1] = row[from];
}
