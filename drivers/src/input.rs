//! Files that somebody else wrote: read up to a stated size, and only where they are plain files.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Largest file of settings or of a calibration, bytes: a hundred times those that there are.
pub const SETTINGS_BYTES_MAX: u64 = 1 << 20;

/// Opens a file of at most `bytes_max` bytes. Fails where it is no plain file (a pipe would wait for ever, a device may never
/// end) and where it is larger.
pub fn open(path: &Path, bytes_max: u64) -> io::Result<File> {
    let check = |about: Metadata| match about.len() {
        _ if !about.is_file() => Err(io::Error::new(ErrorKind::InvalidInput, "is not a plain file")),
        bytes if bytes > bytes_max => Err(too_large(bytes, bytes_max)),
        _ => Ok(()),
    };
    // Before it is opened, since opening alone waits for a pipe's writer and may start a device; and after, in case
    // another file took the name in between: it was opened without waiting.
    check(fs::metadata(path)?)?;
    let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path)?;
    check(file.metadata()?)?;
    Ok(file)
}

/// Reads a file of at most `bytes_max` bytes into `into`, whose memory is used again. Fails as [`open`] does.
pub fn read(path: &Path, bytes_max: u64, into: &mut Vec<u8>) -> io::Result<()> {
    let file = open(path, bytes_max)?;
    into.clear();
    let bytes = file.take(bytes_max + 1).read_to_end(into)? as u64;
    if bytes > bytes_max {
        return Err(too_large(bytes, bytes_max));
    }
    Ok(())
}

/// Reads settings as text. Fails as [`read`] does, and with `InvalidData` where they are not UTF-8.
pub fn read_settings(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    read(path, SETTINGS_BYTES_MAX, &mut bytes)?;
    String::from_utf8(bytes).map_err(|e| io::Error::new(ErrorKind::InvalidData, e))
}

fn too_large(bytes: u64, bytes_max: u64) -> io::Error {
    io::Error::new(ErrorKind::FileTooLarge, format!("{bytes} bytes or more, {bytes_max} at most are read"))
}

/// Whether a name is a link that leads out of the folder `root`, whose path is canonical.
pub fn leads_out(path: &Path, root: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|about| about.is_symlink())
        && fs::canonicalize(path).is_ok_and(|real| !real.starts_with(root))
}
