//! Loops compiled for the vector registers of the machine they run on.

/// A loop that is compiled also for wider vector registers than the target guarantees. `run` and all it
/// calls must be `#[inline(always)]`: what is not inlined is compiled for the target.
pub trait Wide: Sized {
    type Output;
    fn run(self) -> Self::Output;

    /// Runs with the vector registers the machine has. Products are never fused with sums, so the result
    /// is the same to the bit on every width.
    fn wide(self) -> Self::Output {
        pulp::Arch::new().dispatch(Dispatched(self))
    }
}

struct Dispatched<W>(W);

impl<W: Wide> pulp::NullaryFnOnce for Dispatched<W> {
    type Output = W::Output;
    #[inline(always)]
    fn call(self) -> W::Output {
        self.0.run()
    }
}
