//! The threads of a run: their names, priorities and signs of life, and what a panic in one of them does.
//!
//! A thread says `alive` whenever it waits or begins a piece of work; the main thread asks who has been silent. Threads on
//! whom a state's age depends ask for real-time priority where a run wants it. A panic anywhere ends the process: the hook
//! writes one line, lets the light and the log tell of it, and aborts, so that nothing waits for a thread that is gone.

use super::status::print_err;
use crate::config::ThreadRule;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError};
use stipple_drivers::{host, Fault, FaultKind, Span};

/// Threads of a run that are watched at once.
const SLOTS: usize = 16;
/// Priorities among real-time threads, and how long each may be silent, s. A pulse that starts an exposure comes before
/// everything; an anchor may take the mapper long, and a card that stalls those who write.
const WATCHED: [(&str, i32, f64); 14] = [
    ("main", 0, 5.0),
    ("trigger", 13, 5.0),
    ("imu", 12, 5.0),
    ("camera", 11, 5.0),
    ("barometer", 10, 5.0),
    ("tracking", 10, 5.0),
    ("frontend", 10, 5.0),
    ("estimator", 10, 5.0),
    ("mapping", 0, 60.0),
    ("map-answers", 0, 5.0),
    ("beat", 0, 5.0),
    ("led", 0, 5.0),
    ("log", 0, 30.0),
    ("writer", 0, 30.0),
];

/// What is known of the threads: their names, panics asked for, and why the system refused a priority.
struct Registry {
    names: [Option<&'static str>; SLOTS],
    panics: Vec<ThreadRule>,
    refused: Option<String>,
}

static REGISTRY: Mutex<Registry> = Mutex::new(Registry { names: [None; SLOTS], panics: vec![], refused: None });
/// Last sign of life of each thread, and when it is to panic, ns of the monotonic clock; 0: never.
static BEATS: [AtomicI64; SLOTS] = [const { AtomicI64::new(0) }; SLOTS];
static PANICS: [AtomicI64; SLOTS] = [const { AtomicI64::new(0) }; SLOTS];
static REALTIME: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// Where the calling thread is watched, and its name.
    static SLOT: Cell<Option<(usize, &'static str)>> = const { Cell::new(None) };
}

fn registry() -> MutexGuard<'static, Registry> {
    REGISTRY.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A thread that is watched until this is dropped.
pub struct Watched(usize);

/// Watches the calling thread from here on, and gives it the priority of its name where the run asks for priorities.
pub fn watch(name: &'static str) -> Watched {
    let mut registry = registry();
    let slot = registry.names.iter().position(Option::is_none).unwrap_or(SLOTS);
    if slot < SLOTS {
        registry.names[slot] = Some(name);
        let now = host::monotonic();
        let panics = registry.panics.iter().find(|rule| rule.name == name);
        PANICS[slot].store(panics.map_or(0, |rule| (now + Span::from_secs(rule.panic_s)).0), Relaxed);
        BEATS[slot].store(now.0, Relaxed);
        SLOT.set(Some((slot, name)));
    }
    drop(registry);
    if let Some((_, priority, _)) = WATCHED.iter().find(|(known, priority, _)| *known == name && *priority > 0) {
        ask_for_priority(*priority);
    }
    Watched(slot)
}

impl Drop for Watched {
    fn drop(&mut self) {
        if self.0 < SLOTS {
            SLOT.set(None);
            registry().names[self.0] = None;
        }
    }
}

/// Says that the calling thread goes on. Allocates nothing.
pub fn alive() {
    if let Some((slot, _)) = SLOT.get() {
        let now = host::monotonic().0;
        BEATS[slot].store(now, Relaxed);
        let at = PANICS[slot].load(Relaxed);
        assert!(at == 0 || now < at, "as the rules of --inject ask");
    }
}

/// The first thread that has been silent for longer than it may, if there is one.
pub fn silent() -> Option<&'static str> {
    let (names, now) = (registry().names, host::monotonic());
    names.into_iter().zip(&BEATS).find_map(|(name, beat)| {
        let (known, _, limit_s) = WATCHED.iter().find(|(known, ..)| Some(*known) == name)?;
        (now.0 - beat.load(Relaxed) > Span::from_secs(*limit_s).0).then_some(*known)
    })
}

/// Asks for real-time priorities of the threads that start from here on, and for memory that stays resident. What the
/// system does not allow is told by `refused`.
pub fn ask_for_realtime() {
    REALTIME.store(true, Relaxed);
    if let Err(e) = host::lock_memory() {
        registry().refused = Some(format!("memory may be swapped out: {e}; allow it with LimitMEMLOCK=infinity"));
    }
}

fn ask_for_priority(priority: i32) {
    if REALTIME.load(Relaxed) {
        if let Err(e) = host::ask_for_realtime(priority) {
            registry().refused = Some(format!("threads have no real-time priority: {e}; allow it with LimitRTPRIO=20"));
        }
    }
}

/// Why the system refused a priority or resident memory, once.
pub fn refused() -> Option<String> {
    registry().refused.take()
}

/// Makes threads that start from here on panic by these rules; fails where one names no thread.
pub fn panic_in(rules: &[ThreadRule]) -> Result<(), Fault> {
    let names = WATCHED.map(|(name, ..)| name);
    if let Some(rule) = rules.iter().find(|rule| !names.contains(&&*rule.name)) {
        let what = format!("no thread of the name {} can be asked to panic", rule.name);
        return Err(Fault::new(FaultKind::Config, "--inject", what, format!("name one of {}", names.join(", "))));
    }
    registry().panics.extend_from_slice(rules);
    Ok(())
}

/// The rules of `panic_in`, for a process that this one starts.
pub fn panics() -> Vec<ThreadRule> {
    registry().panics.clone()
}

/// Makes a panic of any thread end the process; `tell` is called before.
pub fn abort_on_panic(tell: impl Fn(&str) + Send + Sync + 'static) {
    static TOLD: AtomicBool = AtomicBool::new(false);
    std::panic::set_hook(Box::new(move |info| {
        // One that panics while another does is not waited for.
        if !TOLD.swap(true, Relaxed) {
            let what = info.to_string().replace('\n', " ");
            let thread = std::thread::current();
            let name = SLOT.get().map(|(_, name)| name).or(thread.name()).unwrap_or("without a name");
            let what = format!("thread {name} {what}");
            print_err(format_args!("stipple: {what}; this is a mistake of the program, please report it"));
            tell(&what);
        }
        std::process::abort();
    }));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_is_watched_while_it_lives_and_named_when_it_is_silent() {
        let watched = watch("estimator");
        assert_eq!(silent(), None);
        BEATS[watched.0].store(host::monotonic().0 - 6_000_000_000, Relaxed);
        assert_eq!(silent(), Some("estimator"));
        alive();
        assert_eq!(silent(), None);
        BEATS[watched.0].store(1, Relaxed);
        drop(watched);
        assert_eq!(silent(), None, "its thread has ended");
    }
}
