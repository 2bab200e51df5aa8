//! Normal equations of the pose graph: a sparse Cholesky factorisation of 4x4 blocks in memory that is taken once.
//!
//! The order is that of minimum degree, found on the graph of eliminations, of which every row is a set of bits. What is left
//! of a node's row when it is eliminated is its column of the factor.

use super::super::pose4::Pose4;
use super::Edge;
use nalgebra::{Matrix4, Vector4};

/// Weight that holds a node in its place: that of a deviation of 0.1 mm, and rad/10^4.
const HELD: f64 = 1e8;
const NOWHERE: u16 = u16::MAX;
/// Neighbours of a node that adds no more of them to others when it is eliminated: most have two, so few need a search.
const FEW: u16 = 2;

/// A column of the factor: its blocks below the diagonal.
#[derive(Clone, Copy, Default)]
struct Column {
    node: u16,
    start: u32,
    len: u32,
}

pub struct Solver {
    /// Words of a set of nodes.
    words: usize,
    /// `sets[node * words..]`: neighbours of each node.
    sets: Vec<u64>,
    degrees: Vec<u16>,
    /// Nodes that may be left, and those that have few neighbours, which go next.
    left: Vec<u16>,
    few: Vec<u16>,
    columns: Vec<Column>,
    /// Where in the order each node is.
    rank: Vec<u16>,
    /// A node of each node's component that is held in its place: a fixed one where there is one.
    component: Vec<u16>,
    /// Ranks of the blocks of all columns, ascending in each.
    rows: Vec<u16>,
    blocks: Vec<Matrix4<f64>>,
    diagonals: Vec<Matrix4<f64>>,
    right: Vec<Vector4<f64>>,
    /// Right sides of a covariance: 8 columns as two blocks.
    wide: Vec<[Matrix4<f64>; 2]>,
    /// Whether the last factorisation succeeded. Nodes that came after it are not in its factor (`has`).
    pub factored: bool,
}

impl Solver {
    pub fn new(nodes: usize, blocks: usize) -> Solver {
        let words = nodes.div_ceil(64);
        Solver {
            words,
            sets: vec![0; nodes * words],
            degrees: vec![0; nodes],
            left: Vec::with_capacity(nodes),
            few: Vec::with_capacity(nodes),
            columns: Vec::with_capacity(nodes),
            rank: vec![NOWHERE; nodes],
            component: vec![NOWHERE; nodes],
            // As the stack of a search it holds every node once.
            rows: Vec::with_capacity(blocks.max(nodes)),
            blocks: Vec::with_capacity(blocks.max(nodes)),
            diagonals: vec![Matrix4::zeros(); nodes],
            right: vec![Vector4::zeros(); nodes],
            wide: vec![[Matrix4::zeros(); 2]; nodes],
            factored: false,
        }
    }

    /// Bytes on the heap.
    pub fn bytes(&self) -> usize {
        let node = 10 + size_of::<Column>() + 3 * size_of::<Matrix4<f64>>() + size_of::<Vector4<f64>>();
        let block = size_of::<Matrix4<f64>>() + 2;
        self.sets.len() * 8 + self.rank.len() * node + self.blocks.capacity() * block
    }

    /// Forgets order and factor.
    pub fn forget(&mut self) {
        self.columns.clear();
        self.rank.fill(NOWHERE);
        self.factored = false;
    }

    /// Whether the factor has a node.
    pub fn has(&self, node: u16) -> bool {
        self.factored && self.rank[node as usize] != NOWHERE
    }

