//! A map that is larger than its memory: blocks and images come and go between the mapper and its store on disk.
#![allow(clippy::unwrap_used)]

mod flight;

use flight::{board, flight, train};
use std::path::{Path, PathBuf};
use stipple::map::{Evaluation, Keyframe, Mapper, Place, StepKind};
use stipple::mem::{heap_after_seal, seal_thread, CountingAllocator};
use stipple_drivers::Calibration;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

const KEYFRAMES: usize = 20;
const STEPS: u32 = 30;

fn place(folder: &Path, flight: i64) -> Place<'_> {
    Place { folder, fresh: false, flight: Some(flight), at_once: true }
}

fn opened(calibration: &Calibration, settings: &[&str], place: Option<Place>) -> Mapper {
    let mapper = Mapper::open_on(calibration, &board(settings), place).unwrap();
    assert!(mapper.unkept.is_none(), "{:?}", mapper.unkept);
    mapper
}

/// Maps a flight, and answers how good the map is.
fn mapped(
    calibration: &Calibration,
    keyframes: &[Keyframe],
    settings: &[&str],
    place: Option<Place>,
) -> (Mapper, Evaluation) {
    let mut mapper = opened(calibration, settings, place);
    for k in keyframes {
        mapper.ingest(k).unwrap();
        train(&mut mapper, STEPS);
    }
    let quality = mapper.evaluate().unwrap();
    (mapper, quality)
}

fn decibels(quality: &Evaluation) -> [f64; 2] {
    [quality.psnr_db.unwrap(), quality.psnr_heldout_db.unwrap()]
}

/// Six places for twenty keyframes: without a store the others are dropped.
#[test]
fn few_places_for_images_cost_nothing() {
    let (calibration, keyframes) = flight(KEYFRAMES);
    let dirs = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let [all_places, few_places] = [0, 1].map(|i| Some(place(dirs[i].path(), 1)));
    let room = "budget.splats=40000";
    let (mut whole, all) = mapped(&calibration, &keyframes, &["budget.keyframes=32", room], all_places);
    let (mut few, kept) = mapped(&calibration, &keyframes, &["budget.keyframes=6", room], few_places);
    let (_, dropped) = mapped(&calibration, &keyframes, &["budget.keyframes=6", room], None);
    let [all, kept, dropped] = [all, kept, dropped].map(|q| decibels(&q));
    println!("all {all:.2?}, six places {kept:.2?}, six keyframes {dropped:.2?} dB");
    let count = few.counters();
    assert_eq!((count.keyframe_store_full.get(), few.keyframe_count()), (0, KEYFRAMES));
    assert!(count.images_paged_in.get() > 20 && count.keyframes_lost.get() == 0);
    assert_eq!(count.blocks_paged_out.get(), 0);
    // The same views are drawn, whether or not their images have a place, so the map is the same to the bit.
    assert!(whole.splats().unwrap() == few.splats().unwrap());
    assert!((0..2).all(|i| (kept[i] - all[i]).abs() < 0.01), "{all:?} {kept:?}");
}

/// A room that takes twice the pool: with a store its map is better than thinned without one. Over five seeds the views that
/// were trained on have 1.2 dB more, the two that were held out 0.5 dB less.
#[test]
fn a_room_denser_than_the_pool_gains_by_a_store() {
    let (calibration, keyframes) = flight(KEYFRAMES);
    let dir = tempfile::tempdir().unwrap();
    let (whole, all) = mapped(&calibration, &keyframes, &["budget.keyframes=32"], None);
    let size = format!("budget.splats={}", whole.splat_count() / 2);
    let small = ["budget.keyframes=16", &size];
    let (paged, kept) = mapped(&calibration, &keyframes, &small, Some(place(dir.path(), 1)));
    let (_, thinned) = mapped(&calibration, &keyframes, &["budget.keyframes=32", &size], None);
    let [all, kept, thinned] = [all, kept, thinned].map(|q| decibels(&q));
    let count = paged.counters();
    println!(
        "{} of {}: all {all:.2?}, paged {kept:.2?} ({} Gaussians, {} out, {} in), thinned {thinned:.2?} dB",
        size,
        whole.splat_count(),
        paged.splat_count(),
        count.blocks_paged_out.get(),
        count.blocks_paged_in.get()
    );
    assert_eq!((count.blocks_lost.get(), count.keyframes_lost.get()), (0, 0));
    let gains = [0, 1].map(|i| kept[i] - thinned[i]);
    assert!(gains.iter().sum::<f64>() > 0.0 && gains.iter().all(|gain| *gain > -1.0), "{gains:?}");
}

