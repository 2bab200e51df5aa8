//! Data-ready edges, and which sample each belongs to.
//!
//! A unit raises its line once for each sample, so in the long run there are as many edges as samples, and they are paired
//! in order. Two exceptions are told by the counts: the last edge may belong to a sample that came after the FIFO was
//! counted (it waits for the next read), and edges are lost when the kernel's queue of 16 overflows, or come late when the
//! thread that queues them does. Then they are paired by their age, so that no slip outlives a read, and a sample without
//! an edge is stamped by the estimated line (`timeline`).

use crate::types::{Nanos, Span};
use crate::List;

/// A source of edges: a GPIO line, or a simulated one.
pub trait Edges: Send {
    /// Waits until an edge is there, `timeout` at most; false where none came.
    fn wait(&mut self, timeout: Span) -> Result<bool, EdgeFault>;
    /// Moves the edges that are there into the queue; those that do not fit are counted and lost.
    fn drain(&mut self, into: &mut EdgeQueue) -> Result<(), EdgeFault>;
    /// Opens the line again after a fault.
    fn reopen(&mut self) -> Result<(), EdgeFault>;
}

/// The line cannot be read: the errno.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EdgeFault(pub i32);

/// Edges that can wait: more than any FIFO's samples between two reads.
const EDGES: usize = 256;

/// An edge further than this from now was not stamped by `CLOCK_MONOTONIC`; kernels before 5.7 do not.
const FOREIGN: Span = Span(10_000_000_000);

/// Stamps of edges that no sample was found for yet, oldest first.
#[derive(Clone, Debug, Default)]
pub struct EdgeQueue {
    stamps: List<Nanos, EDGES>,
    /// Edges that did not fit, were not newer than the last, or were stamped by another clock than ours.
    pub refused: u64,
    /// Edges without a sample, and samples without an edge.
    pub unmatched: u64,
}

impl EdgeQueue {
    /// The stamps, oldest first.
    pub fn stamps(&self) -> &[Nanos] {
        &self.stamps
    }

    /// Forgets all edges that wait.
    pub fn clear(&mut self) {
        self.stamps.clear();
    }

    /// Appends an edge of instant `t`, or counts it as refused.
    pub fn push(&mut self, t: Nanos, now: Nanos) {
        let foreign = (now - t).0.saturating_abs() > FOREIGN.0;
        let old = self.stamps.last().is_some_and(|last| t <= *last);
        if foreign || old || self.stamps.push(t).is_err() {
            self.refused += 1;
        }
    }

    /// Finds the edges of the `n` samples of a read that began at `before`: `of[i]` becomes that of sample i. All edges are
    /// used up, but for one that belongs to the next sample.
    pub fn pair(&mut self, n: usize, before: Nanos, period: Span, of: &mut Vec<Option<Nanos>>) {
        of.clear();
        of.resize(n, None);
        // One edge more than samples, which came about when they were counted or after.
        let late = before - Span(period.0 / 10);
        let surplus = self.stamps.last().copied().filter(|t| self.stamps.len() == n + 1 && *t > late);
        let edges = self.stamps.len() - usize::from(surplus.is_some());
        if edges == n {
            of.iter_mut().zip(self.stamps.iter()).for_each(|(of, t)| *of = Some(*t));
        } else {
            self.unmatched += edges.abs_diff(n) as u64;
            self.pair_by_age(n, before, period, of);
        }
        self.stamps.retain(|t| Some(*t) == surplus);
    }

