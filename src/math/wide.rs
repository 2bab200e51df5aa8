//! Loops compiled for the vector registers of the machine they run on.

/// Defines a function of which a copy is compiled for each width of vector registers that a machine may have, and which
/// runs the widest there is. What it calls must be `#[inline(always)]`, or it is compiled for the target's alone.
/// Products are never fused with sums, so the result is the same to the bit on every width.
macro_rules! wide {
    ($(#[$meta:meta])* $seen:vis fn $name:ident<$l:lifetime>($($arg:ident: $of:ty),+ $(,)?) -> $out:ty $body:block) => {
        $(#[$meta])*
        $seen fn $name<$l>($($arg: $of),+) -> $out {
            struct Call<$l> { $($arg: $of),+ }
            impl<$l> pulp::NullaryFnOnce for Call<$l> {
                type Output = $out;
                #[inline(always)]
                fn call(self) -> $out {
                    let Call { $($arg),+ } = self;
                    $body
                }
            }
            pulp::Arch::new().dispatch(Call { $($arg),+ })
        }
    };
}
pub(crate) use wide;
