//! A map out of its store, into a file that viewers open: PLY or `.spz`. No more than one block is in memory.
//!
//! The store is passed over several times, since both forms state the number of Gaussians first and `.spz` has one array after
//! another: once to see what is there, once more to find the least importance that is kept, then once for the file, or for
//! each of its arrays. A run may write to the store meanwhile. What was read is known by its hash: where a block was replaced
//! between two passes and its older generation is gone, all begins again. What was only moved, the reader finds.

use super::ply::PlyWriter;
use super::{atomically, cannot_write, spz};
use crate::map::block::{BlockAbout, JoinAbout, KeyframeAbout, RunAbout};
use crate::map::block::{KIND_BLOCK, KIND_JOIN, KIND_KEYFRAME, KIND_RUN};
use crate::map::exposure::median_exposure;
use crate::map::{Exposure, Gaussian};
use crate::store::{Key, Reader};
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::path::Path;
use stipple_drivers::{Fault, FaultKind};

/// Times that all begins again before a store changes too fast.
const ATTEMPTS: usize = 5;
/// Exposures that the median is taken of: it compares each with each.
const EXPOSURES_MAX: usize = 1024;
/// Bins of the histogram of importance, whose bits are divided by their upper and lower halves.
const BINS: usize = 1 << 16;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    Ply,
    Spz,
}

/// What is to be exported.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Request {
    /// Number of a run in the store; the newest that has blocks where it is not said. Runs that loop closure has joined with it
    /// are one map with it.
    pub run: Option<u32>,
    /// So many of the most important Gaussians.
    pub most: Option<u64>,
    /// Those within, by their means: least and largest x, y and z in the epoch's frame, m.
    pub region: Option<[[f32; 3]; 2]>,
}

/// What was exported.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Exported {
    pub gaussians: u64,
    pub bytes: u64,
    pub run: u32,
    /// Runs in the store.
    pub runs: usize,
    /// Blocks read, and the ids of those that were damaged and are left out.
    pub blocks: usize,
    pub damaged: Vec<u32>,
}

/// Why a pass over the store did not come to its end.
enum Stop {
    /// A record was replaced since the first pass.
    Changed,
    Failed(Fault),
    /// What it was given to could not be written.
    Unwritten(io::Error),
}

impl From<Fault> for Stop {
    fn from(fault: Fault) -> Stop {
        Stop::Failed(fault)
    }
}

/// Exports the map in the store `folder` to the file `to`, all or nothing. Fails where there is no such map, or it cannot be
/// written.
pub fn export(folder: &Path, to: &Path, form: Form, request: &Request) -> Result<Exported, Fault> {
    for _ in 0..ATTEMPTS {
        match attempt(folder, to, form, request) {
            Ok(exported) => return Ok(exported),
            Err(Stop::Changed) => {}
            Err(Stop::Failed(fault)) => return Err(fault),
            Err(Stop::Unwritten(e)) => return Err(cannot_write(to, &e)),
        }
    }
    let what = format!("was changed {ATTEMPTS} times while it was read");
    Err(Fault::new(FaultKind::Unavailable, folder.display().to_string(), what, "export it when the run has ended"))
}

fn attempt(folder: &Path, to: &Path, form: Form, request: &Request) -> Result<Exported, Stop> {
    let mut source = Source { reader: Reader::open(folder)?, payload: vec![] };
    let contents = Contents::of(&source.reader, folder, request.run)?;
    let survey = source.survey(&contents.blocks, request.region);
    if survey.blocks.is_empty() && survey.damaged.is_empty() {
        return Err(Stop::Changed);
    }
    let mut kept = Kept { region: request.region, least: 0, ties: u64::MAX };
    let mut gaussians = survey.gaussians;
    if let Some(most) = request.most.filter(|most| *most < gaussians) {
        (kept.least, kept.ties) = source.threshold(&survey, request.region, most)?;
        gaussians = most;
    }
    let place = folder.display().to_string();
    if gaussians == 0 {
        let what = match (survey.blocks.is_empty(), request.region) {
            (true, _) => format!("each of the {} blocks of run {} is damaged", survey.damaged.len(), contents.run),
            (_, Some(_)) => format!("no Gaussian of run {} is in the region", contents.run),
            _ => format!("run {} has no Gaussians", contents.run),
        };
        return Err(Stop::Failed(Fault::new(FaultKind::Data, place, what, "name another run or region")));
    }
    let mut stopped = None;
    let written = match form {
        Form::Ply => atomically(to, |w| {
            let mut ply = PlyWriter::begin(w, gaussians)?;
            let pass = source.pass(&survey.blocks, &kept, contents.exposure, &mut |g| ply.splat(g));
            pass.map_err(|stop| set_aside(stop, &mut stopped))?;
            ply.end()
        }),
        Form::Spz if gaussians > spz::COUNT_MAX => {
            let what = format!("has {gaussians} Gaussians, and readers of .spz take {}", spz::COUNT_MAX);
            let fix = format!("add --most {}, name a region, or write a .ply", spz::COUNT_MAX);
            return Err(Stop::Failed(Fault::new(FaultKind::Usage, place, what, fix)));
        }
        Form::Spz => atomically(to, |w| {
            let all = |sink: &mut dyn FnMut(&Gaussian) -> io::Result<()>| {
                let pass = source.pass(&survey.blocks, &kept, contents.exposure, sink);
                pass.map_err(|stop| set_aside(stop, &mut stopped))
            };
            spz::write_spz(w, gaussians as u32, survey.extent_m, all)
        }),
    };
    if let Some(stop) = stopped {
        return Err(stop);
    }
    written?;
    let bytes = std::fs::metadata(to).map_or(0, |m| m.len());
    let (run, runs, blocks) = (contents.run, contents.runs, survey.blocks.len());
    Ok(Exported { gaussians, bytes, run, runs, blocks, damaged: survey.damaged })
}

