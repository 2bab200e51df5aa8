//! Parts that both versions of libgpiod's interface share: what a line is wanted for, handles, and tables of functions that
//! are found when the library is loaded.

use serde::{Deserialize, Serialize};
use std::ffi::{c_int, c_uint, c_void, CString};

/// The edge that means that a sample is ready.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Edge {
    Rising,
    Falling,
}

#[derive(Clone, Copy)]
pub(super) enum Purpose {
    Edges(Edge),
    Output { active_low: bool },
}

/// A line to request, in C's strings, so that requesting it anew allocates nothing.
pub(super) struct Wanted {
    pub(super) chip: CString,
    pub(super) line: CString,
    /// `line` where it is a number.
    pub(super) offset: Option<c_uint>,
    pub(super) purpose: Purpose,
}

/// Edges that the kernel queues for one line.
pub(super) const EVENTS: usize = 16;

pub(super) type Handle = *mut c_void;

/// An object of the library, given back when it is dropped.
pub(super) struct Held(pub(super) Handle, unsafe extern "C" fn(Handle));

impl Held {
    /// `made` is of the kind that `free` frees, or null where making it failed: then the errno.
    pub(super) fn new(made: Handle, free: unsafe extern "C" fn(Handle)) -> Result<Held, i32> {
        if made.is_null() {
            return Err(errno());
        }
        Ok(Held(made, free))
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        // SAFETY: not null, of the kind that `1` frees, and freed once.
        unsafe { (self.1)(self.0) }
    }
}

pub(super) fn errno() -> i32 {
    std::io::Error::last_os_error().raw_os_error().unwrap_or(libc::EIO)
}

/// The answer of a call that is negative where it failed: then the errno.
pub(super) fn checked(answer: c_int) -> Result<c_int, i32> {
    if answer < 0 {
        return Err(errno());
    }
    Ok(answer)
}

/// Declares a table of C functions, `Api`.
macro_rules! api {
    ($($name:ident: fn($($arg:ty),*) $(-> $answer:ty)?;)*) => {
        pub(super) struct Api {
            $($name: unsafe extern "C" fn($($arg),*) $(-> $answer)?,)*
        }

        impl Api {
            /// # Safety
            /// What `library` has by these names are functions of these types, and it is never unloaded.
            pub(super) unsafe fn of(library: &libloading::Library) -> Result<Api, libloading::Error> {
                // SAFETY: as the caller promises.
                Ok(Api { $($name: *unsafe { library.get(concat!(stringify!($name), "\0").as_bytes()) }?,)* })
            }

            /// In tests every call can be made to fail.
            #[cfg(test)]
            pub(super) const SIMULATED: Api = Api { $($name: crate::gpio::tests::simulated::$name,)* };
        }
    };
}
pub(super) use api;
