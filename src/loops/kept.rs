//! Places on disk, beside the map, so that a later flight finds itself in the map of an earlier one.
//!
//! A store of its own (`store`) with a record for each keyframe: what `PlaceAbout` says, and its features. Poses in the map
//! change with every loop, so they are in one more record, `KIND_POSES`, which is written anew when they have moved. Places of
//! another rig or version are refused, and a record that is damaged is left out.

use super::features::{Feature, FEATURES};
use super::pose4::Pose4;
use crate::mem::unsealed;
use crate::store::{self, About, Disk, Key, Limits, Reader, Store};
use bytemuck::{Pod, Zeroable};
use glam::{DQuat, DVec3};
use std::path::{Path, PathBuf};
use stipple_drivers::{host, Calibration, Fault, FaultKind, Nanos};

/// Version of the records' form; places of another are refused.
const FORM: u32 = 1;
const KIND_PLACE: u8 = 1;
const KIND_POSES: u8 = 2;
const POSES_KEY: Key = Key { kind: KIND_POSES, run: 0, id: 0 };
const SEGMENT_BYTES: u64 = 4 << 20;
/// Records between here and the disk; each is written at once, so few are enough.
const BUFFERS: usize = 4;
// Records are copied as they are in memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// Numbers of places and frames stay below this, so that there is always a next one.
const NUMBERS: u32 = 1 << 31;

/// Name of an epoch over all flights.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Epoch {
    /// When its flight began, ms since 1970.
    pub flight: i64,
    /// Number in the flight.
    pub number: u32,
}

