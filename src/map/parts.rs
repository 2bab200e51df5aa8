//! Cuts an anchor's block of Gaussians into parts, which are paged one by one. They lie all over what the anchor saw, and a view
//! of some of them would bring them all: on the patrol a view sees 11 500 Gaussians (median), and the whole blocks that have them
//! 44 600. A complete block is halved along the longest side of the box around it, and so are its halves.
//!
//! A part is a block of its own from then on, to the pool, the archive and the store.

use super::filing::MOMENTS;
use crate::gpu::kernels::types::{Moments, Splat};

/// Parts that a block may have. Part `p` of anchor `a` has the number `a * PARTS + p`, in the pool and, with the id of the
/// keyframe in place of its index, in the store.
pub const PARTS: u32 = 16;
/// Gaussians that a part may have, unless the block has too many for `PARTS`.
const GAUSSIANS: usize = 256;

/// Into how many parts so many Gaussians are cut: a power of two.
pub fn parts_of(count: usize) -> usize {
    count.div_ceil(GAUSSIANS).next_power_of_two().min(PARTS as usize)
}

/// Orders points so that each of so many equal parts of the order lies together.
fn order(points: &[[f32; 3]], order: &mut [u32], parts: usize) {
    if parts < 2 || order.len() < 2 {
        return;
    }
    let mut size = [(f32::INFINITY, f32::NEG_INFINITY); 3];
    for at in order.iter() {
        for (axis, (least, most)) in size.iter_mut().enumerate() {
            let v = points[*at as usize][axis];
            (*least, *most) = (least.min(v), most.max(v));
        }
    }
    let longest = (0..3).max_by(|a, b| (size[*a].1 - size[*a].0).total_cmp(&(size[*b].1 - size[*b].0))).unwrap_or(0);
    let middle = order.len() / 2;
    let along = |at: &u32| points[*at as usize][longest];
    order.select_nth_unstable_by(middle, |a, b| along(a).total_cmp(&along(b)).then(a.cmp(b)));
    let (before, after) = order.split_at_mut(middle);
    self::order(points, before, parts / 2);
    self::order(points, after, parts / 2);
}

/// Where a part of so many begins in the order that `order` made.
pub fn start_of(part: usize, parts: usize, count: usize) -> usize {
    let (mut begin, mut len, mut first, mut parts) = (0, count, 0, parts);
    if part == parts {
        return count;
    }
    while part > first && parts > 1 && len > 1 {
        parts /= 2;
        if part >= first + parts {
            (begin, len, first) = (begin + len / 2, len - len / 2, first + parts);
        } else {
            len /= 2;
        }
    }
    begin
}

/// Room to order a block's Gaussians; bought at boot.
pub struct Ordering {
    points: Vec<[f32; 3]>,
    order: Vec<u32>,
    ordered: Vec<u8>,
}

impl Ordering {
    /// For blocks of so many bytes.
    pub fn new(bytes: usize) -> Ordering {
        let count = bytes / size_of::<Splat>();
        Ordering {
            points: Vec::with_capacity(count),
            order: Vec::with_capacity(count),
            ordered: Vec::with_capacity(bytes),
        }
    }

    /// A block's arrays (`paging`) in the order of its parts.
    pub fn put_in_order(&mut self, bytes: &[u8], count: usize, parts: usize, colour: bool) -> &[u8] {
        self.points.clear();
        let splats = bytes.chunks_exact(size_of::<Splat>()).take(count);
        self.points.extend(splats.map(|splat| bytemuck::pod_read_unaligned::<[f32; 3]>(&splat[..12])));
        self.order.clear();
        self.order.extend(0..count as u32);
        order(&self.points, &mut self.order, parts);
        self.ordered.clear();
        let grey = [(size_of::<Splat>(), true), (size_of::<u32>(), true), (size_of::<[f32; 2]>(), colour)];
        let moments = [(size_of::<Moments>(), MOMENTS), (size_of::<[f32; 4]>(), MOMENTS && colour)];
        let mut rest = bytes;
        for (size, _) in grey.into_iter().chain(moments).filter(|(_, is_there)| *is_there) {
            let (array, after) = rest.split_at(count * size);
            rest = after;
            for at in &self.order {
                self.ordered.extend_from_slice(&array[*at as usize * size..][..size]);
            }
        }
        &self.ordered
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_lie_together_and_are_all_there() {
        // Four clusters along two axes, mixed.
        let points: Vec<[f32; 3]> =
            (0..400).map(|i| [(i % 2) as f32 * 9.0, (i / 2 % 2) as f32 * 5.0, (i % 7) as f32 * 0.1]).collect();
        let mut ordered: Vec<u32> = (0..400).collect();
        order(&points, &mut ordered, 4);
        let parts: Vec<_> = (0..4).map(|part| start_of(part, 4, 400)..start_of(part + 1, 4, 400)).collect();
        assert_eq!(parts.iter().map(|part| part.len()).collect::<Vec<_>>(), [100; 4]);
        for part in &parts {
            let first = points[ordered[part.start] as usize];
            assert!(ordered[part.clone()].iter().all(|at| points[*at as usize][..2] == first[..2]), "{part:?}");
        }
        ordered.sort_unstable();
        assert!(ordered.iter().copied().eq(0..400));
    }

    #[test]
    fn what_has_no_extent_or_is_not_finite_is_cut_too() {
        for points in [vec![[1.0; 3]; 9], vec![[f32::NAN; 3]; 9], vec![[f32::INFINITY, 0.0, f32::NAN]; 9]] {
            let mut ordered: Vec<u32> = (0..9).collect();
            order(&points, &mut ordered, 4);
            ordered.sort_unstable();
            assert!(ordered.iter().copied().eq(0..9));
        }
        assert_eq!(
            (parts_of(0), parts_of(GAUSSIANS), parts_of(GAUSSIANS + 1), parts_of(1 << 20)),
            (1, 1, 2, PARTS as usize)
        );
    }
}
