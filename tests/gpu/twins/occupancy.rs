//! Twin of occupy.comp and occupied.comp.

pub const FREE: u32 = u32::MAX;

pub fn mixed(h: u32) -> u32 {
    let h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    let h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// A cell's two places among `n`, and its tag.
fn cell(p: &[f32], per_metre: f32, n: usize) -> ([usize; 2], u32) {
    let c = |k: usize| (p[k] * per_metre).floor() as i32 as u32;
    let key = mixed(c(0) ^ mixed(c(1) ^ mixed(c(2).wrapping_add(1))));
    let places = [key, mixed(key.wrapping_add(1))].map(|h| h as usize & (n - 1));
    (places, mixed(key.wrapping_add(2)).min(FREE - 1))
}

/// Puts in one after the other.
pub fn occupy(cells: &mut [u32], per_metre: f32, means: &[[f32; 3]]) {
    for p in means.iter().filter(|p| p.iter().all(|v| v.is_finite())) {
        let (places, tag) = cell(p, per_metre, cells.len());
        places.iter().for_each(|p| cells[*p] = cells[*p].min(tag));
    }
}

pub fn occupied(cells: &[u32], per_metre: f32, points: &[[f32; 4]]) -> Vec<u32> {
    let answer = |p: &[f32; 4]| {
        let (places, tag) = cell(p, per_metre, cells.len());
        let found = places.map(|p| cells[p]);
        match (found.contains(&tag), found.contains(&FREE)) {
            (true, _) => 1,
            (false, true) => 0,
            (false, false) => 2,
        }
    };
    points.iter().map(answer).collect()
}
