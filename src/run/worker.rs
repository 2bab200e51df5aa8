//! Mapping in a process of its own, so that a GPU driver that crashes, hangs or leaks takes no odometry with it.
//!
//! The process that flies starts `stipple map-worker`, tells it everything on its standard input (TOML), and hands keyframes over
//! through shared memory (`keyframes`). It looks at the worker fifty times a second: one that has ended is started again,
//! one that is stopped, hangs or takes too much memory is killed first. A worker that starts again goes on with the map on disk, and is
//! offered the newest keyframes once more. When the run is over the worker writes `map.ply` and `keyframes.tum`, evaluates, and
//! answers on its standard output: frames of four bytes of length (little endian) and JSON.

use super::keyframes::{KeyframeRing, Word};
use super::mapping::{self, Drawn, Kept, MapResult, Mapping};
use super::memory;
use super::status::{print_err, Gauges};
use super::threads;
use crate::config::{Board, ThreadRule};
use crate::map::Place;
use crate::mem::unsealed;
use crate::output::panel::Picture;
use crate::output::OutputDir;
use crate::publish::cloud::Cloud;
use crate::publish::event::{EventId, Notice};
use serde::{Deserialize, Serialize};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use stipple_drivers::{host, Calibration, Fault, FaultKind};

/// The first start may compile every kernel.
const BOOT_MAX: Duration = Duration::from_secs(120);
/// A process that gives no sign of life for so long hangs, and so does one whose slice of work takes longer than the second:
/// an anchor's depth on two cores without a GPU takes ten seconds.
const SILENCE_MAX: Duration = Duration::from_secs(5);
const SLICE_MAX: Duration = Duration::from_secs(30);
/// A killed process is waited for so long.
const DEATH_MAX: Duration = Duration::from_millis(500);
/// A worker that lives longer starts again at once; others wait for twice as long each time, up to `PAUSE_MAX`.
const LIFE_MIN: Duration = Duration::from_secs(30);
const PAUSE_MAX: Duration = Duration::from_secs(32);
/// Evaluation after the end of a run; what is told by then counts.
const CONCLUSION_MAX: Duration = Duration::from_secs(60);
/// What a driver may take beside the board's memory table, bytes: Mesa's compiler alone has 150 MiB.
const DRIVER_BYTES: u64 = 512 << 20;
/// Period of the signs of life, and of looks at the worker's memory.
const BEAT: Duration = Duration::from_millis(100);
/// Bytes of the longest answer: a picture.
const ANSWER_MAX: u32 = 1 << 28;

/// Everything a worker has to know.
#[derive(Serialize, Deserialize)]
struct Setup {
    board: Board,
    calibration: Calibration,
    out: PathBuf,
    /// Descriptors of the ring of keyframes and of the points.
    ring: i32,
    cloud: Option<i32>,
    /// The recording or rig, for errors, and whether samples are recorded: on the first start the whole run must fit.
    first: Option<(String, bool)>,
    /// Panics and hangs of its threads.
    rules: Vec<ThreadRule>,
    /// Time of the run so far, s.
    run_s: f64,
    parent: u32,
    /// None where the map is not kept on disk.
    kept: Option<Kept>,
}

#[derive(Serialize, Deserialize)]
enum Answer {
    /// It cannot start.
    Refused(Fault),
    /// It takes keyframes; what it lacks.
    Ready(Option<Fault>),
    Result(Box<MapResult>),
    /// Its pixels follow, as a frame of their own.
    Picture {
        name: String,
        caption: String,
        width: usize,
        height: usize,
    },
}

/// What a worker has answered so far.
#[derive(Default)]
struct Told {
    refused: Option<Fault>,
    ready: Option<Option<Fault>>,
    result: Option<MapResult>,
    drawn: Vec<Drawn>,
}

struct Running {
    child: Child,
    told: Arc<Mutex<Told>>,
    reader: JoinHandle<()>,
    started: Instant,
    /// Values of the words for beats and slices, and when they last changed.
    beat: (u64, Instant),
    slice: (u64, Instant),
    looked: Instant,
}

/// The mapping of a run: a thread of the same process, or a worker.
pub enum MapSide {
    Here(Box<Mapping>),
    Apart(Box<Worker>),
}

