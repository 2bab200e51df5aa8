//! `stipple-bridge`: odometry and map of a flying Stipple, from its status socket, as topics of ROS 2.

mod cloud;
mod convert;
mod dds;
mod diagnostics;
mod messages;
mod socket;
#[cfg(test)]
mod tests;

use clap::Parser;
use cloud::{Clouds, Outcome};
use convert::{time, transform, Frames, Stamps};
use dds::{Participant, Writer};
use diagnostics::{wall_ns, Monitor};
use messages::{DiagnosticArray, Header, Odometry, TfMessage};
use signal_hook::consts::{SIGINT, SIGTERM};
use socket::{Connection, Heard, Line, MapFromOdom, State};
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{sync_channel, Receiver};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Exit codes of `sysexits.h`.
const USAGE: u8 = 64;
const UNAVAILABLE: u8 = 69;
/// Pause before a daemon that is not there is looked for again.
const PAUSE: Duration = Duration::from_millis(500);
/// A daemon that says nothing for so long, though it tells its status each second, is looked for anew.
const SILENCE_MAX: Duration = Duration::from_secs(5);
/// How often diagnostics are published.
const DIAGNOSTICS: Duration = Duration::from_secs(1);

/// Publish the odometry and the map of Stipple in ROS 2, without an installation of ROS
#[derive(Parser)]
#[command(version)]
struct Args {
    /// Status socket of the daemon
    #[arg(long, value_name = "PATH", default_value = "/run/stipple/status")]
    socket: PathBuf,
    /// Domain of DDS, 0 to 232
    #[arg(long, value_name = "ID", env = "ROS_DOMAIN_ID", default_value = "0", value_parser = domain)]
    domain: u16,
    /// Use the loopback interface alone, as ROS_LOCALHOST_ONLY=1 asks for
    #[arg(long)]
    localhost: bool,
    /// Namespace of the topics `odometry` and `map`
    #[arg(long, value_name = "NAME", default_value = "/stipple", value_parser = namespace)]
    namespace: String,
    /// Names of the frames
    #[arg(long, num_args = 3, value_names = ["MAP", "ODOM", "BASE"], default_values = ["map", "odom", "base_link"])]
    frames: Vec<String>,
    /// Roll, pitch and yaw of the inertial unit in the vehicle, degrees: the numbers of `mavlink.mount_rpy_deg`, about the
    /// vehicle's axes forward, right and down. A unit whose x is forward and z up has 180,0,0
    #[arg(long, value_name = "R,P,Y", default_value = "0,0,0", allow_hyphen_values = true, value_parser = angles)]
    mount_rpy_deg: [f64; 3],
    /// Most states a second; 0: each that there is
    #[arg(long, value_name = "HZ", default_value = "50", value_parser = clap::value_parser!(u32).range(0..=1000))]
    rate: u32,
    /// Seconds from one cloud of the map to the next; 0: none
    #[arg(long, value_name = "S", default_value = "2", value_parser = period)]
    cloud_period: Duration,
}

fn domain(text: &str) -> Result<u16, String> {
    // An empty variable is one that is not set.
    let id = if text.is_empty() { Ok(0) } else { text.parse::<u16>() };
    id.ok().filter(|id| *id <= 232).ok_or_else(|| "must be from 0 to 232".into())
}

/// A namespace without the slashes around it.
fn namespace(text: &str) -> Result<String, String> {
    let name = text.trim_matches('/');
    let is_word = |word: &str| {
        word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') && !word.starts_with(|c: char| c.is_ascii_digit())
    };
    let is_name = name.is_empty() || name.split('/').all(|word| !word.is_empty() && is_word(word));
    is_name.then(|| name.into()).ok_or_else(|| "must be words of letters, digits and _, with / between them".into())
}

fn angles(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    let angles = <[f64; 3]>::try_from(numbers).ok().filter(|_| text.split(',').count() == 3);
    angles.filter(|a| a.iter().all(|a| a.abs() <= 360.0)).ok_or_else(|| "must be three angles of -360 to 360".into())
}