/// Keeps why a pass over the store stopped, and answers an error for who writes.
fn set_aside(stop: Stop, stopped: &mut Option<Stop>) -> io::Error {
    match stop {
        Stop::Unwritten(e) => e,
        stop => {
            *stopped = Some(stop);
            io::Error::other("the map could not be read")
        }
    }
}

/// The runs that are one map with a run, itself among them.
fn one_map(reader: &Reader, run: u32) -> BTreeSet<u32> {
    // Runs by their first epochs, and epochs that are one.
    let (mut begun, mut joined) = (BTreeMap::new(), vec![]);
    reader.entries(|key, about| match key.kind {
        KIND_RUN => begun.extend(RunAbout::decode(about).map(|r| (r.epoch_base, key.run))),
        KIND_JOIN => joined.extend(JoinAbout::decode(about).map(|join| [key.id, join.into])),
        _ => {}
    });
    let of_epoch = |epoch: u32| begun.range(..=epoch).next_back().map(|(_, run)| *run);
    let pairs: Vec<_> = joined.iter().map(|pair| pair.map(of_epoch)).collect();
    let mut runs = BTreeSet::from([run]);
    // Each pass may find one that the next begins from.
    for _ in 0..pairs.len() {
        for [a, b] in &pairs {
            if let (Some(a), Some(b)) = (a, b) {
                if runs.contains(a) || runs.contains(b) {
                    runs.extend([a, b]);
                }
            }
        }
    }
    runs
}

/// What a store has of one run, and of those that are one map with it.
struct Contents {
    run: u32,
    runs: usize,
    blocks: Vec<Key>,
    /// What takes the map's colours to what most images show.
    exposure: Exposure,
}

impl Contents {
    fn of(reader: &Reader, folder: &Path, run: Option<u32>) -> Result<Contents, Fault> {
        let (mut runs, mut with_blocks) = (BTreeSet::new(), BTreeSet::new());
        reader.entries(|key, _| {
            runs.insert(key.run);
            if key.kind == KIND_BLOCK {
                with_blocks.insert(key.run);
            }
        });
        let newest = with_blocks.last().copied();
        let Some(run) = run.map_or(newest, |run| with_blocks.get(&run).copied()) else {
            let list = with_blocks.iter().map(u32::to_string).collect::<Vec<_>>().join(", ");
            let (what, fix) = match (run, newest) {
                (Some(run), Some(_)) => (format!("has no blocks of run {run}"), format!("it has those of {list}")),
                _ => ("has no blocks of Gaussians yet".into(), "a block is there when it was trained a little".into()),
            };
            return Err(Fault::new(FaultKind::Data, folder.display().to_string(), what, fix));
        };
        let (mut blocks, mut exposures, one_map) = (vec![], vec![], one_map(reader, run));
        reader.entries(|key, about| match key.kind {
            KIND_BLOCK if one_map.contains(&key.run) => blocks.push(*key),
            KIND_KEYFRAME if one_map.contains(&key.run) => {
                let keyframe = KeyframeAbout::decode(about).filter(|k| !k.held_out);
                exposures.extend(keyframe.map(|k| ((key.run, key.id), k.exposure)));
            }
            _ => {}
        });
        blocks.sort_unstable();
        exposures.sort_unstable_by_key(|(key, _)| *key);
        let stride = exposures.len().div_ceil(EXPOSURES_MAX).max(1);
        let spread: Vec<Exposure> = exposures.iter().step_by(stride).map(|(_, exposure)| *exposure).collect();
        Ok(Contents { run, runs: runs.len(), blocks, exposure: median_exposure(&spread).unwrap_or_default() })
    }
}

