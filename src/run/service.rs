//! What the service manager hears of a run, by systemd's protocol (sd_notify(3)): ready, alive, how it goes, reloads, and that it
//! ends; and its journal of events, with a field each for what they are (systemd.journal-fields(7)).
//!
//! A message is a datagram to the socket that NOTIFY_SOCKET names; without one nothing is sent. Sending never waits: a manager
//! that does not read loses messages, and a watchdog that hears nothing ends the run, as it would without a sender.

use crate::publish::event::{EventId, Severity};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::time::{Duration, Instant};
use stipple_drivers::host;

/// How often the manager hears that the run is alive: its WatchdogSec must be some times as long.
const PERIOD: Duration = Duration::from_secs(1);

/// The service manager that started this process.
pub struct Service {
    socket: UnixDatagram,
    next: Instant,
    is_ready: bool,
    is_stopping: bool,
}

impl Service {
    /// The manager of this process; `None` where it has none.
    pub fn of_this_process() -> Option<Service> {
        let name = std::env::var_os("NOTIFY_SOCKET")?;
        let address = match name.as_bytes().strip_prefix(b"@") {
            Some(name) => SocketAddr::from_abstract_name(name),
            None => SocketAddr::from_pathname(&name),
        };
        let socket = UnixDatagram::unbound().ok()?;
        socket.set_nonblocking(true).ok()?;
        socket.connect_addr(&address.ok()?).ok()?;
        Some(Service { socket, next: Instant::now(), is_ready: false, is_stopping: false })
    }

    /// Says how the run goes, once a second, and at first that it is ready. Without `alive` the watchdog is not fed.
    pub fn tell(&mut self, alive: bool, how: impl FnOnce() -> String) {
        if self.is_stopping || Instant::now() < self.next {
            return;
        }
        self.next = Instant::now() + PERIOD;
        let ready = if self.is_ready { "" } else { "READY=1\n" };
        let alive = if alive { "WATCHDOG=1\n" } else { "" };
        // A line of its own must not end it.
        let how = how().replace('\n', " ");
        self.is_ready |= self.socket.send(format!("{ready}{alive}STATUS={how}").as_bytes()).is_ok();
    }

    /// Says that the board file is being read again; `tell` ends it.
    pub fn reloading(&mut self) {
        let now_us = host::monotonic().0 / 1000;
        let _ =
            self.socket.send(format!("RELOADING=1\nMONOTONIC_USEC={now_us}\nSTATUS=reads the board file").as_bytes());
        (self.is_ready, self.next) = (false, Instant::now());
    }

    /// Says that the run ends, once.
    pub fn stopping(&mut self) {
        if !std::mem::replace(&mut self.is_stopping, true) {
            let _ = self.socket.send(b"STOPPING=1\nSTATUS=stopped, results are being written");
        }
    }
}

/// The journal, where standard error goes there.
pub struct Journal(UnixDatagram);

impl Journal {
    pub fn of_this_process() -> Option<Journal> {
        // The manager says which stream it opened: one that was redirected since is another.
        let stream = std::env::var("JOURNAL_STREAM").ok()?;
        let stderr = host::device_and_inode(host::STDERR)?;
        let (device, inode) = stream.split_once(':')?;
        if (device.parse(), inode.parse()) != (Ok(stderr.0), Ok(stderr.1)) {
            return None;
        }
        Journal::at("/run/systemd/journal/socket".as_ref())
    }

    fn at(path: &Path) -> Option<Journal> {
        let socket = UnixDatagram::unbound().ok()?;
        socket.set_nonblocking(true).ok()?;
        socket.connect(path).ok()?;
        Some(Journal(socket))
    }

    /// Writes an event of an epoch; false where the journal does not take it.
    pub fn write(&self, id: EventId, epoch: u32, text: &str) -> bool {
        let priority = match id.severity() {
            Severity::Critical => 2,
            Severity::Warning => 4,
            Severity::Notice => 5,
        };
        // A field on a line of its own ends with it.
        let text = text.replace('\n', " ");
        let fields = format!(
            "MESSAGE={text}\nPRIORITY={priority}\nSYSLOG_IDENTIFIER=stipple\nMESSAGE_ID={:032x}\nSTIPPLE_EVENT={}\nSTIPPLE_EPOCH={epoch}\n",
            id.message_id(),
            id.name()
        );
        self.0.send(fields.as_bytes()).is_ok()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn events_are_journal_entries_with_a_field_each_for_what_they_are() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("socket");
        let journald = UnixDatagram::bind(&path).unwrap();
        let journal = Journal::at(&path).unwrap();
        assert!(journal.write(EventId::SensorLost, 3, "camera lost:\nMESSAGE_ID=0 unplugged"));
        let mut bytes = [0; 4096];
        let count = journald.recv(&mut bytes).unwrap();
        let fields: Vec<&str> = std::str::from_utf8(&bytes[..count]).unwrap().lines().collect();
        let id = format!("MESSAGE_ID={:032x}", EventId::SensorLost.message_id());
        assert_eq!(
            fields,
            [
                "MESSAGE=camera lost: MESSAGE_ID=0 unplugged",
                "PRIORITY=2",
                "SYSLOG_IDENTIFIER=stipple",
                &id,
                "STIPPLE_EVENT=sensor_lost",
                "STIPPLE_EPOCH=3",
            ]
        );
        drop(journald);
        assert!(!journal.write(EventId::SensorBack, 3, "nobody takes it"));
    }
}
