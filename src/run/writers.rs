//! The threads of those who tell others of a flight: they begin and end with it.

use super::status::Status;
use super::threads;
use super::tracking::Tracker;
use crate::config::Board;
use crate::publish::cloud::Cloud;
use crate::publish::event::EventId;
use crate::publish::mavlink::Autopilot;
use crate::publish::status::{About, StatusServer};
use crate::publish::{Feed, Feeds, Stamps};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Release};
use std::sync::Arc;
use std::thread::JoinHandle;
use stipple_drivers::{host, Fault};

/// Nice value of the thread that answers on the status socket: after sensors and odometry.
const NICE: i32 = 5;

struct Writer {
    feed: Feed,
    over: Arc<AtomicBool>,
    /// `None` once it was waited for.
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    fn start(name: &'static str, feed: Feed, work: impl FnOnce(&AtomicBool) + Send + 'static) -> Writer {
        let over = Arc::new(AtomicBool::new(false));
        let asked = over.clone();
        let thread = super::start(name, move || work(&asked));
        Writer { feed, over, thread: Some(thread) }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.over.store(true, Release);
        self.feed.wake();
        if let Some(thread) = self.thread.take() {
            // A panic ends the process before.
            let _ = thread.join();
        }
    }
}

type Counted = Box<dyn Fn() -> Vec<(&'static str, u64)>>;

/// The writers of a flight.
#[derive(Default)]
pub struct Writers {
    writers: Vec<Writer>,
    /// What they counted.
    counted: Vec<Counted>,
}

/// Where a run's status socket is: in the folder that the service manager made for it, else in that of its results.
pub fn socket(out: &Path) -> PathBuf {
    // More than one folder is separated by colons.
    let given =
        std::env::var_os("RUNTIME_DIRECTORY").filter(|dir| !dir.is_empty() && !dir.to_string_lossy().contains(':'));
    given.map_or_else(|| out.to_path_buf(), PathBuf::from).join("status")
}

impl Writers {
    /// Starts the writer to the autopilot that a board names, and the status socket, and lets states and events go to them.
    /// Epochs of a run follow those `epochs_before`, so that an autopilot notices a run that was started anew.
    pub fn start(
        board: &Board,
        stamps: Stamps,
        epochs_before: u32,
        (socket, about, cloud): (&Path, About, Option<Arc<Cloud>>),
        tracker: &mut Tracker,
        status: &mut Status,
    ) -> Result<Writers, Fault> {
        let (mut writers, mut feeds) = (Writers::default(), Feeds::default());
        if let Some((autopilot, feed)) = Autopilot::new(&board.mavlink, stamps, epochs_before)? {
            let (counts, of_feed) = (autopilot.counts(), feed.clone());
            let counted =
                move || [counts.list(), of_feed.counters(["mavlink_states_skipped", "mavlink_events_lost"])].concat();
            writers.counted.push(Box::new(counted));
            status.tell_autopilot(autopilot.settings());
            feeds.0.push(feed.clone());
            let run = move |over: &AtomicBool| autopilot.run(over, threads::alive);
            writers.writers.push(Writer::start("autopilot", feed, run));
        }
        match StatusServer::new(socket, about, stamps, cloud) {
            Ok((server, feed, shared)) => {
                let (counts, of_feed) = (shared.clone(), feed.clone());
                let counted = move || {
                    [counts.counts.list(), of_feed.counters(["status_states_skipped", "status_events_lost"])].concat()
                };
                writers.counted.push(Box::new(counted));
                status.tell_readers(shared);
                feeds.0.push(feed.clone());
                let run = move |over: &AtomicBool| {
                    host::lower_priority(NICE);
                    server.run(over, threads::alive);
                };
                writers.writers.push(Writer::start("status", feed, run));
            }
            Err(e) => {
                let line = format!("no status socket at {}: {e}; the run goes on without", socket.display());
                status.say(EventId::SystemRefused, &line);
            }
        }
        if let Tracker::Odometry(run) = tracker {
            run.back.feeds = feeds.clone();
            run.carrier.iter_mut().for_each(|carrier| carrier.feeds = feeds.clone());
        }
        status.tell_writers(feeds);
        Ok(writers)
    }

    /// Waits for their end, and adds what they counted.
    pub fn finish(mut self, counters: &mut Vec<(&'static str, u64)>) {
        self.writers.clear();
        counters.extend(self.counted.iter().flat_map(|counted| counted()));
    }
}
