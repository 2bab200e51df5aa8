//! What the store asked of the disk on this thread, for the tests that cut the power or make a call fail.
#![cfg(test)]

use std::cell::RefCell;
use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt as _;

pub enum Op {
    Write { inode: u64, offset: u64, bytes: Vec<u8> },
    Sync { inode: u64 },
}

#[derive(Default)]
pub struct Log {
    pub ops: Vec<Op>,
    /// Calls to come before writes or syncs fail, and how many fail then.
    pub fail_writes: Option<(u32, u32)>,
    pub fail_syncs: Option<(u32, u32)>,
}

thread_local! {
    pub static LOG: RefCell<Option<Log>> = const { RefCell::new(None) };
}

fn fails(plan: &mut Option<(u32, u32)>) -> bool {
    match plan {
        Some((before, _)) if *before > 0 => {
            *before -= 1;
            false
        }
        Some((_, times)) if *times > 0 => {
            *times -= 1;
            true
        }
        _ => false,
    }
}

fn inode(file: &File) -> u64 {
    file.metadata().unwrap().ino()
}

pub fn note_write(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    LOG.with_borrow_mut(|log| {
        let Some(log) = log else { return Ok(()) };
        if fails(&mut log.fail_writes) {
            // Half of it is written.
            use std::os::unix::fs::FileExt as _;
            file.write_all_at(&bytes[..bytes.len() / 2], offset)?;
            return Err(io::Error::from_raw_os_error(28));
        }
        log.ops.push(Op::Write { inode: inode(file), offset, bytes: bytes.to_vec() });
        Ok(())
    })
}

pub fn note_sync(file: &File) -> io::Result<()> {
    LOG.with_borrow_mut(|log| {
        let Some(log) = log else { return Ok(()) };
        if fails(&mut log.fail_syncs) {
            return Err(io::Error::from_raw_os_error(5));
        }
        log.ops.push(Op::Sync { inode: inode(file) });
        Ok(())
    })
}

/// Runs `f` while what is asked of the disk is noted, and answers that.
pub fn noted<R>(log: Log, f: impl FnOnce() -> R) -> (R, Log) {
    LOG.set(Some(log));
    let result = f();
    (result, LOG.take().unwrap())
}
