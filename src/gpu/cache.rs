//! Compiled pipelines on disk: a later start takes them from there, where the driver lets it.
//!
//! A file a device, so the folder is bounded. It holds a mark, a hash, and what the driver gave. The hash is over driver version,
//! kernels and data: a file that is damaged, of another driver or of other kernels is not taken, and written anew.

use super::device::Device;
use super::kernels::HASH;
use ash::vk;
use std::ffi::OsString;
use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::Arc;
use std::time::Duration;
use stipple_drivers::{input, Fault, FaultKind};

const MARK: &[u8; 8] = b"stipple1";
/// Bytes of the mark and of the hash.
const HEAD: usize = 16;
/// Largest file, bytes: ten times what our kernels take.
const BYTES_MAX: u64 = 32 << 20;
/// A file under its hidden name for longer was left by a process that died.
const WRITTEN_IN: Duration = Duration::from_secs(60);

/// Folder of files that may be lost: systemd's `CacheDirectory=`, else the user's. None where the machine has none, or where
/// `CACHE_DIRECTORY` is empty.
pub fn cache_folder() -> Option<PathBuf> {
    folder(|name| std::env::var_os(name))
}

fn folder(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let absolute = |name| variable(name).map(PathBuf::from).filter(|f| f.is_absolute());
    match variable("CACHE_DIRECTORY") {
        // A unit may name several.
        Some(folders) => std::env::split_paths(&folders).next().filter(|f| f.is_absolute()),
        None => {
            let user = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")));
            user.map(|f| f.join("stipple"))
        }
    }
}

/// The cache that pipelines are made with.
pub(super) struct PipelineCache {
    pub raw: vk::PipelineCache,
    /// Bytes taken from the disk.
    pub taken: usize,
    /// Hash of the file as it was read.
    held: Option<u64>,
    path: PathBuf,
    /// Name of the file from when the driver is given it until `keep`, when it is known that the driver can live with it. A
    /// start that crashes in between leaves no cache to the next.
    tried: PathBuf,
    device: Arc<Device>,
}

impl PipelineCache {
    /// Never fails for what the file holds.
    pub fn open(device: &Arc<Device>, folder: &Path) -> Result<PipelineCache, vk::Result> {
        let of = &device.properties;
        let path = folder.join(format!("pipelines-{:08x}-{:08x}", of.vendor_id, of.device_id));
        let mut file = Vec::new();
        let read = input::read(&path, BYTES_MAX, &mut file).ok();
        let tried = path.with_extension("tried");
        let found = read.and_then(|()| checked(&file, of)).filter(|_| fs::rename(&path, &tried).is_ok());
        let found = found.unwrap_or_default();
        let made = |data| {
            let info = vk::PipelineCacheCreateInfo::default().initial_data(data);
            // SAFETY: the device is alive; the data is what this driver gave, to the byte, and outlives the call.
            unsafe { device.raw.create_pipeline_cache(&info, None) }
        };
        let (raw, taken) = made(found).map(|raw| (raw, found)).or_else(|_| made(&[]).map(|raw| (raw, &[][..])))?;
        let held = (!taken.is_empty()).then(|| sum(taken, of));
        Ok(PipelineCache { raw, taken: taken.len(), held, path, tried, device: device.clone() })
    }

    /// Writes what is new; the driver has worked with what there was.
    pub fn keep(&mut self) -> Result<(), Fault> {
        self.write().map_err(|e| {
            Fault::new(
                FaultKind::Unavailable,
                self.path.display().to_string(),
                format!("compiled kernels are not kept for the next start: {e}"),
                "make its folder writable, or set CACHE_DIRECTORY to one that is, or to nothing",
            )
        })
    }

    fn write(&mut self) -> io::Result<()> {
        // SAFETY: the cache and its device are alive, and one thread uses them.
        let data = unsafe { self.device.raw.get_pipeline_cache_data(self.raw) }.map_err(io::Error::other)?;
        let sum = sum(&data, &self.device.properties);
        if self.held == Some(sum) && fs::rename(&self.tried, &self.path).is_ok() {
            return Ok(());
        }
        if (HEAD + data.len()) as u64 > BYTES_MAX {
            // Too many specialisations came together: the next start collects its own.
            let _ = [&self.path, &self.tried].map(fs::remove_file);
            return Ok(());
        }
        let partial = self.path.with_extension("partial");
        let folder = partial.parent().unwrap_or(Path::new("/"));
        fs::create_dir_all(folder)?;
        // A clock that was set back makes a file of the future, which is nobody's either.
        let age = fs::metadata(&partial).and_then(|about| about.modified()).map(|at| at.elapsed());
        if age.is_ok_and(|age| age.is_err() || age.is_ok_and(|age| age > WRITTEN_IN)) {
            fs::remove_file(&partial)?;
        }
        let mut file = match File::create_new(&partial) {
            // Another process is at it.
            Err(e) if e.kind() == ErrorKind::AlreadyExists => return Ok(()),
            made => made?,
        };
        // Not flushed to the disk: what a power cut makes of it is not taken.
        let written = [MARK, &sum.to_le_bytes()[..], &data].iter().try_for_each(|part| file.write_all(part));
        written.and_then(|()| fs::rename(&partial, &self.path)).inspect_err(|_| {
            // The first error is the one to report.
            let _ = fs::remove_file(&partial);
        })?;
        let _ = fs::remove_file(&self.tried);
        Ok(())
    }
}

