//! One search for a patch: from a pixel of one image to where it is in another, and back.

use super::patch::{align_stack, take_stack, Stack, Template, Warp, STEP_MIN};
use super::points::{distance, FINE_LEVELS};
use super::pyramid::Levels;
use crate::config::FrontendConfig;

/// The way back only has to arrive: it is refined until a step is below this, px.
const STEP_MIN_CHECK: f32 = 0.05;
/// Views end this close to the border, px.
const MARGIN_PX: f32 = 2.0;

/// What every search keeps to.
#[derive(Clone, Copy)]
pub struct Limits {
    pub iterations: usize,
    /// The way there and back may end this far from where it began, px.
    forward_backward_max_px: f32,
}

impl Limits {
    pub fn new(config: &FrontendConfig) -> Limits {
        let forward_backward_max_px = config.forward_backward_max_px as f32;
        Limits { iterations: config.iterations as usize, forward_backward_max_px }
    }
}

/// A patch at `px` of one image looked for around `start` in another, from level `coarsest` on.
pub struct Search<'a> {
    pub from: Levels<'a>,
    pub to: Levels<'a>,
    pub px: [f32; 2],
    pub start: Warp,
    pub coarsest: usize,
    pub limits: Limits,
}

impl Search<'_> {
    /// Where the patch is, and the share of its contrast that stays unexplained there.
    pub fn find(&self, stack: &[Template]) -> Option<(Warp, f32)> {
        align_stack(stack, &self.to, self.start, self.coarsest, self.limits.iterations, STEP_MIN)
    }

    /// Takes the patch where it was placed and aligns it back: it must arrive where it came from.
    /// The way back starts as far off as the way there did, and at the coarsest level too.
    pub fn returns(&self, stack: &mut Stack, found: Warp, placed: [f32; 2]) -> bool {
        let image = self.to[0];
        let [right, bottom] = [image.width, image.height].map(|n| (n - 1) as f32 - MARGIN_PX);
        if !(placed[0] >= MARGIN_PX && placed[1] >= MARGIN_PX && placed[0] <= right && placed[1] <= bottom) {
            return false;
        }
        take_stack(stack, &self.to, placed, 0..FINE_LEVELS.max(self.coarsest + 1));
        // What the reference moved here, it moves there.
        let (dx, dy) = (placed[0] - found.x, placed[1] - found.y);
        let origin = [self.px[0] + found.c * dx + found.s * dy, self.px[1] + found.c * dy - found.s * dx];
        let (x, y) = (found.x + origin[0] - self.start.x, found.y + origin[1] - self.start.y);
        let back = Warp { x, y, c: found.c, s: -found.s };
        align_stack(&stack[..], &self.from, back, self.coarsest, self.limits.iterations, STEP_MIN_CHECK)
            .is_some_and(|(arrived, _)| distance(arrived.px(), origin) <= self.limits.forward_backward_max_px)
    }
}