/// What the first pass found.
struct Survey {
    /// Those that can be read, by their keys, with a hash of each.
    blocks: Vec<(Key, u64)>,
    damaged: Vec<u32>,
    gaussians: u64,
    /// Largest coordinate of any, m.
    extent_m: f32,
    /// Gaussians by the upper half of the bits of their importance.
    upper: Vec<u64>,
}

impl Survey {
    fn count(&mut self, g: &Gaussian) {
        self.gaussians += 1;
        self.extent_m = g.mean.iter().fold(self.extent_m, |most, v| most.max(v.abs()));
        self.upper[(importance_bits(g) >> 16) as usize] += 1;
    }
}

/// Which Gaussians are kept: those in the region and above the least importance, and so many of exactly this one.
#[derive(Clone, Copy)]
struct Kept {
    region: Option<[[f32; 3]; 2]>,
    least: u32,
    ties: u64,
}

impl Kept {
    fn takes(&mut self, g: &Gaussian) -> bool {
        let importance = importance_bits(g);
        let tie = importance == self.least && self.ties > 0;
        let taken = is_in(self.region, g) && (importance > self.least || tie);
        self.ties -= u64::from(taken && importance == self.least);
        taken
    }
}

/// Orders as importance does, which is not negative.
fn importance_bits(g: &Gaussian) -> u32 {
    g.importance().to_bits()
}

fn is_in(region: Option<[[f32; 3]; 2]>, g: &Gaussian) -> bool {
    region.is_none_or(|[least, most]| (0..3).all(|i| least[i] <= g.mean[i] && g.mean[i] <= most[i]))
}

/// Whether a viewer can draw it: all numbers are finite, and there is a rotation.
fn is_drawable(g: &Gaussian) -> bool {
    let numbers = || g.mean.iter().chain(&g.log_scale).chain(&g.quat_xyzw).chain(&g.colour).chain([&g.opacity_logit]);
    numbers().all(|v| v.is_finite()) && g.quat_xyzw != [0.0; 4]
}

/// The store, and the block that was read last.
struct Source {
    reader: Reader,
    payload: Vec<u8>,
}

/// Why a block was not read.
enum Unread {
    Damaged,
    /// It was removed.
    Gone,
}

impl Source {
    /// Reads a block, and answers what is known of it and a hash of all.
    fn read(&mut self, key: &Key) -> Result<(BlockAbout, u64), Unread> {
        let about = self.reader.read(*key, &mut self.payload).map_err(|fault| match fault.kind {
            FaultKind::NoInput => Unread::Gone,
            _ => Unread::Damaged,
        })?;
        let mut hasher = DefaultHasher::new();
        (about, &self.payload).hash(&mut hasher);
        let block = BlockAbout::decode(&about).filter(|b| b.arrays(&self.payload).is_some());
        Ok((block.ok_or(Unread::Damaged)?, hasher.finish()))
    }

    /// The Gaussians of the block that was read last, where they are now.
    fn gaussians(&self, block: &BlockAbout) -> impl Iterator<Item = Gaussian> + '_ {
        let bytes = block.arrays(&self.payload);
        let moved = block.moved;
        bytes.into_iter().flat_map(move |bytes| bytes.gaussians(&moved)).filter(is_drawable)
    }

    /// The first pass.
    fn survey(&mut self, keys: &[Key], region: Option<[[f32; 3]; 2]>) -> Survey {
        let (blocks, damaged) = (Vec::with_capacity(keys.len()), vec![]);
        let mut survey = Survey { blocks, damaged, gaussians: 0, extent_m: 0.0, upper: vec![0; BINS] };
        for key in keys {
            match self.read(key) {
                Ok((block, hash)) => {
                    survey.blocks.push((*key, hash));
                    self.gaussians(&block).filter(|g| is_in(region, g)).for_each(|g| survey.count(&g));
                }
                Err(Unread::Damaged) => survey.damaged.push(key.id),
                Err(Unread::Gone) => {}
            }
        }
        survey
    }

    /// Gives every Gaussian that is kept to `sink`, in the order of the blocks, with its colour as `exposure` shows it.
    fn pass(
        &mut self,
        blocks: &[(Key, u64)],
        kept: &Kept,
        exposure: Exposure,
        sink: &mut dyn FnMut(&Gaussian) -> io::Result<()>,
    ) -> Result<(), Stop> {
        let mut kept = *kept;
        for (key, hash) in blocks {
            let block = match self.read(key) {
                Ok((block, now)) if now == *hash => block,
                _ => return Err(Stop::Changed),
            };
            for mut g in self.gaussians(&block).filter(|g| kept.takes(g)) {
                g.colour = g.colour.map(|c| exposure.observed(f64::from(c)) as f32);
                sink(&g).map_err(Stop::Unwritten)?;
            }
        }
        Ok(())
    }

    /// The importance, as bits, of the least of the `most` most important, and how many of exactly that are among them.
    fn threshold(&mut self, survey: &Survey, region: Option<[[f32; 3]; 2]>, most: u64) -> Result<(u32, u64), Stop> {
        let (bin, above) = bin_of(&survey.upper, most);
        let mut lower = vec![0; BINS];
        let all = Kept { region, least: 0, ties: u64::MAX };
        self.pass(&survey.blocks, &all, Exposure::default(), &mut |g| {
            let bits = importance_bits(g);
            lower[(bits & 0xffff) as usize] += u64::from(bits >> 16 == bin);
            Ok(())
        })?;
        let rank = most - above;
        let (low, above) = bin_of(&lower, rank);
        Ok((bin << 16 | low, rank - above))
    }
}

