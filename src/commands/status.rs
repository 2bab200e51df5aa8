//! `stipple status`: how a run goes, on one screen.

use crate::publish::status::message::{Message, StatusMessage};
use crate::run::status::print_out;
use std::fmt::Write as _;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::unix::fs::FileTypeExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;
use stipple_drivers::{Fault, FaultKind};

/// Where the service's socket is, and that of a run started by hand without --out.
const PLACES: [&str; 2] = ["/run/stipple", "out/run"];
/// A run answers within this, or hangs.
const PATIENCE: Duration = Duration::from_secs(3);
/// Longest answer, bytes.
const ANSWER_MAX: u64 = 1 << 20;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    pub place: Place,
    /// Print the answer as JSON
    #[arg(long, conflicts_with = "metrics")]
    json: bool,
    /// Print metrics as Prometheus reads them
    #[arg(long)]
    metrics: bool,
}

/// Where a run is.
#[derive(clap::Args)]
pub struct Place {
    /// Folder of the run's results, or its status socket [default: /run/stipple, then out/run]
    #[arg(value_name = "DIR")]
    dir: Option<PathBuf>,
}

pub fn status(args: &Args) -> Result<(), Fault> {
    let mut run = Connection::open(&args.place)?;
    if args.metrics {
        run.ask("GET /metrics HTTP/1.1")?;
        let mut answer = String::new();
        let read = run.from.take(ANSWER_MAX).read_to_string(&mut answer);
        read.map_err(|e| silent(&run.path, &e))?;
        print_out(answer.split_once("\r\n\r\n").map_or("", |(_, body)| body).trim_end());
        return Ok(());
    }
    run.ask(r#"{"get":"status"}"#)?;
    let line = run.line()?;
    match run.read(&line)? {
        Message::Status(_) if args.json => print_out(line.trim_end()),
        Message::Status(status) => print_out(screen(&status)),
        other => return Err(no_status(&run.path, &format!("it answers {other:?}"))),
    }
    Ok(())
}

/// A connection to the status socket of a run.
pub struct Connection {
    path: PathBuf,
    from: BufReader<UnixStream>,
}

impl Place {
    /// The run with results in `dir`, or one where the service's or a run's own would be.
    pub fn of(dir: Option<PathBuf>) -> Place {
        Place { dir }
    }
}

impl Connection {
    pub fn open(place: &Place) -> Result<Connection, Fault> {
        let path = match &place.dir {
            Some(dir) if dir.is_dir() => dir.join("status"),
            Some(socket) => socket.clone(),
            None => {
                let is_there = |dir: &&str| {
                    std::fs::metadata(Path::new(dir).join("status")).is_ok_and(|m| m.file_type().is_socket())
                };
                Path::new(PLACES.iter().find(|dir| is_there(dir)).unwrap_or(&PLACES[0])).join("status")
            }
        };
        let stream = UnixStream::connect(&path).and_then(|stream| {
            stream.set_read_timeout(Some(PATIENCE))?;
            stream.set_write_timeout(Some(PATIENCE))?;
            Ok(stream)
        });
        let stream = stream.map_err(|e| {
            let fix = "name the folder of a run's results; a run that was just started has no socket before its sensors are open";
            Fault::new(FaultKind::Unavailable, path.display().to_string(), format!("no run answers there: {e}"), fix)
        })?;
        Ok(Connection { path, from: BufReader::new(stream) })
    }

    pub fn ask(&mut self, request: &str) -> Result<(), Fault> {
        match self.from.get_mut().write_all(format!("{request}\n").as_bytes()) {
            // It was refused before it asked: the next line says why.
            Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(()),
            asked => asked.map_err(|e| silent(&self.path, &e)),
        }
    }

    /// The next line, whole.
    pub fn line(&mut self) -> Result<String, Fault> {
        let mut line = String::new();
        let read = self.from.by_ref().take(ANSWER_MAX).read_line(&mut line);
        match read {
            Ok(_) if line.ends_with('\n') => Ok(line),
            Ok(_) => Err(no_status(&self.path, "the run has ended")),
            Err(e) => Err(silent(&self.path, &e)),
        }
    }

    /// What a line says. Fails where the run refuses the request.
    pub fn read(&self, line: &str) -> Result<Message, Fault> {
        match serde_json::from_str(line) {
            Ok(Message::Error { error }) => Err(no_status(&self.path, &error)),
            Ok(message) => Ok(message),
            Err(e) => {
                Err(no_status(&self.path, &format!("it answers in another language, is it of another version? {e}")))
            }
        }
    }

    /// The next message.
    pub fn message(&mut self) -> Result<Message, Fault> {
        let line = self.line()?;
        self.read(&line)
    }
}

fn no_status(path: &Path, what: &str) -> Fault {
    Fault::new(FaultKind::Unavailable, path.display().to_string(), what, "")
}

fn silent(path: &Path, e: &std::io::Error) -> Fault {
    let fix = "see `systemctl status stipple`, and its journal";
    let what = format!("the run does not answer within {} s: {e}", PATIENCE.as_secs());
    Fault::new(FaultKind::Unavailable, path.display().to_string(), what, fix)
}

/// Lines for a screen.
pub fn screen(s: &StatusMessage) -> String {
    let mut text = String::new();
    let mut row = |name: &str, what: String| {
        // Writing to memory does not fail.
        let _ = writeln!(text, "{name:<10}{what}");
    };
    row("stipple", format!("{} on {}, {}, for {}", s.version, s.board, s.dataset, duration(s.uptime_s)));
    match &s.state {
        None => row("odometry", "no pose yet".into()),
        Some(state) => {
            let age_ms = (s.t_ns - state.t_ns) as f64 * 1e-6;
            let source = match state.source.as_ref() {
                "frame" => "",
                "carried" => ", carried by inertia",
                _ => ", lost: dead reckoning",
            };
            let health = if s.health.is_empty() { "healthy".into() } else { s.health.join(", ") };
            row("odometry", format!("quality {} %{source}; {health}", state.quality));
            row("", format!("epoch {}, the newest pose is of {age_ms:.0} ms ago", state.epoch));
            let [x, y, z] = state.position;
            let sigma = state.pose_covariance.as_ref().filter(|c| c.len() == 36);
            let sigma = sigma.map(|c| format!(" +- {:.3}", (c[0] + c[7] + c[14]).sqrt())).unwrap_or_default();
            let speed = state.velocity_body.iter().map(|v| v * v).sum::<f64>().sqrt();
            row("position", format!("{x:.2}, {y:.2}, {z:.2} m{sigma}, at {speed:.2} m/s"));
        }
    }
    let (map, summary) = (&s.summary.map, &s.summary);
    row("frames", format!("{}, {} with a pose", summary.frames, summary.posed));
    let psnr = map.psnr_db.map(|db| format!(", {db:.1} dB")).unwrap_or_default();
    row(
        "map",
        format!(
            "{} keyframes, {} anchors, {} Gaussians, {} iterations{psnr}",
            map.keyframes, map.anchors, map.splats, map.iterations
        ),
    );
    if let Some(m) = &summary.map_from_odom {
        let ([x, y, z], yaw) = (m.position, m.yaw.to_degrees());
        let age_s = (s.t_ns - m.t_ns) as f64 * 1e-9;
        row(
            "loops",
            format!(
                "{}, the last {age_s:.0} s ago: odom is at {x:.2}, {y:.2}, {z:.2} m, {yaw:.1} degrees in the map",
                m.count
            ),
        );
    }
    let why = summary.governor.reason.as_ref().map(|why| format!(": {why}")).unwrap_or_default();
    row("mapper", format!("{:.0} % of its time{why}", 100.0 * summary.governor.share));
    if let Some(power) = summary.power {
        row("power", format!("{:.1} W, {:.0} J since the start", power.watts, power.joules));
    }
    let counted: Vec<String> =
        summary.counters.iter().filter(|(_, n)| **n > 0).map(|(name, n)| format!("{name} {n}")).collect();
    row("counters", if counted.is_empty() { "all zero".into() } else { counted.join(", ") });
    text.trim_end().to_string()
}

fn duration(s: f64) -> String {
    let s = s.max(0.0) as u64;
    match (s / 3600, s / 60 % 60, s % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s} s"),
        (h, m, _) => format!("{h} h {m} min"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn screen_says_what_is_wrong_in_words() {
        let text = r#"{"version":"0.1.0","board":"b","dataset":"d","t_ns":1050000000,"wall_ns":0,"uptime_s":3723.4,"health":["no_tracks"],
            "state":{"t_ns":1000000000,"wall_ns":0,"epoch":2,"quality":7,"source":"dead_reckoned","health":["no_tracks"],
            "position":[1,2,3],"orientation":[0,0,0,1],"velocity_body":[3,0,4],"rate_body":[0,0,0],"pose_covariance":null,
            "velocity_covariance":null},"frames":9,"posed":8,"map":{"keyframes":1,"anchors":1,"splats":5,"iterations":6,"psnr_db":null},
            "map_from_odom":{"t_ns":-1950000000,"count":4,"epoch":2,"position":[0.5,-0.25,0],"yaw":0.1,"covariance":[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0]]},
            "governor":{"share":0.49,"reason":"cpu is at 90 degrees"},"power":{"watts":7.25,"joules":26995.5},"counters":{"imu_gap":3,"camera_lost":0}}"#;
        let shown = screen(&serde_json::from_str(text).unwrap());
        for part in [
            "for 1 h 2 min",
            "quality 7 %, lost: dead reckoning; no_tracks",
            "epoch 2, the newest pose is of 50 ms ago",
            "1.00, 2.00, 3.00 m, at 5.00 m/s",
            "loops     4, the last 3 s ago: odom is at 0.50, -0.25, 0.00 m, 5.7 degrees in the map",
            "49 % of its time: cpu is at 90 degrees",
            "power     7.2 W, 26996 J since the start",
            "counters  imu_gap 3",
        ] {
            assert!(shown.contains(part), "{part}\n{shown}");
        }
    }
}
