//! The thread of the autopilot's writer: it begins and ends with a flight.

use super::status::Status;
use super::threads;
use super::tracking::Tracker;
use crate::config::MavlinkConfig;
use crate::publish::mavlink::{Autopilot, Stamps};
use crate::publish::Feed;
use std::sync::atomic::{AtomicBool, Ordering::Release};
use std::sync::Arc;
use std::thread::JoinHandle;
use stipple_drivers::Fault;

pub struct AutopilotThread {
    feed: Feed,
    over: Arc<AtomicBool>,
    /// `None` once it was waited for.
    thread: Option<JoinHandle<()>>,
}

impl AutopilotThread {
    /// Starts the writer that a board names, and lets states and lines go to it; `None` where it names none. Epochs of a run
    /// follow those `epochs_before`, so that an autopilot notices a run that was started anew.
    pub fn start(
        config: &MavlinkConfig,
        stamps: Stamps,
        epochs_before: u32,
        tracker: &mut Tracker,
        status: &mut Status,
    ) -> Result<Option<AutopilotThread>, Fault> {
        let Some((autopilot, feed)) = Autopilot::new(config, stamps, epochs_before)? else { return Ok(None) };
        if let Tracker::Odometry(run) = tracker {
            run.back.feed = Some(feed.clone());
            run.carrier.iter_mut().for_each(|carrier| carrier.feed = Some(feed.clone()));
        }
        status.tell_autopilot(feed.clone());
        let over = Arc::new(AtomicBool::new(false));
        let asked = over.clone();
        let thread = super::start("autopilot", move || autopilot.run(&asked, threads::alive));
        Ok(Some(AutopilotThread { feed, over, thread: Some(thread) }))
    }

    /// Waits for its end, and adds what it counted.
    pub fn finish(mut self, counters: &mut Vec<(&'static str, u64)>) {
        self.end();
        counters.extend(self.feed.counters());
    }

    fn end(&mut self) {
        self.over.store(true, Release);
        if let Some(thread) = self.thread.take() {
            // A panic ends the process before.
            let _ = thread.join();
        }
    }
}

impl Drop for AutopilotThread {
    fn drop(&mut self) {
        self.end();
    }
}
