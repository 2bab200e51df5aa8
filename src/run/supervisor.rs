//! The main thread's work while sensors, tracking and mapping go on.

use super::governor::Governor;
use super::keyframes::{KeyframeRing, Word};
use super::power::{Energy, PowerMeter};
use super::reload::{BoardSource, Reload};
use super::status::{Gauges, Status};
use super::worker::Worker;
use super::{threads, Realtime, Shared, NOTICES_KEPT, STATUS_PERIOD};
use crate::config::Board;
use crate::counters::Counters;
use crate::publish::event::{EventId, Notice};
use crate::publish::status::message::GovernorStatus;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::host;

/// What steers a run while it goes on: the governor of the mapper, and its board file.
#[derive(Default)]
pub struct Steering {
    governor: Option<Governor>,
    power: Option<PowerMeter>,
    /// Where the board is read again when the flag is set, and the one that flies.
    reload: Option<(BoardSource, Board, &'static AtomicBool)>,
}

impl Steering {
    /// Governs the mapper of `board`, and reads the board of a `managed` run again at SIGHUP.
    pub fn new(board: &Board, source: Option<&BoardSource>, managed: bool) -> Steering {
        let reload = source.filter(|_| managed).map(|source| (source.clone(), board.clone(), host::reload_asked_for()));
        let sys = Path::new("/sys");
        Steering {
            power: Some(PowerMeter::find(sys, Instant::now())),
            governor: board.map.enabled.then(|| Governor::new(&board.governor, board.frontend.threads, sys)),
            reload,
        }
    }

    /// Reads the board again where that is asked for; answers what it came to.
    fn reload(&mut self, status: &mut Status) -> Option<Notice> {
        let (source, running, asked) = self.reload.as_mut()?;
        if !asked.swap(false, Relaxed) {
            return None;
        }
        status.reloading();
        Some(match source.reload(running) {
            Reload::Refused(why) => (EventId::ReloadRefused, why),
            Reload::Same => (EventId::Reloaded, "the board file is as before".into()),
            Reload::Changed(board, keys) => {
                self.governor.iter_mut().for_each(|governor| governor.set(&board.governor));
                status.set_autopilot(&board.mavlink);
                *running = *board;
                (EventId::Reloaded, format!("reloaded: {}", keys.join(", ")))
            }
        })
    }

    /// Energy of the run so far, where the board can measure it.
    pub fn energy(&self) -> Option<Energy> {
        self.power.as_ref()?.energy()
    }

    /// Looks what power the board takes.
    fn meter(&mut self, status: &mut Status) -> Option<f64> {
        let power = self.power.as_mut()?;
        let watts = power.look(Instant::now());
        status.power = power.status();
        watts
    }

    /// Looks whether the mapper is to work less or more; `power_w` is what the board takes, where that is known.
    fn govern(
        &mut self,
        ring: &KeyframeRing,
        power_w: Option<f64>,
        (c, g): (&Counters, &Gauges),
        status: &mut Status,
    ) -> Option<Notice> {
        let governor = self.governor.as_mut()?;
        let latency_most = || Duration::from_micros(g.latency_us_most.swap(0, Relaxed));
        let (frames, overwritten) = (g.frames.load(Relaxed), c.frames_overwritten.get());
        let line = governor.look(Instant::now(), power_w, frames, overwritten, latency_most)?;
        let (share, reason) = governor.share();
        ring.word(Word::Share).store((share * 1000.0) as u64, Relaxed);
        status.governor = GovernorStatus { share, reason: reason.map(|why| why.to_string().into()) };
        Some((EventId::MapperShare, line))
    }
}

/// Takes stops, looks after the worker and the threads, steers, and shows how it goes, until the run is over. Answers the first
/// lines it said.
pub fn supervise(
    s: &Shared,
    run: &Realtime,
    (mut worker, ring): (Option<&mut Worker>, Option<&KeyframeRing>),
    mapped: impl Fn(f64, bool) -> bool,
    status: &mut Status,
    steering: &mut Steering,
) -> Vec<Notice> {
    let (_watched, mut notices) = (threads::watch("main"), vec![]);
    loop {
        threads::alive();
        let t_s = s.start.elapsed().as_secs_f64();
        let tracked = s.tracking_done.load(Ordering::Acquire);
        if tracked && mapped(t_s, worker.is_some()) {
            status.stopping();
            return notices;
        }
        if run.sensors_s.is_some_and(|limit| t_s >= limit) || run.stop.load(Relaxed) {
            s.mailbox.stop.store(true, Relaxed);
            threads::ending();
            status.stopping();
        }
        s.gauges.broke.fetch_or(!s.mailbox.broken.is_empty(), Relaxed);
        let hangs = threads::fell_silent();
        s.counters.threads_silent.add(hangs.len() as u64);
        let hangs = hangs.into_iter().map(|name| format!("thread {name} gives no sign of life"));
        let mut said: Vec<Notice> = hangs.map(|line| (EventId::ThreadSilent, line)).collect();
        said.extend(threads::refused().into_iter().map(|line| (EventId::SystemRefused, line)));
        said.extend(status.epoch_begun(&s.gauges).map(|line| (EventId::Epoch, line)));
        said.extend(status.rig_judged(&s.gauges));
        said.extend(worker.as_mut().and_then(|w| w.watch(&s.gauges)));
        said.extend(std::iter::from_fn(|| s.mailbox.notices.pop()));
        said.extend(status.writers_said());
        let power_w = steering.meter(status);
        said.extend(ring.and_then(|ring| steering.govern(ring, power_w, (&s.counters, &s.gauges), status)));
        said.extend(steering.reload(status));
        for (id, line) in said {
            status.say(id, &line);
            // A cable that comes loose each second, for hours, is in the log.
            if notices.len() < NOTICES_KEPT {
                notices.push((id, line));
            }
        }
        if tracked {
            // Nothing is played any more; the run's own time is what progresses.
            s.gauges.played_ms.fetch_max((t_s * 1e3) as u64, Relaxed);
        }
        status.show(&s.gauges);
        status.log_counters(&s.counters, &s.gauges);
        std::thread::sleep(STATUS_PERIOD);
    }
}
