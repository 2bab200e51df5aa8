//! How a section of a board file is declared: each key once, with its type, default, bounds and documentation, from which
//! its parsing, its check and its row in board-configs/README.md follow.

/// Values that a number of a board file may have.
#[derive(Clone, Copy, Debug)]
pub enum Bound {
    /// Not a number.
    Any,
    Within(f64, f64),
    /// Finite and above zero.
    Positive,
    /// Within, and a multiple of the third.
    Multiple(f64, f64, f64),
    PowerOfTwo(f64, f64),
}

impl Bound {
    pub fn holds(self, v: f64) -> bool {
        match self {
            Bound::Any => true,
            Bound::Within(low, high) => (low..=high).contains(&v),
            Bound::Positive => v.is_finite() && v > 0.0,
            Bound::Multiple(low, high, divisor) => (low..=high).contains(&v) && v % divisor == 0.0,
            Bound::PowerOfTwo(low, high) => (low..=high).contains(&v) && v.log2().fract() == 0.0,
        }
    }
}

impl std::fmt::Display for Bound {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Bound::Any => Ok(()),
            Bound::Within(low, high) => write!(f, "{low} to {high}"),
            Bound::Positive => write!(f, "positive"),
            Bound::Multiple(low, high, divisor) => write!(f, "a multiple of {divisor}, {low} to {high}"),
            Bound::PowerOfTwo(low, high) => write!(f, "a power of two, {low} to {high}"),
        }
    }
}

/// A key of a board file.
#[derive(Clone, Copy, Debug)]
pub struct Key {
    /// `section.key`; without a section for those at the top.
    pub name: &'static str,
    /// Meaning, and when to change it.
    #[cfg_attr(not(feature = "instruments"), allow(dead_code))]
    // the test that writes board-configs/README.md reads it
    pub doc: &'static str,
    pub bound: Bound,
}

/// Declares a section: a struct, its `Default`, and its `KEYS`; a number states its bounds. Behind `tuning` stand constants of
/// the method: no board file sets them, but a bench does, by name (`tune`). Keys without a default are `required`.
macro_rules! section {
    ($(#[doc = $about:literal])+ $name:ident, $prefix:literal, required;
     $($(#[doc = $doc:literal])+ $key:ident: $type:ty $(, $bound:expr)?;)+) => {
        $(#[doc = $about])+
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name { $($(#[doc = $doc])+ pub $key: $type),+ }
        section!(@keys $name, $prefix; $($(#[doc = $doc])+ $key $(, $bound)?;)+);
    };
    ($(#[doc = $about:literal])+ $name:ident, $prefix:literal;
     $($(#[doc = $doc:literal])+ $key:ident: $type:ty = $default:expr $(, $bound:expr)?;)+
     $(tuning $($(#[doc = $note:literal])* $constant:ident: $of:ty = $value:expr;)+)?) => {
        $(#[doc = $about])+
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name {
            $($(#[doc = $doc])+ pub $key: $type,)+
            $($($(#[doc = $note])* #[serde(skip)] pub $constant: $of,)+)?
        }
        impl Default for $name {
            fn default() -> $name {
                $name { $($key: $default,)+ $($($constant: $value,)+)? }
            }
        }
        $(impl $name {
            /// Sets a constant of the method; false where there is none of this name, or it is of another type.
            #[cfg(feature = "instruments")]
            pub(super) fn tune(&mut self, name: &str, value: &toml::Value) -> bool {
                match name {
                    $(stringify!($constant) => value.clone().try_into().map(|v| self.$constant = v).is_ok(),)+
                    _ => false,
                }
            }

            /// The value of a constant of the method.
            #[cfg(feature = "instruments")]
            pub(super) fn constant(&self, name: &str) -> Option<toml::Value> {
                match name {
                    $(stringify!($constant) => toml::Value::try_from(self.$constant.clone()).ok(),)+
                    _ => None,
                }
            }
        })?
        section!(@keys $name, $prefix; $($(#[doc = $doc])+ $key $(, $bound)?;)+);
    };
    (@keys $name:ident, $prefix:literal; $($(#[doc = $doc:literal])+ $key:ident $(, $bound:expr)?;)+) => {
        impl $name {
            pub(super) const KEYS: &'static [$crate::config::section::Key] = &[$($crate::config::section::Key {
                name: concat!($prefix, stringify!($key)),
                doc: concat!($($doc),+),
                bound: section!(@bound $($bound)?),
            }),+];
        }
    };
    (@bound) => { $crate::config::section::Bound::Any };
    (@bound $bound:expr) => { $bound };
}
pub(super) use section;