/// What is kept of a place beside its features.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeptPlace {
    /// Its key.
    pub number: u32,
    pub t: Nanos,
    pub epoch: Epoch,
    /// The frame of `map`: places of one frame are one map.
    pub frame: u32,
    /// Poses of the level frame in `odom` and in the map, and what turns the body upright.
    pub odom: Pose4,
    pub map: Pose4,
    pub tilt: DQuat,
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct PlaceAbout {
    flight: i64,
    t: i64,
    epoch: u32,
    frame: u32,
    /// Position and yaw.
    odom: [f64; 4],
    map: [f64; 4],
    tilt_xyzw: [f64; 4],
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct PlacePose {
    number: u32,
    frame: u32,
    map: [f64; 4],
}

fn numbers(pose: &Pose4) -> [f64; 4] {
    [pose.p.x, pose.p.y, pose.p.z, pose.yaw]
}

fn pose([x, y, z, yaw]: [f64; 4]) -> Pose4 {
    Pose4 { p: DVec3::new(x, y, z), yaw }
}

impl KeptPlace {
    fn encode(&self) -> About {
        let about = PlaceAbout {
            flight: self.epoch.flight,
            t: self.t.0,
            epoch: self.epoch.number,
            frame: self.frame,
            odom: numbers(&self.odom),
            map: numbers(&self.map),
            tilt_xyzw: self.tilt.to_array(),
        };
        let mut bytes = [0; store::ABOUT];
        bytes[..size_of::<PlaceAbout>()].copy_from_slice(bytemuck::bytes_of(&about));
        bytes
    }

    /// `None` of bytes that are no place.
    fn decode(number: u32, bytes: &About) -> Option<KeptPlace> {
        let about: PlaceAbout = bytemuck::pod_read_unaligned(&bytes[..size_of::<PlaceAbout>()]);
        let place = KeptPlace {
            number,
            t: Nanos(about.t),
            epoch: Epoch { flight: about.flight, number: about.epoch },
            frame: about.frame,
            odom: pose(about.odom),
            map: pose(about.map),
            tilt: DQuat::from_array(about.tilt_xyzw),
        };
        let has_next = number < NUMBERS && about.frame < NUMBERS;
        (has_next && place.odom.is_finite() && place.map.is_finite() && place.tilt.is_normalized()).then_some(place)
    }
}

/// A number of a rig: places that another has seen are not read.
fn identity(calibration: &Calibration) -> u64 {
    store::identity(&format!("places {FORM} {:?}", calibration.cameras))
}

/// What was read of a folder of places.
#[derive(Default)]
pub struct Kept {
    /// With their features, the oldest first.
    pub places: Vec<(KeptPlace, Vec<Feature>)>,
    /// Lines about what is damaged, and left out.
    pub warnings: Vec<String>,
}

/// Reads the places in a folder; none where there is no store. Fails where they are of another rig or version. Allocates.
pub fn read(folder: &Path, calibration: &Calibration) -> Result<Kept, Fault> {
    if !folder.is_dir() {
        return Ok(Kept::default());
    }
    let mut reader = match Reader::open(folder) {
        Err(fault) if fault.kind == FaultKind::NoInput => {
            // A store that was set aside leaves its lock.
            let is_empty = std::fs::read_dir(folder)
                .is_ok_and(|mut files| files.all(|file| file.is_ok_and(|file| file.file_name() == store::LOCK)));
            let what = format!(
                "{}: no place can be read from the files that are there, which stay as they are",
                folder.display()
            );
            return Ok(Kept { warnings: if is_empty { vec![] } else { vec![what] }, ..Kept::default() });
        }
        opened => opened?,
    };
    if reader.identity() != identity(calibration) {
        let what = "the places that are there are of another rig or another version of stipple";
        let fix = "give the calibration they were seen with, name another folder, or start with --fresh";
        return Err(Fault::new(FaultKind::Data, folder.display().to_string(), what, fix));
    }
    let mut keys = vec![];
    reader.entries(|key, _| keys.extend((key.kind == KIND_PLACE).then_some(*key)));
    keys.sort_unstable();
    let (mut places, mut payload, records) = (vec![], vec![], keys.len());
    for key in keys {
        // What is damaged is left out.
        let Ok(about) = reader.read(key, &mut payload) else { continue };
        let features = payload.chunks_exact(size_of::<Feature>()).take(FEATURES).map(bytemuck::pod_read_unaligned);
        places.extend(KeptPlace::decode(key.id, &about).map(|place| (place, features.collect::<Vec<Feature>>())));
    }
    if reader.read(POSES_KEY, &mut payload).is_ok() {
        for bytes in payload.chunks_exact(size_of::<PlacePose>()) {
            let moved: PlacePose = bytemuck::pod_read_unaligned(bytes);
            let map = pose(moved.map);
            let found = places.binary_search_by_key(&moved.number, |(place, _)| place.number);
            if let (Ok(at), true) = (found, map.is_finite() && moved.frame < NUMBERS) {
                (places[at].0.map, places[at].0.frame) = (map, moved.frame);
            }
        }
    }
    let mut warnings = reader.warnings().to_vec();
    let damaged = (records - places.len()) as u64 + reader.damaged();
    if damaged > 0 {
        let (whole, folder) = (places.len(), folder.display());
        warnings.push(format!("{folder}: {damaged} records are damaged and left out; {whole} places can be read"));
    }
    Ok(Kept { places, warnings })
}

/// Writes places as they come, on the thread that finds them. The store is opened when the first one comes, so that a run that
/// ends before leaves nothing.
pub struct Keeper {
    folder: PathBuf,
    identity: u64,
    limits: Limits,
    open: Option<(Store, Disk)>,
    /// It could not be opened.
    failed: bool,
}

fn limits(places: usize) -> Limits {
    let place = store::record_bytes(FEATURES * size_of::<Feature>()) as u64;
    let payload_max = (FEATURES * size_of::<Feature>()).max(places * size_of::<PlacePose>());
    Limits {
        // Half of a store holds records, seven eighths of them new ones, less three segments.
        bytes_max: (7 * place * places as u64 / 2).max(8 * SEGMENT_BYTES),
        segment_bytes: SEGMENT_BYTES,
        records_max: places + 64,
        payload_max,
        buffers: BUFFERS,
        write_bytes_per_s: 0,
    }
}

impl Keeper {
    /// For so many places, in the store of a folder. Fails where the disk has no room for them.
    pub fn new(folder: &Path, calibration: &Calibration, places: usize) -> Result<Keeper, Fault> {
        let limits = limits(places);
        let free = folder.parent().and_then(host::disk_free).unwrap_or(u64::MAX);
        if free < 2 * limits.bytes_max {
            let what = format!(
                "has {} MiB of free space, less than twice the {} of places",
                free >> 20,
                limits.bytes_max >> 20
            );
            let fix = "make room, or name another --out folder";
            return Err(Fault::new(FaultKind::NoOutput, folder.display().to_string(), what, fix));
        }
        Ok(Keeper { folder: folder.into(), identity: identity(calibration), limits, open: None, failed: false })
    }

    /// Host memory that it takes.
    pub fn footprint(places: usize) -> crate::mem::Footprint {
        Store::footprint(&limits(places))
    }

    /// The store, where it is open or can be opened.
    fn store(&mut self) -> Option<&mut Store> {
        if self.open.is_none() && !self.failed {
            self.open = unsealed(|| Store::open(&self.folder, self.identity, &self.limits)).ok();
            self.failed = self.open.is_none();
        }
        self.open.as_mut().map(|(store, _)| store)
    }

    fn serve(&self) {
        self.open.iter().for_each(|(_, disk)| unsealed(|| disk.serve()));
    }

    /// Writes a place; false where the disk does not take it.
    pub fn put(&mut self, place: &KeptPlace, features: &[Feature]) -> bool {
        let key = Key { kind: KIND_PLACE, run: 0, id: place.number };
        let fill = |payload: &mut Vec<u8>| payload.extend_from_slice(bytemuck::cast_slice(features));
        let taken = self.store().is_some_and(|store| store.put(key, &place.encode(), fill));
        self.serve();
        taken
    }

    /// Writes where places are by now: number, frame, pose.
    pub fn put_poses(&mut self, places: impl Iterator<Item = (u32, u32, Pose4)>) -> bool {
        let fill = |payload: &mut Vec<u8>| {
            for (number, frame, map) in places {
                payload.extend_from_slice(bytemuck::bytes_of(&PlacePose { number, frame, map: numbers(&map) }));
            }
        };
        let taken = self.store().is_some_and(|store| store.put(POSES_KEY, &[0; store::ABOUT], fill));
        self.serve();
        taken
    }

    pub fn remove(&mut self, number: u32) {
        let key = Key { kind: KIND_PLACE, run: 0, id: number };
        let _ = self.store().is_some_and(|store| store.remove(key));
        self.serve();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reading_a_folder_without_a_store_warns_of_foreign_files_and_not_of_a_lock() {
        let folder = tempfile::tempdir().expect("a folder");
        let calibration = stipple_drivers::sim::Scenario::named("demo").expect("a scenario").calibration;
        let warnings = || read(folder.path(), &calibration).expect("no store").warnings.len();
        assert_eq!(warnings(), 0);
        std::fs::write(folder.path().join(store::LOCK), []).expect("written");
        assert_eq!(warnings(), 0, "the lock of a store that was set aside");
        std::fs::write(folder.path().join("0000.seg"), [1; 99]).expect("written");
        assert_eq!(warnings(), 1);
    }

    #[test]
    fn a_place_is_read_as_it_was_written_and_what_is_none_is_refused() {
        let (odom, map) = (Pose4 { p: DVec3::X, yaw: 0.5 }, Pose4 { p: DVec3::Y, yaw: -0.5 });
        let epoch = Epoch { flight: 1_700_000_000_000, number: 3 };
        let place = KeptPlace { number: 7, t: Nanos(9), epoch, frame: 2, odom, map, tilt: DQuat::from_rotation_x(0.1) };
        assert_eq!(KeptPlace::decode(7, &place.encode()), Some(place));
        let broken = [
            KeptPlace { frame: u32::MAX, ..place },
            KeptPlace { tilt: DQuat::from_xyzw(0.0, 0.0, 0.0, 2.0), ..place },
            KeptPlace { map: Pose4 { yaw: f64::NAN, ..map }, ..place },
            KeptPlace { odom: Pose4 { p: DVec3::splat(f64::INFINITY), yaw: 0.0 }, ..place },
        ];
        assert!(broken.iter().all(|place| KeptPlace::decode(7, &place.encode()).is_none()));
        assert_eq!(KeptPlace::decode(u32::MAX, &place.encode()), None);
        assert_eq!(KeptPlace::decode(7, &[0; store::ABOUT]), None);
    }
}
