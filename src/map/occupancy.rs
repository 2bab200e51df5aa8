//! Which cells of space already hold Gaussians, and of which anchor: a hash table of fixed size.
//!
//! Open addressing with a bounded probe. A full neighbourhood is a value (`Full`), never a growth: the cost
//! is a duplicate seed, so a lost cell is counted and forgotten.

use crate::mem::Footprint;
use glam::DVec3;

/// Longest walk from a cell's place in the table.
const PROBES: usize = 32;
/// Bits of one cell coordinate: ±100 km of 0.1 m cells.
const BITS: u32 = 21;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cell {
    /// Nobody was there; it is this anchor's now.
    Taken,
    /// This anchor took it before.
    Own,
    /// An earlier anchor holds it.
    Held,
    /// The table has no room for it.
    Full,
}

pub struct Occupancy {
    /// Cell key and anchor; key 0 is free.
    table: Vec<(u64, u32)>,
    per_metre: f64,
}

impl Occupancy {
    pub fn footprint(cells: u32) -> Footprint {
        let mut f = Footprint::default();
        f.host("map: occupancy grid", cells as usize * size_of::<(u64, u32)>());
        f
    }

    /// `cells` is a power of two.
    pub fn new(cell_m: f64, cells: u32) -> Occupancy {
        debug_assert!(cells.is_power_of_two());
        Occupancy { table: vec![(0, 0); cells as usize], per_metre: 1.0 / cell_m }
    }

    /// Claims the cell around `p_world` for `anchor`.
    pub fn claim(&mut self, p_world: DVec3, anchor: u32) -> Cell {
        let key = self.key(p_world);
        let mask = self.table.len() - 1;
        let start = (key.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize;
        for i in start..start + PROBES {
            let slot = &mut self.table[i & mask];
            if slot.0 == 0 {
                *slot = (key, anchor);
                return Cell::Taken;
            }
            if slot.0 == key {
                return if slot.1 == anchor { Cell::Own } else { Cell::Held };
            }
        }
        Cell::Full
    }

    fn key(&self, p: DVec3) -> u64 {
        const MASK: i64 = (1 << BITS) - 1;
        let axis = |v: f64| ((v * self.per_metre).floor() as i64 & MASK) as u64;
        1 << 63 | axis(p.x) << (2 * BITS) | axis(p.y) << BITS | axis(p.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cell_belongs_to_the_first_anchor() {
        let mut grid = Occupancy::new(0.1, 1024);
        let p = DVec3::new(-0.01, 2.05, 1.0);
        assert_eq!(grid.claim(p, 1), Cell::Taken);
        assert_eq!(grid.claim(p - DVec3::X * 0.05, 1), Cell::Own);
        assert_eq!(grid.claim(p, 2), Cell::Held);
        assert_eq!(grid.claim(-p, 2), Cell::Taken);
    }

    #[test]
    fn full_table_is_a_value() {
        let mut grid = Occupancy::new(1.0, 64);
        let claims: Vec<Cell> = (0..200).map(|i| grid.claim(DVec3::new(f64::from(i), 0.0, 0.0), 1)).collect();
        assert!(claims.iter().filter(|c| **c == Cell::Taken).count() <= 64);
        assert!(claims.contains(&Cell::Full));
        assert_eq!(grid.claim(DVec3::ZERO, 2), Cell::Held);
    }
}