impl Drop for PipelineCache {
    fn drop(&mut self) {
        if self.held.is_some() && !self.path.exists() {
            let _ = fs::rename(&self.tried, &self.path);
        }
        if !self.device.abandoned.load(Relaxed) {
            // SAFETY: no pipeline is being made, and pipelines do not need the cache that they were made with.
            unsafe { self.device.raw.destroy_pipeline_cache(self.raw, None) };
        }
    }
}

/// Hash of what the driver gave, and of what it gave it for. Another release of Rust may hash otherwise: one more start compiles.
fn sum(data: &[u8], of: &vk::PhysicalDeviceProperties) -> u64 {
    let mut hasher = DefaultHasher::new();
    (of.driver_version, HASH, data).hash(&mut hasher);
    hasher.finish()
}

/// What the driver gave, if the file is whole and of this device, driver and program.
fn checked<'a>(file: &'a [u8], of: &vk::PhysicalDeviceProperties) -> Option<&'a [u8]> {
    let (mark, rest) = file.split_first_chunk::<8>()?;
    let (hash, data) = rest.split_first_chunk::<8>()?;
    let whole = mark == MARK && *hash == sum(data, of).to_le_bytes();
    (whole && is_for(data, of)).then_some(data)
}

/// Whether Vulkan's own header names this device. Drivers check it too; some have been caught not to.
fn is_for(data: &[u8], of: &vk::PhysicalDeviceProperties) -> bool {
    let word = |i: usize| data.get(4 * i..4 * i + 4).map(|b| u32::from_ne_bytes([b[0], b[1], b[2], b[3]]));
    word(0).is_some_and(|length| length >= 32)
        && word(1) == Some(vk::PipelineCacheHeaderVersion::ONE.as_raw() as u32)
        && word(2) == Some(of.vendor_id)
        && word(3) == Some(of.device_id)
        && data.get(16..32) == Some(&of.pipeline_cache_uuid)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_cache_of_another_device_driver_or_length_is_not_taken() {
        let of = vk::PhysicalDeviceProperties {
            vendor_id: 0x10005,
            device_id: 7,
            driver_version: 3,
            pipeline_cache_uuid: *b"one driver build",
            ..Default::default()
        };
        let words = [32u32, 1, of.vendor_id, of.device_id].map(u32::to_ne_bytes).concat();
        let data = [&words[..], &of.pipeline_cache_uuid, &[9; 1000]].concat();
        let file_of = |data: &[u8]| [MARK, &sum(data, &of).to_le_bytes()[..], data].concat();
        let file = file_of(&data);
        assert_eq!(checked(&file, &of), Some(&data[..]));
        assert_eq!(checked(&file, &vk::PhysicalDeviceProperties { driver_version: 4, ..of }), None);
        assert_eq!(checked(&file, &vk::PhysicalDeviceProperties { vendor_id: 1, ..of }), None);
        assert_eq!(checked(&file, &vk::PhysicalDeviceProperties { device_id: 1, ..of }), None);
        let uuid = *b"other mesa build";
        assert_eq!(checked(&file, &vk::PhysicalDeviceProperties { pipeline_cache_uuid: uuid, ..of }), None);
        for at in 0..file.len() {
            let mut damaged = file.clone();
            damaged[at] ^= 1 << (at % 8);
            assert_eq!(checked(&damaged, &of), None, "byte {at} flipped");
            assert_eq!(checked(&file[..at], &of), None, "{at} bytes");
        }
        // Whole by our hash, and not what Vulkan calls a cache.
        for at in [3, 4, 8, 12, 16, 31] {
            let mut wrong = data.clone();
            wrong[at] ^= 0x80;
            let length_only = at == 3 && u32::from_ne_bytes([wrong[0], wrong[1], wrong[2], wrong[3]]) >= 32;
            assert_eq!(checked(&file_of(&wrong), &of).is_some(), length_only, "byte {at} of Vulkan's header");
        }
        assert_eq!(checked(&file_of(&data[..31]), &of), None);
    }

    #[test]
    fn the_folder_is_systemds_else_the_users_else_none() {
        let of =
            |set: &[(&str, &str)]| folder(|name| set.iter().find(|(n, _)| *n == name).map(|(_, value)| value.into()));
        let user = [("XDG_CACHE_HOME", "/x"), ("HOME", "/h")];
        assert_eq!(of(&[("CACHE_DIRECTORY", "/a:/b"), user[0]]), Some("/a".into()));
        assert_eq!(of(&[("CACHE_DIRECTORY", ""), user[0]]), None);
        assert_eq!(of(&user), Some("/x/stipple".into()));
        assert_eq!(of(&[("XDG_CACHE_HOME", "relative"), user[1]]), Some("/h/.cache/stipple".into()));
        assert_eq!(of(&[]), None);
    }
}
