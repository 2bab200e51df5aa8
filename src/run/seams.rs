//! Scores of the map where loops are closed that move it: before, after, and ten seconds of flight after the loop. One loop at a
//! time; those that are closed meanwhile are not scored.

use super::keyframes::KeyframeRing;
use crate::gpu::GpuError;
use crate::map::{Mapper, Seam, SeamScores};
use serde::{Deserialize, Serialize};
use stipple_drivers::{Nanos, Span};

const LATER: Span = Span(10_000_000_000);
/// Loops that are scored in a flight.
const SCORED: usize = 64;

/// A loop by its stamp, and what it did to the map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoredLoop {
    pub t_ns: i64,
    pub scores: SeamScores,
}

/// The loops of a flight and the one that is being scored.
pub struct Seams {
    /// Loops that the ring has told of.
    seen: u64,
    current: Option<(Seam, ScoredLoop)>,
    list: Vec<ScoredLoop>,
}

impl Seams {
    /// None yet. Loops that a ring has told of before are another mapper's.
    pub fn new(ring: &KeyframeRing) -> Seams {
        Seams { seen: ring.moved().0, current: None, list: Vec::with_capacity(SCORED) }
    }

    /// Scores what is due, before the corrections that tracking has told so far, `written` in number, are taken. `now` is the stamp
    /// of the newest keyframe.
    pub fn score(
        &mut self,
        mapper: &mut Mapper,
        ring: &KeyframeRing,
        written: u64,
        now: Nanos,
    ) -> Result<(), GpuError> {
        let (count, moved) = ring.moved();
        let is_new = count != std::mem::replace(&mut self.seen, count);
        let Some((seam, ScoredLoop { t_ns, scores })) = &mut self.current else {
            if is_new && self.list.len() < SCORED {
                let seam = mapper.seam(moved.with);
                let before = Some(mapper.score_seam(&seam)?);
                let scores = SeamScores { before, ..SeamScores::default() };
                self.current = Some((seam, ScoredLoop { t_ns: moved.t.0, scores }));
            }
            return Ok(());
        };
        if scores.after.is_none() {
            // What the loop moves comes piece by piece.
            if ring.corrections_read() == written {
                scores.after = Some(mapper.score_seam(seam)?);
            }
        } else if now - Nanos(*t_ns) >= LATER {
            scores.later = Some(mapper.score_seam(seam)?);
            self.end();
        }
        Ok(())
    }

    fn end(&mut self) {
        self.list.extend(self.current.take().map(|(_, scored)| scored));
    }

    /// What was scored. `after` and `later` of the last one are `None` where the flight ended first.
    pub fn take(&mut self) -> Vec<ScoredLoop> {
        self.end();
        std::mem::take(&mut self.list)
    }
}

#[cfg(test)]
mod tests {
    use super::super::keyframes::tests::ring;
    use super::super::loop_closing::Moved;
    use super::*;

    #[test]
    fn a_mapper_that_starts_again_scores_no_loop_that_was_told_to_the_one_before() {
        let ring = ring();
        ring.push_moved(&Moved { t: Nanos(5), with: None });
        let again = Seams::new(&ring);
        assert_eq!((again.seen, again.current.is_none()), (ring.moved().0, true));
        assert_eq!(ring.moved().0, 1);
    }
}