impl MapSide {
    /// Where keyframes go.
    pub fn ring(&self) -> &Arc<KeyframeRing> {
        match self {
            MapSide::Here(mapping) => &mapping.ring,
            MapSide::Apart(worker) => &worker.ring,
        }
    }

    /// Ends mapping: writes `map.ply`, and answers what it came to.
    pub fn conclude(self, out: &OutputDir) -> MapResult {
        match self {
            MapSide::Here(mut mapping) => {
                MapResult { heap_after_seal: 0, rss_peak_bytes: 0, ..mapping.conclude(out, &mut |_| ()) }
            }
            MapSide::Apart(worker) => worker.conclude(),
        }
    }
}

/// The worker of a run, as the process that flies sees it.
pub struct Worker {
    pub ring: Arc<KeyframeRing>,
    board: Board,
    calibration: Calibration,
    out: PathBuf,
    kept: Option<Kept>,
    begun: Instant,
    running: Option<Running>,
    pause: Duration,
    next_start: Instant,
    pub restarts: u64,
    /// What the worker lacks, and does without.
    pub warning: Option<String>,
    bytes_max: u64,
}

impl Worker {
    /// A worker that does not run yet, and may be started at once.
    fn new(ring: KeyframeRing, calibration: Calibration, board: Board, at: (PathBuf, Option<Kept>)) -> Worker {
        let ((out, kept), now) = (at, Instant::now());
        Worker {
            ring: Arc::new(ring),
            bytes_max: (board.memory_max_mib << 20) + DRIVER_BYTES,
            board,
            calibration,
            out,
            kept,
            begun: now,
            running: None,
            pause: Duration::ZERO,
            next_start: now,
            restarts: 0,
            warning: None,
        }
    }

