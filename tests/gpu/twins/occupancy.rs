//! Twin of occupy.comp.

pub fn mixed(h: u32) -> u32 {
    let h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    let h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// Claims one after the other; answers what each found.
pub fn claim(cells: &mut [u32], anchor: u32, per_metre: f32, points: &[[f32; 4]]) -> Vec<u32> {
    let answer = |p: &[f32; 4]| {
        let c = |k: usize| (p[k] * per_metre).floor() as i32 as u32;
        let key = mixed(c(0) ^ mixed(c(1) ^ mixed(c(2).wrapping_add(1))));
        let places = [key, mixed(key.wrapping_add(1))].map(|h| h as usize & (cells.len() - 1));
        let tag = mixed(key.wrapping_add(2)) >> 12;
        let earlier = places.map(|p| cells[p]).into_iter().filter(|e| e >> 20 < anchor);
        let (n, taken) = earlier.fold((0, false), |(n, taken), e| (n + 1, taken || e & 0xf_ffff == tag));
        if taken {
            return 1;
        }
        places.iter().for_each(|p| cells[*p] = cells[*p].min(anchor << 20 | tag));
        if n == 2 {
            2
        } else {
            0
        }
    };
    points.iter().map(answer).collect()
}