    /// The newest sample was taken less than a period before the read, so the last edge is its own if it is as young; an
    /// older one belongs to a sample as many periods before. The others follow from their distance to it.
    fn pair_by_age(&self, n: usize, before: Nanos, period: Span, of: &mut [Option<Nanos>]) {
        let Some(latest) = self.stamps.last() else { return };
        let periods = |span: Span, round: f64| ((span.0.max(0) as f64 / period.0.max(1) as f64) + round) as usize;
        // A tenth for the errors of the period and of the moment of the count.
        let back = periods(before - *latest, 0.1);
        for t in self.stamps.iter().rev() {
            let sample = n.checked_sub(1 + back + periods(*latest - *t, 0.5)).and_then(|i| of.get_mut(i));
            sample.into_iter().for_each(|of| *of = of.or(Some(*t)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD: Span = Span(100);

    fn queue(stamps: &[i64]) -> EdgeQueue {
        let mut queue = EdgeQueue::default();
        stamps.iter().for_each(|t| queue.push(Nanos(*t), Nanos(*t)));
        queue
    }

    fn paired(queue: &mut EdgeQueue, n: usize, before: i64) -> Vec<Option<i64>> {
        let mut of = vec![];
        queue.pair(n, Nanos(before), PERIOD, &mut of);
        of.iter().map(|t| t.map(|t| t.0)).collect()
    }

    #[test]
    fn as_many_edges_as_samples_are_paired_in_order_however_uneven() {
        let mut q = queue(&[100, 201, 450]);
        assert_eq!(paired(&mut q, 3, 470), [Some(100), Some(201), Some(450)]);
        assert!(q.stamps().is_empty() && q.unmatched == 0);
    }

    #[test]
    fn an_edge_that_came_while_the_samples_were_counted_waits_for_the_next_read() {
        let mut q = queue(&[100, 200, 300]);
        assert_eq!(paired(&mut q, 2, 299), [Some(100), Some(200)]);
        assert_eq!(q.stamps(), [Nanos(300)]);
        q.push(Nanos(400), Nanos(400));
        assert_eq!(paired(&mut q, 2, 420), [Some(300), Some(400)]);
        assert_eq!(q.unmatched, 0);
    }

    #[test]
    fn lost_edges_leave_their_samples_to_the_line() {
        let mut q = queue(&[200, 300]);
        assert_eq!(paired(&mut q, 3, 320), [None, Some(200), Some(300)]);
        assert_eq!(q.unmatched, 1);
        let mut q = queue(&[101, 300]);
        assert_eq!(paired(&mut q, 3, 320), [Some(101), None, Some(300)]);
        // The edge of the newest sample is late; when it comes it is of no sample of the next read.
        let mut q = queue(&[100, 200]);
        assert_eq!(paired(&mut q, 3, 320), [Some(100), Some(200), None]);
        [300, 400, 500].into_iter().for_each(|t| q.push(Nanos(t), Nanos(t)));
        assert_eq!(paired(&mut q, 2, 550), [Some(400), Some(500)]);
        assert_eq!(q.unmatched, 2);
        assert!(q.stamps().is_empty());
        assert_eq!(paired(&mut queue(&[]), 2, 320), [None; 2]);
    }

    #[test]
    fn more_edges_than_samples_are_counted() {
        let mut q = queue(&[100, 200, 300, 400]);
        assert_eq!(paired(&mut q, 2, 420), [Some(300), Some(400)]);
        assert_eq!(q.unmatched, 2);
        let mut q = queue(&[100]);
        assert_eq!(paired(&mut q, 0, 420), []);
        assert_eq!((q.unmatched, q.stamps().len()), (1, 0), "an old edge without a sample is not kept");
    }

    #[test]
    fn edges_of_another_clock_and_out_of_order_are_refused() {
        let mut q = queue(&[100]);
        q.push(Nanos(100), Nanos(100));
        q.push(Nanos(1_700_000_000_000_000_000), Nanos(200));
        q.push(Nanos(i64::MIN), Nanos(200));
        assert_eq!((q.stamps().len(), q.refused), (1, 3));
        for t in 0..300 {
            q.push(Nanos(1000 + t), Nanos(1000));
        }
        assert_eq!((q.stamps().len(), q.refused), (EDGES, 3 + 300 + 1 - EDGES as u64));
    }

    proptest! {
        #[test]
        fn pairs_are_in_order_and_no_edge_is_given_twice(
            stamps in proptest::collection::vec(0i64..30_000, 0..300), n in 0usize..300, before in 0i64..40_000,
        ) {
            let mut stamps = stamps;
            stamps.sort_unstable();
            let mut q = queue(&stamps);
            let of = paired(&mut q, n, before);
            prop_assert_eq!(of.len(), n);
            let given: Vec<i64> = of.into_iter().flatten().chain(q.stamps().iter().map(|t| t.0)).collect();
            prop_assert!(given.windows(2).all(|w| w[0] < w[1]));
            prop_assert!(q.stamps().len() <= 1);
        }
    }
}