    /// Orders the used nodes; answers the blocks of the factor, `None` where they do not fit.
    pub fn order(&mut self, used: &[bool], fixed: &[bool], edges: &[Edge]) -> Option<usize> {
        self.forget();
        self.sets.fill(0);
        self.rows.clear();
        for e in edges {
            let (a, b) = (e.from as usize, e.to as usize);
            self.sets[a * self.words + b / 64] |= 1 << (b % 64);
            self.sets[b * self.words + a / 64] |= 1 << (a % 64);
        }
        let count = |set: &[u64]| set.iter().map(|w| w.count_ones()).sum::<u32>() as u16;
        for n in 0..used.len() {
            self.degrees[n] = if used[n] { count(&self.sets[n * self.words..][..self.words]) } else { NOWHERE };
        }
        self.find_components(used, fixed);
        self.left.clear();
        self.left.extend((0..used.len() as u16).filter(|n| used[*n as usize]));
        self.few.clear();
        self.few.extend(self.left.iter().filter(|n| self.degrees[**n as usize] <= FEW));
        for rank in 0..self.left.len() {
            let node = match self.few.pop() {
                Some(node) => node as usize,
                None => {
                    self.left.retain(|n| self.rank[*n as usize] == NOWHERE);
                    *self.left.iter().min_by_key(|n| self.degrees[**n as usize])? as usize
                }
            };
            let start = self.rows.len();
            let words = node * self.words..(node + 1) * self.words;
            for w in 0..self.words {
                let mut bits = self.sets[words.start + w];
                while bits != 0 {
                    let other = w * 64 + bits.trailing_zeros() as usize;
                    bits &= bits - 1;
                    if self.rows.len() == self.rows.capacity() {
                        self.forget();
                        return None;
                    }
                    self.rows.push(other as u16);
                }
            }
            self.degrees[node] = NOWHERE;
            for k in start..self.rows.len() {
                let other = self.rows[k] as usize;
                for w in 0..self.words {
                    let merged = self.sets[other * self.words + w] | self.sets[words.start + w];
                    self.sets[other * self.words + w] = merged;
                }
                self.sets[other * self.words + node / 64] &= !(1 << (node % 64));
                self.sets[other * self.words + other / 64] &= !(1 << (other % 64));
                let before =
                    std::mem::replace(&mut self.degrees[other], count(&self.sets[other * self.words..][..self.words]));
                if before > FEW && self.degrees[other] <= FEW {
                    self.few.push(other as u16);
                }
            }
            self.rank[node] = rank as u16;
            self.columns.push(Column { node: node as u16, start: start as u32, len: (self.rows.len() - start) as u32 });
        }
        for c in &self.columns {
            let rows = &mut self.rows[c.start as usize..][..c.len as usize];
            rows.iter_mut().for_each(|row| *row = self.rank[*row as usize]);
            rows.sort_unstable();
        }
        Some(self.rows.len())
    }

    /// Finds the components, those with fixed nodes first.
    fn find_components(&mut self, used: &[bool], fixed: &[bool]) {
        self.component.fill(NOWHERE);
        let of_kind = |is_fixed: bool| (0..used.len()).filter(move |n| used[*n] && fixed[*n] == is_fixed);
        for first in of_kind(true).chain(of_kind(false)) {
            if self.component[first] != NOWHERE {
                continue;
            }
            self.component[first] = first as u16;
            // `rows` is the stack: it is empty before the order is found, and a node is on it once.
            self.rows.clear();
            let mut next = Some(first as u16);
            while let Some(node) = next {
                for w in 0..self.words {
                    let mut bits = self.sets[node as usize * self.words + w];
                    while bits != 0 {
                        let other = w * 64 + bits.trailing_zeros() as usize;
                        bits &= bits - 1;
                        if self.component[other] == NOWHERE {
                            self.component[other] = first as u16;
                            self.rows.push(other as u16);
                        }
                    }
                }
                next = self.rows.pop();
            }
        }
        self.rows.clear();
    }

    /// Begins anew with the equations of an order.
    pub fn clear(&mut self, used: &[bool], fixed: &[bool]) {
        self.factored = false;
        self.blocks.clear();
        self.blocks.resize(self.rows.len(), Matrix4::zeros());
        for n in (0..used.len()).filter(|n| used[*n]) {
            let rank = self.rank[n] as usize;
            self.right[rank] = Vector4::zeros();
            let held = fixed[n] || self.component[n] as usize == n;
            self.diagonals[rank] = if held { Matrix4::identity() * HELD } else { Matrix4::zeros() };
        }
    }

    /// The block at two ranks, the lower one first.
    fn block(&self, column: usize, row: u16) -> usize {
        let c = &self.columns[column];
        let rows = &self.rows[c.start as usize..][..c.len as usize];
        c.start as usize
            + rows.binary_search(&row).expect("the order has every block that an edge or an elimination needs")
    }