#[test]
fn a_mapper_of_the_same_flight_goes_on_with_what_is_on_disk_and_another_flight_when_it_is_joined() {
    let (calibration, keyframes) = flight(8);
    let dir = tempfile::tempdir().unwrap();
    let run = |flight: i64| opened(&calibration, &[], Some(place(dir.path(), flight)));
    let mut mapper = run(1);
    for k in &keyframes {
        mapper.ingest(k).unwrap();
        train(&mut mapper, STEPS);
    }
    assert!(mapper.save().unwrap().unwrap(), "the store has all of it");
    let (before, splats) = (decibels(&mapper.evaluate().unwrap()), mapper.splat_count());
    drop(mapper);
    let mut again = run(1);
    assert_eq!((again.splat_count(), again.keyframe_count()), (splats, 8));
    let after = decibels(&again.evaluate().unwrap());
    println!("before {before:.3?}, after {after:.3?} dB");
    assert!((0..2).all(|i| (after[i] - before[i]).abs() < 0.1), "{before:?} {after:?}");
    train(&mut again, STEPS);
    drop(again);
    // Another knows of it, and nothing of it is its own: a view of the same place is all uncovered, until both are joined.
    let see_again = |flight: i64, joined: bool| {
        let mut other = run(flight);
        let (id, epoch) = other.first_numbers();
        assert!(other.splat_count() > 0 && other.keyframe_count() as u64 == id && epoch > 0);
        assert_eq!(other.evaluate().unwrap().psnr_db, None);
        if joined {
            other.join(Some(1), 0, 0);
        }
        let stored = other.ingest(&Keyframe { id, epoch, ..keyframes[0].clone() }).unwrap();
        (matches!(stored, StepKind::Anchor { .. }), other.evaluate().unwrap().psnr_db.unwrap())
    };
    assert!(see_again(2, false).0, "it makes an anchor of its own");
    let (anchor, psnr_db) = see_again(3, true);
    assert!(!anchor && psnr_db > before[0] - 2.0, "{anchor} {psnr_db} {before:?}");
}

/// A copy of a map's folder without one of its files.
fn copied(from: &Path, to: &Path, without: &str) -> PathBuf {
    let to = to.join(format!("without {without}"));
    std::fs::create_dir(&to).unwrap();
    for file in std::fs::read_dir(from).unwrap().map(|entry| entry.unwrap()) {
        if file.file_name() != without {
            std::fs::copy(file.path(), to.join(file.file_name())).unwrap();
        }
    }
    to
}

/// A snapshot with an anchor that grows, after which the anchor was completed: what the store has of it is newer.
#[test]
fn a_mapper_that_dies_after_a_burst_leaves_its_anchor_once() {
    let (calibration, keyframes) = flight(1);
    let (dir, died) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut mapper = opened(&calibration, &[], Some(place(dir.path(), 1)));
    assert!(matches!(mapper.ingest(&keyframes[0]).unwrap(), StepKind::Anchor { .. }));
    let growing = (mapper.splat_count(), copied(dir.path(), died.path(), "lock"));
    train(&mut mapper, STEPS);
    let complete = (mapper.splat_count(), copied(dir.path(), died.path(), "nothing"));
    for (count, folder) in [growing, complete] {
        let again = opened(&calibration, &[], Some(place(&folder, 1)));
        assert_eq!(again.splat_count(), count);
    }
}

/// What is on the disk when a mapper dies is the map of its last keyframe, also of an anchor whose burst has just begun; what the
/// store alone has by then is worse.
#[test]
fn a_mapper_that_dies_leaves_the_map_of_its_last_keyframe() {
    let (calibration, keyframes) = flight(8);
    let (dir, died) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut mapper = opened(&calibration, &[], Some(place(dir.path(), 1)));
    for k in &keyframes {
        train(&mut mapper, STEPS);
        mapper.ingest(k).unwrap();
    }
    let [whole, store_alone] = ["lock", "latest"].map(|without| copied(dir.path(), died.path(), without));
    assert_eq!(mapper.counters().snapshot_errors.get(), 0);
    let before = decibels(&mapper.evaluate().unwrap());
    let score = |folder: &Path| {
        let mut again = opened(&calibration, &[], Some(place(folder, 1)));
        (again.splat_count(), decibels(&again.evaluate().unwrap()))
    };
    let ((count, after), (_, worse)) = (score(&whole), score(&store_alone));
    println!("before {before:.3?}, after {after:.3?}, of the store alone {worse:.3?} dB");
    assert_eq!(count, mapper.splat_count());
    assert!((0..2).all(|i| (after[i] - before[i]).abs() < 0.1), "{before:?} {after:?}");
    assert!(worse[0] < before[0] - 0.1, "{before:?} {worse:?}");
    // Once it is taken over it is in the store.
    std::fs::remove_file(whole.join("latest")).unwrap();
    assert_eq!(score(&whole).1, after);
}

#[test]
fn paging_repeats_to_the_bit_and_allocates_nothing() {
    let (calibration, keyframes) = flight(12);
    let small = ["budget.keyframes=4", "budget.splats=4000"];
    let run = || {
        let dir = tempfile::tempdir().unwrap();
        let mut mapper = opened(&calibration, &small, Some(place(dir.path(), 1)));
        seal_thread();
        let before = heap_after_seal();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, STEPS);
        }
        assert_eq!(heap_after_seal() - before, 0);
        let quality = mapper.evaluate().unwrap();
        (mapper.splats().unwrap(), decibels(&quality))
    };
    // One after the other, each on a thread of its own: allocations are counted over all threads.
    let apart = || std::thread::scope(|s| s.spawn(run).join().unwrap());
    let ((a, quality), (b, same)) = (apart(), apart());
    assert_eq!(quality, same);
    assert!(!a.is_empty() && a == b);
}
