//! Runs of a store: several flights, one map. Each run numbers its own keyframes on the disk; in memory keyframes are numbered
//! over all runs that are known, the oldest first, and epochs over all runs of the store. Epochs that loop closure has joined
//! are one.

use super::block::{BlockAbout, JoinAbout, KeyframeAbout, RunAbout};
use super::block::{KIND_BLOCK, KIND_JOIN, KIND_KEYFRAME, KIND_RUN};
use super::parts::PARTS;
use crate::limits::CAMERAS_MAX;
use crate::store::{Key, Store};
use std::collections::BTreeMap;

/// Part of the room for keyframes that earlier runs may take, of four; older ones are left on the disk.
const EARLIER_PARTS: u64 = 3;
/// Runs and joins that are known at most.
const RUNS: usize = 64;
const JOINS: usize = 256;

/// A run whose map is known.
#[derive(Clone, Copy, Debug, Default)]
pub struct Run {
    pub run: u32,
    pub about: RunAbout,
    /// Its keyframe 0 over all runs, and how many there are.
    pub first: u64,
    pub keyframes: u64,
}

#[derive(Clone, Debug, Default)]
pub struct Runs {
    /// The oldest first, this one last.
    pub list: Vec<Run>,
    /// Epochs that are others by now.
    pub joined: Vec<(u32, u32)>,
}

/// The run that a store of runs with these keyframes and abouts goes on with: the newest, where `flight` is its own or not
/// asked for, or else a new one like `about`.
fn newest(found: &BTreeMap<u32, Run>, epochs: u32, about: RunAbout, flight: Option<i64>) -> Run {
    match found.last_key_value() {
        Some((_, run)) if flight.is_none_or(|flight| run.about.started_unix_ms == flight) => *run,
        last => {
            let run = last.map_or(0, |(run, _)| run + 1);
            Run { run, about: RunAbout { epoch_base: epochs, ..about }, ..Run::default() }
        }
    }
}

impl Runs {
    /// What a store knows of runs, for a run like `about` of a flight (`archive::Place::flight`), with room for so many keyframes.
    pub fn of(store: &Store, about: RunAbout, flight: Option<i64>, keyframes: usize) -> Runs {
        let (mut found, mut joined, mut epochs) = (BTreeMap::<u32, Run>::new(), vec![], 0);
        store.entries(|key, about| {
            let run = found.entry(key.run).or_insert(Run { run: key.run, ..Run::default() });
            let epoch = match key.kind {
                KIND_BLOCK => BlockAbout::decode(about).map(|b| b.epoch),
                KIND_KEYFRAME => {
                    run.keyframes = run.keyframes.max(u64::from(key.id / CAMERAS_MAX as u32) + 1);
                    KeyframeAbout::decode(about).map(|k| k.epoch)
                }
                KIND_RUN => {
                    run.about = RunAbout::decode(about).unwrap_or_default();
                    Some(run.about.epoch_base)
                }
                KIND_JOIN => {
                    joined.extend(JoinAbout::decode(about).map(|join| (key.id, join.into)));
                    Some(key.id)
                }
                _ => None,
            };
            epochs = epochs.max(epoch.map_or(0, |e| e + 1));
        });
        let newest = newest(&found, epochs, about, flight);
        let (mut list, mut room) = (Vec::with_capacity(RUNS), keyframes as u64 * EARLIER_PARTS / 4);
        list.push(newest);
        for (_, run) in found.range(..newest.run).rev().take(RUNS - 1) {
            let Some(rest) = room.checked_sub(run.keyframes) else { break };
            room = rest;
            list.push(*run);
        }
        list.reverse();
        let mut first = 0;
        for run in &mut list {
            run.first = first;
            first += run.keyframes;
        }
        joined.reserve(JOINS);
        Runs { list, joined }
    }

    /// This run.
    pub fn newest(&self) -> &Run {
        &self.list[self.list.len() - 1]
    }

    /// The epoch that one is by now.
    pub fn resolved(&self, epoch: u32) -> u32 {
        let mut at = epoch;
        // Not longer than there are joins: a damaged store may have a circle.
        for _ in 0..self.joined.len() {
            let Some((_, into)) = self.joined.iter().find(|(from, _)| *from == at) else { break };
            at = *into;
        }
        at
    }

    /// The number over all runs of an epoch of this flight, or of the one that began at `flight`, ms since 1970.
    pub fn epoch(&self, flight: Option<i64>, epoch: u32) -> Option<u32> {
        let of_flight = |run: &&Run| flight.is_none_or(|flight| run.about.started_unix_ms == flight);
        self.list.iter().rev().find(of_flight).and_then(|run| run.about.epoch_base.checked_add(epoch))
    }

    /// Whether one more can be joined.
    pub fn may_join(&self) -> bool {
        self.joined.len() < JOINS
    }

    /// The key of what has a number over all runs.
    pub fn key(&self, kind: u8, id: u32) -> Key {
        let each = numbers(kind);
        let at = self.list.partition_point(|run| run.first <= u64::from(id / each)).max(1) - 1;
        let Run { run, first, .. } = self.list[at];
        Key { kind, run, id: id - first as u32 * each }
    }

    /// The same key with its number over all runs.
    pub fn over_all(&self, key: &Key) -> Key {
        let first = self.list.iter().find(|run| run.run == key.run).map_or(0, |run| run.first);
        Key { id: key.id + first as u32 * numbers(key.kind), ..*key }
    }
}

/// Numbers that a keyframe has of a kind of record.
fn numbers(kind: u8) -> u32 {
    if kind == KIND_BLOCK {
        PARTS
    } else {
        CAMERAS_MAX as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::block::KIND_IMAGE;

    #[test]
    fn numbers_over_all_runs_are_those_of_each_run_and_back() {
        let run = |run, first, keyframes| Run { run, first, keyframes, ..Run::default() };
        // Run 4 was left on the disk, run 5 has no keyframe.
        let runs = Runs { list: vec![run(3, 0, 10), run(5, 10, 0), run(6, 10, 7), run(7, 17, 0)], joined: vec![] };
        for kind in [KIND_BLOCK, KIND_KEYFRAME, KIND_IMAGE] {
            let each = numbers(kind);
            for (keyframe, of_run, local) in [(0, 3, 0), (9, 3, 9), (10, 6, 0), (16, 6, 6), (17, 7, 0), (99, 7, 82)] {
                for part in 0..each {
                    let key = runs.key(kind, keyframe * each + part);
                    assert_eq!(key, Key { kind, run: of_run, id: local * each + part });
                    assert_eq!(runs.over_all(&key).id, keyframe * each + part);
                }
            }
        }
    }

    #[test]
    fn joined_epochs_are_one_and_a_circle_ends() {
        let runs = |joined: &[(u32, u32)]| Runs { list: vec![], joined: joined.to_vec() };
        assert_eq!(runs(&[(0, 2), (2, 5), (1, 5)]).resolved(0), 5);
        assert_eq!(runs(&[(0, 2)]).resolved(2), 2);
        assert!(runs(&[(0, 1), (1, 0)]).resolved(0) < 2);
    }
}
