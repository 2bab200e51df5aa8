//! The scalar of the linear algebra: `f32` or `f64`.
//!
//! States, residuals and Jacobians are f64 throughout; what is generic is the system they are put
//! into, where single precision halves memory and doubles the width of a vector register. The
//! square-root form makes that possible: no information matrix with the square of the Jacobians'
//! condition is ever kept (Demmel et al., ICCV 2021).

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

pub trait Real:
    Copy
    + Debug
    + Default
    + PartialOrd
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
{
    const ZERO: Self;
    const ONE: Self;
    /// Distance from one to the next number.
    const EPSILON: f64;
    const NAME: &'static str;
    fn of(x: f64) -> Self;
    fn f64(self) -> f64;
    fn sqrt(self) -> Self;
}

macro_rules! real {
    ($t:ident) => {
        impl Real for $t {
            const ZERO: $t = 0.0;
            const ONE: $t = 1.0;
            const EPSILON: f64 = $t::EPSILON as f64;
            const NAME: &'static str = stringify!($t);
            #[inline(always)]
            fn of(x: f64) -> $t {
                x as $t
            }
            #[inline(always)]
            fn f64(self) -> f64 {
                self as f64
            }
            #[inline(always)]
            fn sqrt(self) -> $t {
                <$t>::sqrt(self)
            }
        }
    };
}
real!(f32);
real!(f64);

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