    /// Starts the worker and waits until it is ready. Fails where it says why it cannot be.
    /// `place` names the rig; `records` where the run is recorded, too.
    pub fn start(
        place: &str,
        calibration: &Calibration,
        board: &Board,
        out: &OutputDir,
        records: bool,
        kept: Option<Kept>,
    ) -> Result<Worker, Fault> {
        let ring = KeyframeRing::new(calibration, board)?.with_cloud(Cloud::create())?;
        let mut worker = Worker::new(ring, calibration.clone(), board.clone(), (out.path().to_path_buf(), kept));
        let first = Some((place.to_string(), records));
        worker.spawn(first).map_err(|e| refused(format!("the mapper's process does not start: {e}")))?;
        let (gauges, told) = (Gauges::default(), worker.running.as_ref().map(|r| r.told.clone()));
        let told = told.unwrap_or_default();
        while !host::stop_asked_for().load(Relaxed) {
            if let Some(missing) = lock(&told).ready.take() {
                worker.warning = missing.map(|fault| fault.to_string());
                worker.warning.iter().for_each(|why| print_err(format_args!("stipple: warning: {why}")));
                break;
            }
            // All that it said was read when it was found to have ended.
            if let Some((_, why)) = worker.watch(&gauges) {
                return Err(lock(&told).refused.take().unwrap_or_else(|| refused(why)));
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        worker.begun = Instant::now();
        Ok(worker)
    }

    fn spawn(&mut self, first: Option<(String, bool)>) -> io::Result<()> {
        let setup = Setup {
            board: self.board.clone(),
            calibration: self.calibration.clone(),
            out: self.out.clone(),
            ring: self.ring.number(),
            cloud: self.ring.cloud.as_ref().map(|cloud| cloud.number()),
            rules: if first.is_some() { threads::rules() } else { vec![] },
            first,
            run_s: self.begun.elapsed().as_secs_f64(),
            parent: std::process::id(),
            kept: self.kept,
        };
        // What another mapper of this flight has kept is gone on with.
        self.kept.iter_mut().for_each(|kept| kept.fresh = false);
        self.ring.word(Word::Ready).store(0, Release);
        self.ring.word(Word::Stop).store(0, Release);
        let mut command = Command::new("/proc/self/exe");
        command.arg0("stipple").arg("map-worker").stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn()?;
        let (Some(mut tell), Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(io::Error::other("it has no pipes"));
        };
        let _ = tell.write_all(toml::to_string(&setup).map_err(io::Error::other)?.as_bytes()); // `judge` sees an early end
        drop(tell);
        let told = Arc::new(Mutex::new(Told::default()));
        let (into, now) = (told.clone(), Instant::now());
        let reader = super::start("map-answers", move || read_answers(answers, &into));
        let (beat, slice) = ((0, now), (0, now));
        self.running = Some(Running { child, told, reader, started: now, beat, slice, looked: now });
        Ok(())
    }

    /// Looks after the worker; answers what went wrong, once. Never waits.
    pub fn watch(&mut self, gauges: &Gauges) -> Option<Notice> {
        let (now, ring) = (Instant::now(), self.ring.clone());
        let Some(running) = &mut self.running else {
            if now >= self.next_start {
                ring.offer_again();
                if let Err(e) = self.spawn(None) {
                    self.postpone(now, Duration::ZERO);
                    return Some((EventId::MapperLost, format!("the mapper does not start again: {e}")));
                }
                self.restarts += 1;
            }
            return None;
        };
        let ready = ring.word(Word::Ready).load(Acquire) != 0;
        let Some(why) = running.judge(&ring, ready, self.bytes_max, now) else {
            if ready {
                let again = ring.word(Word::Absent).swap(0, Release) != 0;
                for (gauge, word) in [
                    (&gauges.anchors, Word::Anchors),
                    (&gauges.splats, Word::Splats),
                    (&gauges.iterations, Word::Iterations),
                    (&gauges.psnr_cdb, Word::PsnrCdb),
                ] {
                    gauge.store(ring.word(word).load(Relaxed), Relaxed);
                }
                return again.then(|| (EventId::MapperBack, "the mapper maps again".into()));
            }
            return None;
        };
        let life = now - running.started;
        ring.word(Word::Absent).store(1, Release);
        let told = self.running.take().map(Running::end); // before the first is ready its fault is `start`'s to tell
        let said =
            told.and_then(|told| lock(&told).refused.clone()).map_or(String::new(), |fault| format!(" ({fault})"));
        self.postpone(now, life);
        let with = if self.kept.is_some() { "with what is on disk" } else { "with an empty map" };
        let when = match self.next_start.saturating_duration_since(now).as_secs() {
            0 => "now".into(),
            s => format!("in {s} s"),
        };
        Some((EventId::MapperLost, format!("the mapper {why}{said}; it starts again {when}, {with}")))
    }

    fn postpone(&mut self, now: Instant, life: Duration) {
        if life >= LIFE_MIN {
            self.pause = Duration::ZERO;
        }
        self.next_start = now + self.pause;
        self.pause = (2 * self.pause).clamp(Duration::from_secs(1), PAUSE_MAX);
    }

    /// Lets the worker evaluate, for as long as it may take, and answers what it told. Where there is none, as it pauses
    /// after it died, one is started for the keyframes that wait.
    pub fn conclude(mut self) -> MapResult {
        let late = self.running.is_none();
        if late {
            self.ring.offer_again();
            if let Err(e) = self.spawn(None) {
                return incomplete(&format!("there was no mapper when the run ended, and none starts: {e}"));
            }
        }
        let mut result = self.evaluate(late);
        if late {
            result.counters.push(("map_restarts".into(), 1));
            result.failure = result.failure.map(|why| format!("{why}, though it was started again for the end"));
        }
        result
    }

    /// Asks the worker for what it came to; where it is `late`, after it took what waits.
    fn evaluate(&mut self, late: bool) -> MapResult {
        let Some(mut running) = self.running.take() else { return incomplete("there was no mapper") };
        let (asked, mut cut) = (Instant::now(), None);
        while matches!(running.child.try_wait(), Ok(None)) && cut.is_none() {
            let waits = self.ring.word(Word::Ready).load(Acquire) == 0 || self.ring.offered() > 0;
            let stop = !late || !waits || asked.elapsed() >= CONCLUSION_MAX / 2;
            self.ring.word(Word::Stop).store(stop.into(), Release);
            let over = asked.elapsed() >= CONCLUSION_MAX;
            let stopped = host::stopped_and_resident(running.child.id()).is_some_and(|(stopped, _)| stopped);
            if over || stopped {
                cut = Some(if over { "evaluation took too long" } else { "the mapper was stopped (SIGSTOP)" });
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let told = running.end();
        let mut told = lock(&told);
        let Some(mut result) = told.result.take() else {
            return incomplete(cut.unwrap_or("the mapper died at the end"));
        };
        result.failure = result.failure.or(cut.map(Into::into));
        result.drawn = std::mem::take(&mut told.drawn);
        result
    }
}

fn incomplete(why: &str) -> MapResult {
    MapResult { failure: Some(why.into()), ..MapResult::default() }
}

impl Running {
    /// Why the worker cannot go on, if so.
    fn judge(&mut self, ring: &KeyframeRing, ready: bool, bytes_max: u64, now: Instant) -> Option<String> {
        match self.child.try_wait() {
            Ok(Some(status)) => return Some(ended(status)),
            Ok(None) => {}
            Err(e) => return Some(format!("cannot be watched: {e}")),
        }
        for (seen, word) in [(&mut self.beat, Word::Beat), (&mut self.slice, Word::Progress)] {
            let value = ring.word(word).load(Relaxed);
            if value != seen.0 {
                *seen = (value, now);
            }
        }
        if !ready {
            (self.beat.1, self.slice.1) = (now, now);
            if now - self.started > BOOT_MAX {
                return Some(format!("was not ready after {} s", BOOT_MAX.as_secs()));
            }
        }
        if now - self.beat.1 > SILENCE_MAX {
            return Some(format!("gave no sign of life for {} s", SILENCE_MAX.as_secs()));
        }
        if now - self.slice.1 > SLICE_MAX {
            return Some(format!("hangs: a slice of its work takes over {} s", SLICE_MAX.as_secs()));
        }
        if now - self.looked < BEAT {
            return None;
        }
        self.looked = now;
        match host::stopped_and_resident(self.child.id()) {
            Some((true, _)) => Some("was stopped (SIGSTOP)".into()),
            Some((_, bytes)) if bytes > bytes_max => {
                Some(format!("takes {} MiB of memory, {} are allowed", bytes >> 20, bytes_max >> 20))
            }
            _ => None,
        }
    }

    /// Kills it if it still runs, and answers what it told. One that is stuck in a driver cannot end yet; it is not waited for,
    /// as it runs no more of its own code.
    fn end(mut self) -> Arc<Mutex<Told>> {
        let _ = self.child.kill();
        let limit = Instant::now() + DEATH_MAX;
        while matches!(self.child.try_wait(), Ok(None)) && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(1));
        }
        if matches!(self.child.try_wait(), Ok(Some(_))) {
            // Its answers end with it.
            let _ = self.reader.join();
        }
        self.told
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        if let Some(running) = self.running.take() {
            running.end();
        }
    }
}

fn ended(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(signal), _) => format!("was ended by signal {signal}"),
        (None, Some(0)) => "ended".into(),
        (None, code) => format!("ended with exit code {}", code.unwrap_or(-1)),
    }
}

