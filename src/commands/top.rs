//! `stipple top`: how a run goes, live.

use super::status::{screen, Connection, Place};
use crate::publish::status::message::{EventMessage, Message, StateMessage, StatusMessage};
use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Style};
use ratatui::text::Line;
use ratatui::widgets::{Block, Paragraph, Sparkline, Wrap};
use ratatui::Frame;
use std::collections::VecDeque;
use std::io::IsTerminal;
use std::time::Duration;
use stipple_drivers::{Fault, FaultKind};

/// States a second, and how many of them are drawn.
const HZ: f64 = 10.0;
const STATES: usize = 240;
const EVENTS: usize = 64;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    place: Place,
}

/// What was heard of a run.
#[derive(Default)]
struct Seen {
    status: Option<Box<StatusMessage>>,
    state: Option<Box<StateMessage>>,
    /// Percent, and mm/s: the newest last.
    quality: VecDeque<u64>,
    speed: VecDeque<u64>,
    /// The newest first.
    events: VecDeque<EventMessage>,
}

pub fn top(args: &Args) -> Result<(), Fault> {
    if !std::io::stdout().is_terminal() {
        let fix = "use `stipple status`";
        return Err(Fault::new(FaultKind::Usage, "standard output", "is no terminal", fix));
    }
    let mut run = Connection::open(&args.place)?;
    run.ask(&format!(r#"{{"subscribe":["state","event","status"],"hz":{HZ}}}"#))?;
    let mut terminal = ratatui::try_init().map_err(|e| terminal_fault(&e))?;
    let mut seen = Seen::default();
    let shown = loop {
        match run.message() {
            Ok(message) => seen.hear(message),
            Err(fault) => break Err(fault),
        }
        if let Err(e) = terminal.draw(|frame| seen.draw(frame)) {
            break Err(terminal_fault(&e));
        }
        match asked_to_end() {
            Ok(false) => {}
            Ok(true) => break Ok(()),
            Err(e) => break Err(terminal_fault(&e)),
        }
    };
    ratatui::restore();
    shown
}

fn terminal_fault(e: &std::io::Error) -> Fault {
    Fault::new(FaultKind::Io, "the terminal", e.to_string(), "")
}

/// Whether a key that ends it was pressed.
fn asked_to_end() -> std::io::Result<bool> {
    while event::poll(Duration::ZERO)? {
        if let Event::Key(key) = event::read()? {
            let interrupts = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
            if interrupts || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc) {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

fn push<T>(list: &mut VecDeque<T>, item: T) {
    if list.len() == STATES {
        list.pop_front();
    }
    list.push_back(item);
}

impl Seen {
    fn hear(&mut self, message: Message) {
        match message {
            Message::Status(status) => self.status = Some(status),
            Message::State(state) => {
                push(&mut self.quality, u64::from(state.quality));
                let speed = state.velocity_body.iter().map(|v| v * v).sum::<f64>().sqrt();
                push(&mut self.speed, (speed * 1e3) as u64);
                self.state = Some(state);
            }
            Message::Event(event) => {
                self.events.truncate(EVENTS - 1);
                self.events.push_front(event);
            }
            Message::Points { .. } | Message::Error { .. } => {}
        }
    }

    fn draw(&self, frame: &mut Frame) {
        let [above, quality, speed, events] = Layout::vertical([
            Constraint::Length(14),
            Constraint::Length(5),
            Constraint::Length(5),
            Constraint::Fill(1),
        ])
        .areas(frame.area());
        let text = match &self.status {
            None => "waiting for the run".into(),
            Some(status) => {
                // Between two of these the newest state is newer.
                let mut status = (**status).clone();
                if let Some(state) = &self.state {
                    status.health = state.health.clone();
                    status.t_ns = status.t_ns.max(state.t_ns);
                    status.state = Some((**state).clone());
                }
                screen(&status)
            }
        };
        frame.render_widget(
            Paragraph::new(text).wrap(Wrap { trim: false }).block(Block::bordered().title(" stipple top: q ends ")),
            above,
        );
        let line = |list: &VecDeque<u64>, most: u64, area: ratatui::layout::Rect, title: String, frame: &mut Frame| {
            let room = area.width.saturating_sub(2) as usize;
            let newest: Vec<u64> = list.iter().skip(list.len().saturating_sub(room)).copied().collect();
            frame
                .render_widget(Sparkline::default().block(Block::bordered().title(title)).max(most).data(newest), area);
        };
        line(&self.quality, 100, quality, " quality, 0 to 100 % ".into(), frame);
        let fastest = self.speed.iter().copied().max().unwrap_or(0).max(100);
        line(&self.speed, fastest, speed, format!(" speed, 0 to {:.1} m/s ", fastest as f64 * 1e-3), frame);
        let lines: Vec<Line> = self
            .events
            .iter()
            .map(|event| {
                let colour = match event.level.as_ref() {
                    "critical" => Color::Red,
                    "warning" => Color::Yellow,
                    _ => Color::Reset,
                };
                Line::styled(format!("{} {}: {}", clock(event.wall_ns), event.id, event.text), Style::new().fg(colour))
            })
            .collect();
        frame.render_widget(
            Paragraph::new(lines).block(Block::bordered().title(" events, the newest first, UTC ")),
            events,
        );
    }
}

/// Time of day, UTC.
fn clock(wall_ns: i64) -> String {
    let s = wall_ns.div_euclid(1_000_000_000).rem_euclid(86_400);
    format!("{:02}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use ratatui::backend::TestBackend;
    use ratatui::Terminal;

    #[test]
    fn newest_events_and_states_are_drawn_on_any_size_of_terminal() {
        let mut seen = Seen::default();
        for i in 0..100 {
            let text = format!(
                r#"{{"type":"event","t_ns":{i},"wall_ns":3661000000000,"id":"epoch","level":"warning","text":"number {i}"}}"#
            );
            seen.hear(serde_json::from_str(&text).unwrap());
        }
        for (width, height) in [(100, 40), (20, 5), (1, 1)] {
            let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
            terminal.draw(|frame| seen.draw(frame)).unwrap();
            let shown = format!("{:?}", terminal.backend().buffer());
            assert!(width < 100 || shown.contains("01:01:01 epoch: number 99"), "{shown}");
        }
        assert_eq!(seen.events.len(), EVENTS);
    }
}
