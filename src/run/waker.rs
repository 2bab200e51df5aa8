//! How the threads of a flight wait for one another: parked, without a lock.

use super::threads;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::OnceLock;
use std::thread::{park_timeout, Thread};
use std::time::Duration;

/// Longest wait when a wake-up came before its thread was known.
const PARK_MAX: Duration = Duration::from_millis(5);

/// Wakes the one thread that waits on it.
#[derive(Default)]
pub struct Waker(OnceLock<Thread>);

impl Waker {
    pub fn wake(&self) {
        if let Some(thread) = self.0.get() {
            thread.unpark();
        }
    }

    /// Waits for the first answer of `poll`; `None` once `over` is set and nothing is left.
    pub fn wait<T>(&self, over: &AtomicBool, mut poll: impl FnMut() -> Option<T>) -> Option<T> {
        self.0.get_or_init(std::thread::current);
        loop {
            // Read before the queue, so that what came last is still taken.
            let over = over.load(Ordering::Acquire);
            threads::alive();
            let polled = poll();
            if polled.is_some() || over {
                return polled;
            }
            park_timeout(PARK_MAX);
        }
    }
}

/// Sets a flag and wakes who waits for it when it is dropped: when its thread ends, for whatever reason.
pub struct SetOnDrop<'a>(pub &'a AtomicBool, pub Option<&'a Waker>);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
        if let Some(waker) = self.1 {
            waker.wake();
        }
    }
}