fn refused(what: String) -> Fault {
    Fault::new(FaultKind::Unavailable, "map-worker", what, "see `stipple doctor`, or set map.enabled=false")
}

fn lock(told: &Mutex<Told>) -> std::sync::MutexGuard<'_, Told> {
    told.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Reads what a worker answers until it ends.
fn read_answers(mut from: impl Read + AsRawFd, told: &Mutex<Told>) {
    let mut next = || {
        while !host::is_readable(from.as_raw_fd(), BEAT.as_millis() as i32) {
            threads::alive();
        }
        let mut length = [0; 4];
        from.read_exact(&mut length).ok()?;
        let length = u32::from_le_bytes(length);
        let mut bytes = vec![0; if length <= ANSWER_MAX { length as usize } else { return None }];
        from.read_exact(&mut bytes).ok()?;
        Some(bytes)
    };
    while let Some(answer) = next().and_then(|bytes| serde_json::from_slice(&bytes).ok()) {
        match answer {
            Answer::Refused(fault) => lock(told).refused = Some(fault),
            Answer::Ready(missing) => lock(told).ready = Some(missing),
            Answer::Result(result) => lock(told).result = Some(*result),
            Answer::Picture { name, caption, width, height } => {
                let Some(bytes) = next().filter(|b| b.len() == 3 * width * height) else { return };
                let pixels = bytes.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
                lock(told).drawn.push(Drawn { name, caption, picture: Picture { width, height, pixels } });
            }
        }
    }
}

