//! Counters by name. `counters!` declares a set of them once, as fields with a description each; from that come the struct
//! and the list of names and values that reports print.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// A counter that several threads may add to; adding allocates nothing and waits for nobody.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// Adds to it.
    pub fn add(&self, n: u64) {
        self.0.fetch_add(n, Relaxed);
    }

    /// Sets it to `n` where it is less: a largest value.
    pub fn raise(&self, n: u64) {
        self.0.fetch_max(n, Relaxed);
    }

    /// Its value.
    pub fn get(&self) -> u64 {
        self.0.load(Relaxed)
    }
}

/// Declares a struct of counters: `counters! { /// Its description. struct Name of u64, read by u64::clone; field, .. }`.
/// Counters of one thread are `u64`, those of several are [`Counter`], read by `Counter::get`.
#[macro_export]
macro_rules! counters {
    (
        $(#[$meta:meta])* $vis:vis struct $set:ident of $count:ty, read by $read:path;
        $($(#[doc = $doc:literal])* $name:ident),+ $(,)?
    ) => {
        $(#[$meta])*
        #[derive(Debug, Default)]
        $vis struct $set { $($(#[doc = $doc])* pub $name: $count),+ }
        impl $set {
            /// Name and value of each, in the order of declaration.
            $vis fn list(&self) -> Vec<(&'static str, u64)> {
                vec![$((stringify!($name), $read(&self.$name))),+]
            }
        }
    };
}
