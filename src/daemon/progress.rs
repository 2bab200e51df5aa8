//! What is seen while a run goes on: a bar on a terminal, one line a second otherwise, and a light where one is wired.

use super::light::Light;
use indicatif::{ProgressBar, ProgressStyle};
use std::fmt;
use std::io::{self, IsTerminal, Write as _};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Written by the threads of a run, read by whoever shows it.
#[derive(Default)]
pub struct Gauges {
    pub frames: AtomicU64,
    /// Of these, with a pose; where nobody tracks, all.
    pub posed: AtomicU64,
    /// The map failed, or a sensor broke.
    pub broke: AtomicBool,
    pub keyframes: AtomicU64,
    pub anchors: AtomicU64,
    pub splats: AtomicU64,
    pub iterations: AtomicU64,
    /// Training PSNR of the last probe, 0.01 dB.
    pub psnr_cdb: AtomicU64,
    /// Time of the recording played so far, ms.
    pub played_ms: AtomicU64,
}

pub struct Progress {
    bar: Option<ProgressBar>,
    /// `None`: until it is stopped.
    total_ms: Option<u64>,
    /// `None`: never.
    next_line: Option<Instant>,
    light: Option<Light>,
}

const LINE_PERIOD: Duration = Duration::from_secs(1);

impl Progress {
    pub fn new(total_s: Option<f64>) -> Progress {
        let total_ms = total_s.map(|s| (s.max(0.0) * 1e3) as u64);
        let bar = io::stderr().is_terminal().then(|| {
            let bar = total_ms.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
            let drawn = if total_ms.is_some() { "{bar:30} {percent:>3}%" } else { "{spinner}" };
            let style = ProgressStyle::with_template(&format!("{drawn} {{elapsed}} {{msg}}"));
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar
        });
        Progress { bar, total_ms, next_line: Some(Instant::now() + LINE_PERIOD), light: None }
    }

    /// Shows nothing.
    #[cfg(feature = "instruments")]
    pub fn silent() -> Progress {
        Progress { bar: None, total_ms: None, next_line: None, light: None }
    }

    /// With the light of a board that has one.
    pub fn lit(mut self, light: Option<Light>) -> Progress {
        self.light = light;
        self
    }

    /// What ran ended as it was asked to.
    pub fn ended_well(&mut self) {
        self.light.iter_mut().for_each(Light::ended_well);
    }

    /// Cheap to call often: draws at most once a second without a terminal.
    pub fn show(&mut self, g: &Gauges) {
        if let Some(light) = &mut self.light {
            light.show(g.posed.load(Relaxed), g.broke.load(Relaxed), Instant::now());
        }
        let played = g.played_ms.load(Relaxed).min(self.total_ms.unwrap_or(u64::MAX));
        match &self.bar {
            Some(bar) => {
                bar.set_position(played);
                bar.set_message(line(g));
            }
            None if self.next_line.is_some_and(|due| Instant::now() >= due) => {
                self.next_line = self.next_line.map(|due| due + LINE_PERIOD);
                let of = self.total_ms.map_or(String::new(), |ms| format!(" of {:.1}", ms as f64 * 1e-3));
                tell(format_args!("{:.1}{of} s: {}", played as f64 * 1e-3, line(g)));
            }
            None => {}
        }
    }

    /// A line that stays.
    pub fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(format!("stipple: {text}")),
            None if self.next_line.is_some() => tell(format_args!("stipple: {text}")),
            None => {}
        }
    }

    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn line(g: &Gauges) -> String {
    let psnr = g.psnr_cdb.load(Relaxed);
    let psnr = if psnr == 0 { String::new() } else { format!(", {:.2} dB", psnr as f64 * 0.01) };
    format!(
        "{} frames, {} keyframes, {} anchors, {} Gaussians, {} iterations{psnr}",
        g.frames.load(Relaxed),
        g.keyframes.load(Relaxed),
        g.anchors.load(Relaxed),
        g.splats.load(Relaxed),
        g.iterations.load(Relaxed),
    )
}

/// A line of a run to standard error. That nobody reads it any more is no reason to end a flight.
pub fn tell(line: fmt::Arguments) {
    let _ = writeln!(io::stderr(), "{line}");
}

/// What a run came to, to standard output; likewise.
pub fn print(line: impl fmt::Display) {
    let _ = writeln!(io::stdout(), "{line}");
}
