//! Depth for every pixel of a view: what was matched, and between matches what the nearest around continue.
//!
//! Where matching found no depth (bare walls) the inverse depth of the nearest matches left, right, above and below is
//! carried over, the background preferred: inverse depth of a plane is linear in the image.

/// No matched pixel on this side.
const NONE: u32 = u32::MAX;
/// Neighbours whose inverse depth exceeds the farthest's by this are foreground, and not carried over.
const FOREGROUND: f32 = 1.25;

pub struct DepthFill {
    width: usize,
    /// m; zero where nothing around was matched.
    pub metres: Vec<f32>,
    /// Index of the nearest matched pixel left, right, above, below; `NONE` without.
    nearest: [Vec<u32>; 4],
}

impl DepthFill {
    pub fn new(width: usize, height: usize) -> DepthFill {
        let n = width * height;
        DepthFill { width, metres: vec![0.0; n], nearest: std::array::from_fn(|_| vec![NONE; n]) }
    }

    /// Fills `metres` from matched depths, zero where unknown.
    pub fn fill(&mut self, matched: &[f32]) {
        let width = self.width;
        let height = matched.len() / width;
        let [left, right, up, down] = &mut self.nearest;
        let own = |i: usize| if matched[i] > 0.0 { i as u32 } else { NONE };
        for i in 0..matched.len() {
            left[i] = if own(i) == NONE && i % width > 0 { left[i - 1] } else { own(i) };
            up[i] = if own(i) == NONE && i >= width { up[i - width] } else { own(i) };
        }
        for i in (0..matched.len()).rev() {
            right[i] = if own(i) == NONE && i % width + 1 < width { right[i + 1] } else { own(i) };
            down[i] = if own(i) == NONE && i / width + 1 < height { down[i + width] } else { own(i) };
        }
        for i in 0..matched.len() {
            self.metres[i] = match matched[i] {
                z if z > 0.0 => z,
                _ => carried(matched, width, i, self.nearest.each_ref().map(|n| n[i])),
            };
        }
    }
}

fn carried(matched: &[f32], width: usize, i: usize, around: [u32; 4]) -> f32 {
    let inverse = |j: u32| 1.0 / matched[j as usize];
    let known = || around.iter().copied().filter(|&j| j != NONE);
    let farthest = known().map(inverse).fold(f32::INFINITY, f32::min);
    let (mut sum, mut weights) = (0.0, 0.0);
    for j in known().filter(|&j| inverse(j) <= FOREGROUND * farthest) {
        let (dx, dy) = ((j as usize % width).abs_diff(i % width), (j as usize / width).abs_diff(i / width));
        let weight = 1.0 / (dx + dy) as f32;
        sum += weight * inverse(j);
        weights += weight;
    }
    if weights > 0.0 {
        weights / sum
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 64;
    const H: usize = 48;

    #[test]
    fn holes_take_the_background() {
        let mut fill = DepthFill::new(W, H);
        let at = |x: usize| match x {
            0..=19 => 1.0,
            20..=39 => 0.0,
            _ => 3.0,
        };
        fill.fill(&(0..W * H).map(|i| at(i % W)).collect::<Vec<_>>());
        assert!((fill.metres[10 * W + 22] - 3.0).abs() < 1e-5);
        assert_eq!(fill.metres[10 * W + 5], 1.0);
        // A plane is continued as a plane.
        let inverse = |x: usize| 0.5 + 0.004 * x as f32;
        let hole = |i: usize| (20..40).contains(&(i % W)) && (10..30).contains(&(i / W));
        fill.fill(&(0..W * H).map(|i| if hole(i) { 0.0 } else { 1.0 / inverse(i % W) }).collect::<Vec<_>>());
        let error = (1.0 / fill.metres[20 * W + 25] - inverse(25)).abs();
        assert!(error < 0.01, "{error}");
    }
}