fn period(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().filter(|s| *s == 0.0 || (0.1..=3600.0).contains(s));
    seconds.map(Duration::from_secs_f64).ok_or_else(|| "must be 0, or from 0.1 to 3600".into())
}

/// Prints a line on stderr, which nobody may read.
fn say(text: &str) {
    let _ = writeln!(std::io::stderr(), "stipple-bridge: {text}");
}

/// Waits so long, or until `stop`.
fn sleep(time: Duration, stop: &AtomicBool) {
    let end = Instant::now() + time;
    while !stop.load(Ordering::Relaxed) && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(50).min(end.saturating_duration_since(Instant::now())));
    }
}

struct Bridge {
    args: Args,
    frames: Frames,
    stamps: Stamps,
    monitor: Monitor,
    map_from_odom: Option<MapFromOdom>,
    odometry: Writer<Odometry>,
    tf: Writer<TfMessage>,
    diagnostics: Writer<DiagnosticArray>,
    outcomes: Receiver<Outcome>,
    next_report: Instant,
    stop: Arc<AtomicBool>,
}

impl Bridge {
    /// Connects, again and again, and publishes what comes, until it is to stop.
    fn run(&mut self) {
        let request = format!(r#"{{"subscribe":["state","event","status"],"hz":{}}}"#, self.args.rate);
        while !self.stop.load(Ordering::Relaxed) {
            let path = self.args.socket.display().to_string();
            let ended = match Connection::open(&self.args.socket, &request) {
                Ok(connection) => self.serve(connection),
                Err(e) => format!("{path}: {e}; start the daemon, or name its socket with --socket"),
            };
            if self.monitor.link(Some(ended.clone())) && !self.stop.load(Ordering::Relaxed) {
                say(&format!("{ended}; trying again each {} ms", PAUSE.as_millis()));
            }
            let again = Instant::now() + PAUSE;
            while !self.stop.load(Ordering::Relaxed) && Instant::now() < again {
                self.report();
                sleep(PAUSE / 10, &self.stop);
            }
        }
    }

    /// Publishes what comes over a connection; why it ended.
    fn serve(&mut self, mut connection: Connection) -> String {
        let path = self.args.socket.display().to_string();
        let mut heard = Instant::now();
        while !self.stop.load(Ordering::Relaxed) {
            match connection.next() {
                Ok(Heard::Line(line)) => {
                    heard = Instant::now();
                    match serde_json::from_slice(line) {
                        Ok(Line::Error { error }) => return format!("{path}: the daemon refuses: {error}"),
                        Ok(line) => {
                            // Not before: one that takes connections and says nothing is told once.
                            if self.monitor.link(None) {
                                say(&format!("connected to {path}"));
                            }
                            self.take(line);
                        }
                        Err(e) => self
                            .trouble("lines_malformed", &format!("a line of the daemon is no message: {}", short(&e))),
                    }
                }
                Ok(Heard::TooLong) => self.trouble("lines_too_long", "a line of the daemon is too long"),
                Ok(Heard::Nothing) if heard.elapsed() > SILENCE_MAX => {
                    return format!("{path}: nothing came for {} s; is the daemon stuck?", SILENCE_MAX.as_secs());
                }
                Ok(Heard::Nothing) => {}
                Err(e) => return format!("{path}: {e}"),
            }
            self.report();
        }
        "the bridge ends".into()
    }

    fn trouble(&mut self, name: &'static str, what: &str) {
        if self.monitor.trouble(name, what.into()) {
            say(&format!("{what}; it is left out. Are daemon and bridge of one version?"));
        }
    }

    fn take(&mut self, line: Line) {
        let said = match line {
            Line::State(state) => self.publish(&state),
            Line::Status(status) => {
                self.map_from_odom = status.map_from_odom;
                self.monitor.status(status)
            }
            Line::Event(event) => {
                self.monitor.event(event);
                None
            }
            Line::Points(_) | Line::Error { .. } | Line::Other => None,
        };
        said.into_iter().for_each(|what| say(&what));
    }

    /// Publishes a state, and answers what to say of it.
    fn publish(&mut self, state: &State) -> Option<String> {
        // The stamp last: a state that is no message must not be the one that later ones are compared with.
        let Some(mut odometry) = self.frames.odometry(state, time(0)?) else {
            self.trouble("states_not_finite", "a state of the daemon is not finite");
            return None;
        };
        let Some(stamp) = self.stamps.stamp(state.t_ns, state.wall_ns) else {
            self.trouble("states_not_later", "a state of the daemon is not later than the one before");
            return None;
        };
        odometry.header.stamp = stamp;
        let map = self.frames.map_from_odom(&odometry, self.map_from_odom);
        let transforms = vec![transform(&odometry), map];
        let is_sent = [self.odometry.write(odometry), self.tf.write(TfMessage { transforms })];
        self.monitor.count(if is_sent == [true; 2] { "states" } else { "not_sent" });
        self.monitor.state(state, self.stamps.ahead_ns)
    }

    /// Publishes diagnostics where it is time.
    fn report(&mut self) {
        self.outcomes.try_iter().for_each(|outcome| self.monitor.cloud(outcome));
        if Instant::now() >= self.next_report {
            self.next_report = Instant::now() + DIAGNOSTICS;
            let header = Header { stamp: time(wall_ns()).unwrap_or_default(), frame_id: String::new() };
            self.diagnostics.write(DiagnosticArray { header, status: vec![self.monitor.report()] });
        }
    }
}

/// What is wrong with a line, without where: the same for each such line.
fn short(e: &serde_json::Error) -> &'static str {
    match e.classify() {
        serde_json::error::Category::Data => "members are missing or of another kind",
        _ => "it is no JSON",
    }
}

