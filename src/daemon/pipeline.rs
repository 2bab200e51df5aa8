//! The threads of tracking: one that takes turns, or one for each half.
//!
//! ```text
//! take() -> front end -seen-> back end -> give()      slots
//!               ^--predictors--'                      one a frame
//! ```
//!
//! The front end begins frame k when the predictor of frame k-2 has come, so the back end is at most
//! one frame behind, and neither queue can fill. Who waits parks and is woken by a `Bell`; there is
//! no lock. What a slot is taken from and given to is up to the pace of the run.

use super::tracking::{look_up, Slot, Tracking};
use crate::counters::Counters;
use crate::mem::seal_thread;
use crate::output::process::thread_cpu_secs;
use crate::vio::predict::Predictor;
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::OnceLock;
use std::thread::{park_timeout, Scope, Thread};
use std::time::{Duration, Instant};

/// Frames between the two halves: the one being followed and the one being estimated.
pub const SLOTS_BETWEEN: usize = 2;
/// A ring that came before its thread was known costs at most this.
const PARK_MAX: Duration = Duration::from_millis(5);

/// Wakes the one thread that waits at it.
#[derive(Default)]
pub struct Bell(OnceLock<Thread>);

impl Bell {
    pub fn ring(&self) {
        if let Some(thread) = self.0.get() {
            thread.unpark();
        }
    }

    /// What `poll` answers first, or `None` once nothing more comes.
    pub fn wait<T>(&self, over: &AtomicBool, mut poll: impl FnMut() -> Option<T>) -> Option<T> {
        self.0.get_or_init(std::thread::current);
        loop {
            // Read before the queue, so that what came last is still taken.
            let over = over.load(Ordering::Acquire);
            let polled = poll();
            if polled.is_some() || over {
                return polled;
            }
            park_timeout(PARK_MAX);
        }
    }
}

/// Sets a flag and wakes who waits for it, when its thread ends for whatever reason.
pub struct Ends<'a>(pub &'a AtomicBool, pub Option<&'a Bell>);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
        if let Some(bell) = self.1 {
            bell.ring();
        }
    }
}

pub struct Pipeline {
    seen: ArrayQueue<Box<Slot>>,
    predictors: ArrayQueue<Predictor>,
    /// At which the thread that takes slots waits.
    pub taker: Bell,
    back: Bell,
    front_done: AtomicBool,
    back_done: AtomicBool,
}

impl Pipeline {
    pub fn new() -> Pipeline {
        Pipeline {
            seen: ArrayQueue::new(SLOTS_BETWEEN),
            predictors: ArrayQueue::new(SLOTS_BETWEEN),
            taker: Bell::default(),
            back: Bell::default(),
            front_done: AtomicBool::new(false),
            back_done: AtomicBool::new(false),
        }
    }

    /// Starts the threads. `take` answers the next slot if there is one, until `over`; `give` gets
    /// each slot back, in order, on the last of the threads, and `ended` is dropped at its end.
    pub fn start<'scope, 'env>(
        &'env self,
        scope: &'scope Scope<'scope, 'env>,
        tracking: &'env mut Tracking,
        over: &'env AtomicBool,
        counters: &'env Counters,
        mut take: impl FnMut() -> Option<Box<Slot>> + Send + 'scope,
        mut give: impl FnMut(Box<Slot>) + Send + 'scope,
        ended: impl Send + 'scope,
    ) {
        let run = match tracking {
            Tracking::Table(poses) => {
                scope.spawn(move || {
                    let _ended = ended;
                    seal();
                    while let Some(mut slot) = self.taker.wait(over, &mut take) {
                        look_up(poses, &mut slot, counters);
                        give(slot);
                    }
                });
                return;
            }
            Tracking::Odometry(run) => run.as_mut(),
        };
        let (front, back) = (&mut run.front, &mut run.back);
        let start = back.predictor();
        if run.threads == 1 {
            scope.spawn(move || {
                let _ended = ended;
                seal();
                let (mut predictor, mut next) = (start, start);
                while let Some(mut slot) = self.taker.wait(over, &mut take) {
                    front.track(&mut slot, &predictor);
                    back.estimate(&mut slot);
                    (predictor, next) = (next, back.predictor());
                    give(slot);
                }
                front.cpu_s = thread_cpu_secs();
            });
            return;
        }
        scope.spawn(move || {
            let _ended = Ends(&self.front_done, Some(&self.back));
            seal();
            let (mut predictor, mut frames) = (start, 0u64);
            loop {
                if frames >= SLOTS_BETWEEN as u64 {
                    let begun = Instant::now();
                    let Some(newer) = self.taker.wait(&self.back_done, || self.predictors.pop()) else { break };
                    front.busy_s += begun.elapsed().as_secs_f64();
                    predictor = newer;
                }
                let Some(mut slot) = self.taker.wait(over, &mut take) else { break };
                front.track(&mut slot, &predictor);
                frames += 1;
                // There is room: the back end has finished all but the last.
                let _ = self.seen.push(slot);
                self.back.ring();
            }
            front.cpu_s = thread_cpu_secs();
        });
        scope.spawn(move || {
            let _ended = (ended, Ends(&self.back_done, Some(&self.taker)));
            seal();
            while let Some(mut slot) = self.back.wait(&self.front_done, || self.seen.pop()) {
                back.estimate(&mut slot);
                let _ = self.predictors.push(back.predictor());
                self.taker.ring();
                give(slot);
            }
            back.cpu_s = thread_cpu_secs();
        });
    }
}

/// From here on the thread allocates nothing; what asking for its own handle allocates comes first.
fn seal() {
    let _ = std::thread::current();
    seal_thread();
}