/// The bin that holds the `rank`th from the top, and how many are above it.
fn bin_of(bins: &[u64], rank: u64) -> (u32, u64) {
    let mut above = 0;
    for (bin, n) in bins.iter().enumerate().rev() {
        if above + n >= rank {
            return (bin as u32, above);
        }
        above += n;
    }
    (0, above)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::gpu::kernels::types::Splat;
    use crate::map::block::BlockArrays;
    use crate::store::{Limits, Store};

    const KEY: Key = Key { kind: KIND_BLOCK, run: 0, id: 3 };

    fn put(store: &mut Store, count: u32) {
        let one = Splat { mean_opacity: [1.0, 2.0, 3.0, 0.5], scale_colour: [-3.0; 4], quat: [0.0, 0.0, 0.0, 1.0] };
        let (splats, steps) = (vec![one; count as usize], vec![0; count as usize]);
        let about = BlockAbout { count, ..BlockAbout::default() };
        assert!(store.put(KEY, &about.encode(), |to| {
            BlockArrays { splats: &splats, steps: &steps, ..BlockArrays::default() }.encode(to);
        }));
    }

    /// What is put, then removed, between two passes.
    #[test]
    fn a_pass_does_not_take_another_block_for_the_one_that_was_counted() {
        let dir = tempfile::tempdir().unwrap();
        let limits = Limits {
            bytes_max: 4 << 20,
            segment_bytes: 128 << 10,
            records_max: 100,
            payload_max: 64 << 10,
            buffers: 2,
            write_bytes_per_s: 0,
        };
        let (mut store, disk) = Store::open(dir.path(), 1, &limits).unwrap();
        put(&mut store, 500);
        store.flush().unwrap();
        let mut source = Source { reader: Reader::open(dir.path()).unwrap(), payload: vec![] };
        let survey = source.survey(&[KEY], None);
        let all = Kept { region: None, least: 0, ties: u64::MAX };
        let pass = |source: &mut Source| {
            let mut n = 0;
            let done = source.pass(&survey.blocks, &all, Exposure::default(), &mut |_| {
                n += 1;
                Ok(())
            });
            done.map(|()| n)
        };
        assert!(survey.gaussians == 500 && matches!(pass(&mut source), Ok(500)));
        // The first generation is still there, so the passes agree.
        for _ in 0..20 {
            put(&mut store, 400);
            disk.serve();
        }
        store.flush().unwrap();
        assert!(matches!(pass(&mut source), Ok(500)));
        // Its segment is used for something else.
        let first = std::fs::OpenOptions::new().write(true).open(dir.path().join("00000000.seg")).unwrap();
        first.set_len(0).and_then(|()| first.set_len(limits.segment_bytes)).unwrap();
        assert!(matches!(pass(&mut source), Err(Stop::Changed)));
        assert!(store.remove(KEY));
        store.flush().unwrap();
        let mut source = Source { reader: Reader::open(dir.path()).unwrap(), payload: vec![] };
        assert!(matches!(pass(&mut source), Err(Stop::Changed)));
        let fault = Contents::of(&source.reader, dir.path(), None).err().unwrap();
        assert!(fault.kind == FaultKind::Data && fault.what.contains("no blocks"), "{fault}");
    }

    #[test]
    fn the_bin_of_a_rank_is_counted_from_the_top() {
        let mut bins = [0; 8];
        (bins[1], bins[4], bins[6]) = (7, 2, 3);
        let of = |rank: u64| bin_of(&bins, rank);
        assert_eq!([1, 3, 4, 5, 6, 12].map(of), [(6, 0), (6, 0), (4, 3), (4, 3), (1, 5), (1, 5)]);
    }
}