    /// Adds an edge at the poses of its nodes.
    pub fn add(&mut self, edge: &Edge, information: &Matrix4<f64>, a: &Pose4, b: &Pose4) {
        let (r, [ja, jb]) = edge.residual(a, b);
        let [ra, rb] = [edge.from, edge.to].map(|n| self.rank[n as usize]);
        self.diagonals[ra as usize] += ja.transpose() * information * ja;
        self.diagonals[rb as usize] += jb.transpose() * information * jb;
        self.right[ra as usize] -= ja.transpose() * information * r;
        self.right[rb as usize] -= jb.transpose() * information * r;
        // Row below column.
        let block = if ra < rb { jb.transpose() * information * ja } else { ja.transpose() * information * jb };
        let at = self.block(ra.min(rb) as usize, ra.max(rb));
        self.blocks[at] += block;
    }

    /// Factors the equations and solves them: node and step. `None` where they are not positive definite.
    pub fn solve(&mut self) -> Option<impl Iterator<Item = (usize, Vector4<f64>)> + '_> {
        for rank in 0..self.columns.len() {
            let c = self.columns[rank];
            let l = self.diagonals[rank].cholesky()?.l();
            self.diagonals[rank] = l;
            let range = c.start as usize..(c.start + c.len) as usize;
            for at in range.clone() {
                // L = A C⁻ᵀ
                let solved = l.solve_lower_triangular(&self.blocks[at].transpose())?;
                self.blocks[at] = solved.transpose();
            }
            for i in range.clone() {
                let row = self.rows[i] as usize;
                let li = self.blocks[i];
                let lt = li.transpose();
                self.diagonals[row] -= li * lt;
                // The column of that row has all the rows below, in the same order.
                let mut at = self.columns[row].start as usize;
                for k in i + 1..range.end {
                    at += self.rows[at..].iter().position(|r| *r == self.rows[k]).unwrap_or_default();
                    let update = self.blocks[k] * lt;
                    self.blocks[at] -= update;
                }
            }
        }
        self.factored = true;
        for rank in 0..self.columns.len() {
            let x = self.diagonals[rank].solve_lower_triangular(&self.right[rank])?;
            self.right[rank] = x;
            let c = self.columns[rank];
            for at in c.start as usize..(c.start + c.len) as usize {
                self.right[self.rows[at] as usize] -= self.blocks[at] * x;
            }
        }
        for rank in (0..self.columns.len()).rev() {
            let c = self.columns[rank];
            let mut x = self.right[rank];
            for at in c.start as usize..(c.start + c.len) as usize {
                x -= self.blocks[at].transpose() * self.right[self.rows[at] as usize];
            }
            self.right[rank] = self.diagonals[rank].transpose().solve_upper_triangular(&x)?;
        }
        Some(self.columns.iter().zip(&self.right).map(|(c, x)| (c.node as usize, *x)))
    }

    /// Joint covariance of two nodes of the factor; `None` where nothing connects them.
    pub fn joint(&mut self, a: u16, b: u16) -> Option<[[Matrix4<f64>; 2]; 2]> {
        if self.component[a as usize] != self.component[b as usize] {
            return None;
        }
        let ranks = [self.rank[a as usize] as usize, self.rank[b as usize] as usize];
        let n = self.columns.len();
        self.wide[..n].fill([Matrix4::zeros(); 2]);
        (0..2).for_each(|k| self.wide[ranks[k]][k] = Matrix4::identity());
        // What is before both is zero.
        for rank in ranks[0].min(ranks[1])..n {
            let c = self.columns[rank];
            let l = &self.diagonals[rank];
            let mut x = self.wide[rank];
            for k in 0..2 {
                x[k] = l.solve_lower_triangular(&x[k])?;
            }
            self.wide[rank] = x;
            for at in c.start as usize..(c.start + c.len) as usize {
                for k in 0..2 {
                    self.wide[self.rows[at] as usize][k] -= self.blocks[at] * x[k];
                }
            }
        }
        for rank in (ranks[0].min(ranks[1])..n).rev() {
            let c = self.columns[rank];
            let mut x = self.wide[rank];
            for at in c.start as usize..(c.start + c.len) as usize {
                let l = self.blocks[at].transpose();
                for k in 0..2 {
                    x[k] -= l * self.wide[self.rows[at] as usize][k];
                }
            }
            let u = self.diagonals[rank].transpose();
            for k in 0..2 {
                self.wide[rank][k] = u.solve_upper_triangular(&x[k])?;
            }
        }
        Some([[self.wide[ranks[0]][0], self.wide[ranks[0]][1]], [self.wide[ranks[1]][0], self.wide[ranks[1]][1]]])
    }
}
