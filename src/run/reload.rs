//! The board file, read again while a run goes on: what may change is changed at once, and only where nothing else did.

use crate::config::Board;
use std::collections::BTreeMap;
use std::path::PathBuf;
use stipple_drivers::Fault;

/// Keys that may change while a run goes on: whole sections end with a dot.
const CHANGEABLE: [&str; 3] = ["governor.", "mavlink.rate_hz", "mavlink.message"];

/// Where the board of a run comes from.
#[derive(Clone, Debug)]
pub struct BoardSource {
    pub file: PathBuf,
    /// What `--set` says.
    pub set: Vec<String>,
}

/// What a reload came to.
#[derive(Debug, PartialEq)]
pub enum Reload {
    /// These keys have other values now.
    Changed(Box<Board>, Vec<String>),
    Same,
    Refused(String),
}

impl BoardSource {
    /// Reads the board again, and compares it with the one that flies.
    pub fn reload(&self, running: &Board) -> Reload {
        compare(running, Board::load(&self.file, &self.set))
    }
}

fn compare(running: &Board, read: Result<Board, Fault>) -> Reload {
    let board = match read {
        Ok(board) => board,
        Err(fault) => return Reload::Refused(format!("nothing is reloaded: {fault}")),
    };
    let changed = differences(running, &board);
    let may = |key: &String| CHANGEABLE.iter().any(|may| key == may || may.ends_with('.') && key.starts_with(may));
    let (changed, fixed): (Vec<_>, Vec<_>) = changed.into_iter().partition(may);
    if !fixed.is_empty() {
        return Reload::Refused(format!("nothing is reloaded: a restart is needed for {}", fixed.join(", ")));
    }
    if changed.is_empty() {
        Reload::Same
    } else {
        Reload::Changed(Box::new(board), changed)
    }
}

/// Keys whose values differ.
fn differences(a: &Board, b: &Board) -> Vec<String> {
    let (a, b) = (keys(a), keys(b));
    let all: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    all.into_iter().filter(|key| a.get(*key) != b.get(*key)).cloned().collect()
}

fn keys(board: &Board) -> BTreeMap<String, toml::Value> {
    let mut all = BTreeMap::new();
    let Ok(toml::Value::Table(table)) = toml::Value::try_from(board) else { return all };
    for (name, value) in table {
        match value {
            toml::Value::Table(section) => all.extend(section.into_iter().map(|(key, v)| (format!("{name}.{key}"), v))),
            value => drop(all.insert(name, value)),
        }
    }
    all
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn board(set: &[&str]) -> Result<Board, Fault> {
        let set: Vec<String> = set.iter().map(|s| s.to_string()).collect();
        Board::parse("lavapipe.toml", include_str!("../../board-configs/lavapipe.toml"), &set)
    }

    #[test]
    fn all_of_a_change_is_taken_over_or_nothing() {
        let running = board(&[]).unwrap();
        assert_eq!(compare(&running, board(&[])), Reload::Same);
        let both = board(&["governor.power_max_w=12.5", "mavlink.rate_hz=30.0"]);
        let expected = vec!["governor.power_max_w".to_string(), "mavlink.rate_hz".into()];
        assert_eq!(compare(&running, both.clone()), Reload::Changed(Box::new(both.unwrap()), expected));
        let refused =
            compare(&running, board(&["governor.power_max_w=12.5", "vio.gyro_noise_scale=7.5", "name=\"other\""]));
        let Reload::Refused(why) = refused else { panic!("{refused:?}") };
        assert!(why.ends_with("a restart is needed for name, vio.gyro_noise_scale"), "{why}");
        let wrong = compare(&running, board(&["governor.power_max_w=-1.0"]));
        assert!(matches!(wrong, Reload::Refused(why) if why.contains("governor.power_max_w")));
    }
}
