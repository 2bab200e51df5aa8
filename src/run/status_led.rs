//! The status LED of a board: the state of a run for somebody who stands beside it without a screen.
//!
//! | state | LED |
//! |---|---|
//! | boot: no frame has a pose yet | a short flash a second |
//! | tracking | on |
//! | lost: no pose for half a second | on and off, twice a second |
//! | fault: something broke, or the run could not start | three quick flashes a second, two seconds of them after the end |
//! | ended as asked | off |

use super::threads;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering::Relaxed};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use stipple_drivers::gpio::{LineName, Output};
use stipple_drivers::Fault;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Boot,
    Tracking,
    Lost,
    Fault,
}

const STATES: [State; 4] = [State::Boot, State::Tracking, State::Lost, State::Fault];
const TICK: Duration = Duration::from_millis(50);
/// Ten frames at 20 Hz.
const LOST_AFTER: Duration = Duration::from_millis(500);
/// How long a fault is shown when nothing runs any more.
const FAULT_SHOWN: Duration = Duration::from_secs(2);

static IS_WIRED: AtomicBool = AtomicBool::new(false);
static PANICKED: AtomicBool = AtomicBool::new(false);

/// Turns the LED on, where there is one, and leaves time for it: the process is about to abort.
pub fn show_panic() {
    PANICKED.store(true, Relaxed);
    if IS_WIRED.load(Relaxed) {
        std::thread::sleep(2 * TICK);
    }
}

impl State {
    /// Whether the LED is on at this time after some second began.
    fn is_on(self, at: Duration) -> bool {
        let ms = at.as_millis() % 1000;
        match self {
            State::Boot => ms < 100,
            State::Tracking => true,
            State::Lost => ms % 500 < 250,
            State::Fault => ms < 600 && ms % 200 < 100,
        }
    }
}

/// Thread `led`: blinks until it is dropped; then shows a fault unless the run `ended_well`.
pub struct StatusLed {
    state: Arc<AtomicU8>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    well: bool,
    /// Frames with a pose, and when there was a new one.
    posed: (u64, Instant),
}

impl StatusLed {
    /// On the line of a board, and whether low is active; without a line there is no LED.
    pub fn open(led: Option<(LineName, bool)>) -> Result<Option<StatusLed>, Fault> {
        let Some((name, active_low)) = led else { return Ok(None) };
        let mut line = Output::open(&name, active_low)?;
        // An LED that fails is not worth a run.
        Ok(Some(StatusLed::start(move |on| drop(line.set(on)))))
    }

    fn start(mut set: impl FnMut(bool) + Send + 'static) -> StatusLed {
        let (state, stop) = (Arc::new(AtomicU8::new(State::Boot as u8)), Arc::new(AtomicBool::new(false)));
        let (shown, asked, begun) = (state.clone(), stop.clone(), Instant::now());
        IS_WIRED.store(true, Relaxed);
        let thread = super::start("led", move || {
            let mut was = false;
            while !asked.load(Relaxed) {
                threads::alive();
                let state = STATES[usize::from(shown.load(Relaxed))];
                // Nobody blinks for a process that has ended: after a panic it stays on.
                let on = PANICKED.load(Relaxed) || state.is_on(begun.elapsed());
                if on != was {
                    was = on;
                    set(on);
                }
                std::thread::sleep(TICK);
            }
            set(false);
        });
        StatusLed { state, stop, thread: Some(thread), well: false, posed: (0, begun) }
    }

    /// Frames that have a pose so far, and whether something broke.
    pub fn show(&mut self, posed: u64, broke: bool, now: Instant) {
        if posed != self.posed.0 {
            self.posed = (posed, now);
        }
        let state = match posed {
            _ if broke => State::Fault,
            0 => State::Boot,
            _ if now.saturating_duration_since(self.posed.1) < LOST_AFTER => State::Tracking,
            _ => State::Lost,
        };
        self.state.store(state as u8, Relaxed);
    }

    pub fn ended_well(&mut self) {
        self.well = true;
    }
}

impl Drop for StatusLed {
    fn drop(&mut self) {
        if !self.well {
            self.state.store(State::Fault as u8, Relaxed);
            std::thread::sleep(FAULT_SHOWN);
        }
        self.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::sync::Mutex;

    #[test]
    fn states_differ_at_a_glance() {
        let flashes = |state: State| {
            let on: Vec<bool> = (0..200).map(|i| state.is_on(Duration::from_millis(10 * i))).collect();
            (on.windows(2).filter(|w| !w[0] && w[1]).count(), on.iter().filter(|o| **o).count())
        };
        // Within two seconds: times that it goes on after the start, and hundredths of a second that it is.
        assert_eq!(STATES.map(flashes), [(1, 20), (0, 200), (3, 100), (5, 60)]);
    }

    #[test]
    fn the_state_follows_the_poses() {
        let mut led = StatusLed::start(|_| {});
        let start = Instant::now();
        let mut after = |posed, broke, ms| {
            led.show(posed, broke, start + Duration::from_millis(ms));
            STATES[usize::from(led.state.load(Relaxed))]
        };
        assert_eq!(after(0, false, 5000), State::Boot);
        assert_eq!((after(1, false, 9000), after(1, false, 9400)), (State::Tracking, State::Tracking));
        assert_eq!((after(1, false, 9600), after(2, false, 9700)), (State::Lost, State::Tracking));
        assert_eq!(after(3, true, 9750), State::Fault);
        led.ended_well();
    }

    /// What a line was set to while an LED was shown `posed` frames and dropped.
    fn levels(posed: u64, well: bool) -> Vec<bool> {
        let set = Arc::new(Mutex::new(vec![]));
        let line = set.clone();
        let mut led = StatusLed::start(move |on| line.lock().unwrap().push(on));
        led.show(posed, false, Instant::now());
        std::thread::sleep(Duration::from_millis(300));
        if well {
            led.ended_well();
        }
        drop(led);
        let levels = set.lock().unwrap().clone();
        levels
    }

    #[test]
    fn the_line_is_driven_and_left_off_after_a_fault_was_shown() {
        assert_eq!(levels(1, true), [true, false], "on, and off at the end");
        let fault = levels(0, false);
        let flashes = fault.iter().filter(|on| **on).count();
        assert!((4..=8).contains(&flashes) && fault.last() == Some(&false), "{fault:?}");
    }
}
