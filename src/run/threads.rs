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
use std::time::Duration;
use stipple_drivers::{host, Fault, FaultKind, Span};

/// How often the guard looks for a thread that hangs, and the exit code then (sysexits).
const LOOK_PERIOD: Duration = Duration::from_secs(1);
const EX_SOFTWARE: i32 = 70;
/// Threads of a run that are watched at once.
const SLOTS: usize = 20;
/// Priorities among real-time threads, and how long each may be silent, s. A pulse that starts an exposure comes before
/// everything; an anchor may take the mapper long, and a card that stalls those who write.
const WATCHED: [(&str, i32, f64); 16] = [
    ("main", 0, 5.0),
    ("trigger", 13, 5.0),
    ("imu", 12, 5.0),
    ("camera", 11, 5.0),
    ("barometer", 10, 5.0),
    ("tracking", 10, 5.0),
    ("frontend", 10, 5.0),
    ("estimator", 10, 5.0),
    ("autopilot", 9, 5.0),
    ("status", 0, 30.0),
    ("mapping", 0, 60.0),
    ("map-answers", 0, 5.0),
    ("beat", 0, 5.0),
    ("led", 0, 5.0),
    ("log", 0, 30.0),
    ("writer", 0, 30.0),
];

/// What is known of the threads.
struct Registry {
    names: [Option<&'static str>; SLOTS],
    /// Panics and hangs that are asked for.
    rules: Vec<ThreadRule>,
    /// Why the system refused a priority, and resident memory.
    refused: [Option<String>; 2],
    /// Whether that was told.
    told: [bool; 2],
}

static REGISTRY: Mutex<Registry> =
    Mutex::new(Registry { names: [None; SLOTS], rules: vec![], refused: [None, None], told: [false; 2] });
/// Last sign of life of each thread, and when it is to panic or to hang, ns of the monotonic clock; 0: never.
static BEATS: [AtomicI64; SLOTS] = [const { AtomicI64::new(0) }; SLOTS];
static PANICS: [AtomicI64; SLOTS] = [const { AtomicI64::new(0) }; SLOTS];
static HANGS: [AtomicI64; SLOTS] = [const { AtomicI64::new(0) }; SLOTS];
/// Whether its silence was told.
static TOLD: [AtomicBool; SLOTS] = [const { AtomicBool::new(false) }; SLOTS];
/// Set where the run is to end.
static ENDING: AtomicBool = AtomicBool::new(false);
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
        let rule = registry.rules.iter().find(|rule| rule.name == name);
        let at =
            |after: fn(&ThreadRule) -> Option<f64>| rule.and_then(after).map_or(0, |s| (now + Span::from_secs(s)).0);
        PANICS[slot].store(at(|rule| rule.panic_s), Relaxed);
        HANGS[slot].store(at(|rule| rule.hang_s), Relaxed);
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
        let hangs = HANGS[slot].load(Relaxed);
        if hangs != 0 && now >= hangs {
            loop {
                std::thread::park();
            }
        }
        BEATS[slot].store(now, Relaxed);
        let at = PANICS[slot].load(Relaxed);
        assert!(at == 0 || now < at, "as the rules of --inject ask");
    }
}

/// Threads that have been silent for longer than they may, and their slots. Allocates nothing.
fn silent() -> impl Iterator<Item = (usize, &'static str)> {
    let (names, now) = (registry().names, host::monotonic());
    names.into_iter().zip(&BEATS).enumerate().filter_map(move |(slot, (name, beat))| {
        let (known, _, limit_s) = WATCHED.iter().find(|(known, ..)| Some(*known) == name)?;
        let is_silent = now.0 - beat.load(Relaxed) > Span::from_secs(*limit_s).0;
        TOLD[slot].fetch_and(is_silent, Relaxed);
        is_silent.then_some((slot, *known))
    })
}

/// Threads without which a run is still worth going on.
const SPARED: [&str; 8] = ["autopilot", "status", "barometer", "map-answers", "beat", "led", "log", "writer"];