/// Opens everything and publishes until a signal. Fails where there is no DDS.
fn run(args: Args) -> Result<(), String> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        // A second signal ends what the first could not.
        signal_hook::flag::register_conditional_shutdown(signal, 1, stop.clone())
            .and_then(|_| signal_hook::flag::register(signal, stop.clone()))
            .map_err(|e| format!("cannot take signals: {e}"))?;
    }
    let is_local = args.localhost || std::env::var("ROS_LOCALHOST_ONLY").is_ok_and(|set| set == "1");
    let participant = Participant::join(args.domain, is_local)?;
    let topic = |name: &str| format!("{}/{name}", args.namespace).trim_start_matches('/').to_string();
    let (send, outcomes) = sync_channel(4);
    let clouds = Clouds {
        socket: args.socket.clone(),
        frame_id: args.frames[0].clone(),
        period: args.cloud_period,
        writer: participant.writer(&topic("map"), 1, true)?,
        outcomes: send,
    };
    let mut bridge = Bridge {
        frames: Frames::new(std::array::from_fn(|i| args.frames[i].as_str()), args.mount_rpy_deg),
        stamps: Stamps::default(),
        monitor: Monitor::new(topic("odometry")),
        map_from_odom: None,
        odometry: participant.writer(&topic("odometry"), 10, false)?,
        tf: participant.writer("tf", 100, false)?,
        diagnostics: participant.writer("diagnostics", 10, false)?,
        outcomes,
        next_report: Instant::now(),
        stop: stop.clone(),
        args,
    };
    std::thread::scope(|scope| {
        if !bridge.args.cloud_period.is_zero() {
            scope.spawn(|| clouds.run(&stop));
        }
        bridge.run();
    });
    say("stopped");
    Ok(())
}

fn main() -> ExitCode {
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(e) => {
            let _ = e.print();
            return ExitCode::from(if e.use_stderr() { USAGE } else { 0 });
        }
    };
    match run(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            say(&why);
            ExitCode::from(UNAVAILABLE)
        }
    }
}