fn tell(to: &mut impl Write, answer: &Answer) -> io::Result<()> {
    send(to, &serde_json::to_vec(answer)?)
}

fn send(to: &mut impl Write, frame: &[u8]) -> io::Result<()> {
    to.write_all(&(frame.len() as u32).to_le_bytes())?;
    to.write_all(frame)?;
    to.flush()
}

/// The worker's own work: reads what it has to know from `input`, maps until it is asked to stop, and tells `output`.
pub fn serve(mut input: impl Read, mut output: impl Write) -> Result<(), Fault> {
    let broken = |e: io::Error| refused(format!("the process that flies cannot be reached: {e}"));
    let mut text = String::new();
    input.read_to_string(&mut text).map_err(broken)?;
    let mut setup: Setup = toml::from_str(&text).map_err(|e| {
        let what = format!("standard input says nothing that a mapper understands: {e}");
        Fault::new(FaultKind::Usage, "map-worker", what, "it is started by `stipple run`, not by hand")
    })?;
    host::live_with_parent(setup.parent).map_err(broken)?;
    // Where memory ends, the map goes first.
    let _ = std::fs::write("/proc/self/oom_score_adj", "500");
    threads::disturb(&setup.rules)?;
    let start = Instant::now().checked_sub(Duration::from_secs_f64(setup.run_s.max(0.0))).unwrap_or_else(Instant::now);
    let missing = memory::replace_missing(&mut setup.board);
    let Setup { board, calibration, first, .. } = &setup;
    let fits = first.as_ref().map(|(place, records)| memory::check_fits(place, calibration, board, *records));
    let opened = fits.transpose().and_then(|_| KeyframeRing::attach(setup.ring, calibration, board)).and_then(|ring| {
        let ring = match setup.cloud {
            Some(cloud) => ring.with_cloud(Cloud::attach(cloud))?,
            None => ring,
        };
        let ring = Arc::new(ring);
        let folder = setup.out.join(super::MAP_STORE);
        let place = setup.kept.map(|Kept { fresh, flight }| Place {
            folder: &folder,
            fresh,
            flight: Some(flight),
            at_once: false,
        });
        Ok((ring.clone(), Mapping::open(calibration, board, ring, place)?))
    });
    let (ring, mapping) = match opened {
        Ok(opened) => opened,
        Err(fault) => {
            // The process that flies says it.
            return tell(&mut output, &Answer::Refused(fault)).map_err(broken);
        }
    };
    let out = OutputDir::existing(&setup.out);
    let gauges = Arc::new(Gauges::default());
    let (beating, seen) = (ring.clone(), gauges.clone());
    super::start("beat", move || loop {
        threads::alive();
        beating.word(Word::Beat).fetch_add(1, Relaxed);
        for (gauge, word) in [
            (&seen.anchors, Word::Anchors),
            (&seen.splats, Word::Splats),
            (&seen.iterations, Word::Iterations),
            (&seen.psnr_cdb, Word::PsnrCdb),
            (&seen.slices, Word::Progress),
        ] {
            beating.word(word).store(gauge.load(Relaxed), Relaxed);
        }
        std::thread::sleep(BEAT);
    });
    let missing = missing.or(mapping.mapper.unkept.as_ref().map(super::unkept));
    tell(&mut output, &Answer::Ready(missing)).map_err(broken)?;
    ring.word(Word::Ready).store(1, Release);
    let stop = || ring.word(Word::Stop).load(Acquire) != 0;
    let watched = threads::watch("mapping");
    let mut mapping = mapping::map(mapping, &gauges, start, || true, |_| stop());
    drop(watched);
    if !stop() {
        // The device failed: another process may have more luck with it.
        let fault = refused(mapping.failure.unwrap_or_default());
        return tell(&mut output, &Answer::Refused(fault)).map_err(broken);
    }
    let mut told = Ok(());
    let mut say = |result: &MapResult| told = tell(&mut output, &Answer::Result(Box::new(result.clone())));
    let result = unsealed(|| mapping.conclude(&out, &mut say));
    told.map_err(broken)?;
    for Drawn { name, caption, picture: Picture { width, height, pixels } } in result.drawn {
        tell(&mut output, &Answer::Picture { name, caption, width, height }).map_err(broken)?;
        send(&mut output, pixels.as_flattened()).map_err(broken)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::run::keyframes::tests::ring;

    const MANY: u64 = 1 << 40;

    /// A process that is no worker, as one that was started `ago`.
    fn running(ago: Duration) -> Running {
        let (told, started) = (Arc::default(), Instant::now().checked_sub(ago).unwrap());
        let child = Command::new("sleep").arg("60").spawn().unwrap();
        let (beat, slice) = ((0, started), (0, started));
        Running { child, told, reader: std::thread::spawn(|| ()), started, beat, slice, looked: started }
    }

    #[test]
    fn a_worker_is_judged_by_its_start_its_beats_its_slices_and_its_memory() {
        let (ring, now) = (ring(), Instant::now());
        let after = |s| now + Duration::from_secs(s);
        let mut r = running(Duration::ZERO);
        assert_eq!(r.judge(&ring, false, MANY, after(110)), None);
        assert_eq!(r.judge(&ring, false, MANY, after(130)).unwrap(), "was not ready after 120 s");
        r.end();
        let mut r = running(Duration::ZERO);
        // The thread that beats may not have run yet when it is ready.
        assert_eq!(r.judge(&ring, false, MANY, after(60)), None);
        assert_eq!(r.judge(&ring, true, MANY, after(61)), None);
        assert_eq!(r.judge(&ring, true, MANY, after(66)).unwrap(), "gave no sign of life for 5 s");
        for s in 66..90 {
            ring.word(Word::Beat).fetch_add(1, Relaxed);
            assert_eq!(r.judge(&ring, true, MANY, after(s)), None);
        }
        ring.word(Word::Beat).fetch_add(1, Relaxed);
        assert_eq!(r.judge(&ring, true, MANY, after(92)).unwrap(), "hangs: a slice of its work takes over 30 s");
        ring.word(Word::Progress).fetch_add(1, Relaxed);
        while host::stopped_and_resident(r.child.id()).is_some_and(|(_, bytes)| bytes <= 1 << 10) {
            std::thread::yield_now();
        }
        let why = r.judge(&ring, true, 1 << 10, after(93)).unwrap();
        assert!(why.starts_with("takes ") && why.ends_with(" 0 are allowed"), "{why}");
        r.end();
    }

    #[test]
    fn a_worker_that_is_stopped_while_it_starts_is_noticed() {
        let (ring, mut r) = (ring(), running(Duration::from_secs(1)));
        let told = Command::new("sh").args(["-c", &format!("kill -STOP {}", r.child.id())]).status().unwrap();
        assert!(told.success());
        std::thread::sleep(Duration::from_millis(100));
        assert_eq!(r.judge(&ring, false, MANY, Instant::now()).unwrap(), "was stopped (SIGSTOP)");
        r.end();
    }

    #[test]
    fn pauses_grow_only_where_a_worker_lives_shortly() {
        let board = Board::parse("lavapipe.toml", include_str!("../../board-configs/lavapipe.toml"), &[]).unwrap();
        let calibration = Calibration { cameras: vec![], imu: stipple_drivers::ImuCalibration::CONSUMER };
        let mut worker = Worker::new(ring(), calibration, board, (PathBuf::new(), None));
        let now = worker.next_start;
        let mut pause = |life_s| {
            worker.postpone(now, Duration::from_secs(life_s));
            (worker.next_start - now).as_secs()
        };
        assert_eq!([1, 1, 1, 1, 29, 31, 1].map(&mut pause), [0, 1, 2, 4, 8, 0, 1]);
        assert_eq!([1; 6].map(&mut pause).last(), Some(&32));
    }
}