/// Whether no thread that a run needs has been silent for longer than it may. Allocates nothing.
pub fn are_alive() -> bool {
    silent().all(|(_, name)| SPARED.contains(&name))
}

/// Threads that fell silent for longer than they may since this was asked last.
pub fn fell_silent() -> Vec<&'static str> {
    silent().filter(|(slot, _)| !TOLD[*slot].swap(true, Relaxed)).map(|(_, name)| name).collect()
}

/// Says that the run is to end; a thread that hangs from here on is not waited for.
pub fn ending() {
    ENDING.store(true, Relaxed);
}

/// Starts a thread that ends the process where a run is to end, by `stop` too, and one of its threads hangs: joining that
/// one, or writing to what it waits for, would take for ever. `tell` is called before.
pub fn end_where_one_hangs(stop: &'static AtomicBool, tell: impl Fn(&str) + Send + 'static) {
    super::start("guard", move || loop {
        std::thread::sleep(LOOK_PERIOD);
        if !ENDING.load(Relaxed) && !stop.load(Relaxed) {
            continue;
        }
        // Who reads a worker's answers goes on when that one is killed.
        if let Some((_, name)) = silent().find(|(_, name)| *name != "map-answers") {
            let what = format!("thread {name} hangs and the run is to end: results are not written");
            print_err(format_args!("stipple: {what}; `stipple recover` reads the trajectory from the log"));
            tell(&what);
            host::exit_now(EX_SOFTWARE);
        }
    });
}

/// Asks for real-time priorities of the threads that start from here on, and for memory that stays resident. What the
/// system does not allow is told by `refused`.
pub fn ask_for_realtime() {
    REALTIME.store(true, Relaxed);
    if let Err(e) = host::lock_memory() {
        registry().refused[1] = Some(format!("memory may be swapped out: {e}; allow it with LimitMEMLOCK=infinity"));
    }
}

fn ask_for_priority(priority: i32) {
    if REALTIME.load(Relaxed) {
        if let Err(e) = host::ask_for_realtime(priority) {
            let why = format!("threads have no real-time priority: {e}; allow it with LimitRTPRIO=20");
            registry().refused[0] = Some(why);
        }
    }
}

/// Why the system refused priorities, and resident memory: each once.
pub fn refused() -> Vec<String> {
    let mut registry = registry();
    let Registry { refused, told, .. } = &mut *registry;
    let new =
        refused.iter_mut().zip(told).filter_map(|(why, told)| why.take().filter(|_| !std::mem::replace(told, true)));
    new.collect()
}

/// Makes threads that start from here on panic or hang by these rules; fails where one names no thread.
pub fn disturb(rules: &[ThreadRule]) -> Result<(), Fault> {
    let names = WATCHED.map(|(name, ..)| name);
    if let Some(rule) = rules.iter().find(|rule| !names.contains(&&*rule.name)) {
        let what = format!("no thread of the name {} can be disturbed", rule.name);
        return Err(Fault::new(FaultKind::Config, "--inject", what, format!("name one of {}", names.join(", "))));
    }
    registry().rules.extend_from_slice(rules);
    Ok(())
}

/// The rules of `disturb`, for a process that this one starts.
pub fn rules() -> Vec<ThreadRule> {
    registry().rules.clone()
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
        assert!(fell_silent().is_empty());
        let six_seconds = || BEATS[watched.0].store(host::monotonic().0 - 6_000_000_000, Relaxed);
        six_seconds();
        assert_eq!((fell_silent(), fell_silent()), (vec!["estimator"], vec![]), "told once");
        alive();
        assert!(fell_silent().is_empty());
        six_seconds();
        assert_eq!(fell_silent(), ["estimator"], "told again");
        drop(watched);
        assert!(silent().next().is_none(), "its thread has ended");
    }

    #[test]
    fn what_the_system_refuses_is_told_once_each() {
        registry().refused = ["priority".into(), "memory".into()].map(Some);
        assert_eq!(refused(), ["priority", "memory"]);
        registry().refused[0] = Some("priority".into());
        assert!(refused().is_empty(), "each thread asks, and is refused");
    }
}
