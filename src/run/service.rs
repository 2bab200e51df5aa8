//! What the service manager hears of a run, by systemd's protocol (sd_notify(3)): ready, alive, how it goes, and that it ends.
//!
//! A message is a datagram to the socket that NOTIFY_SOCKET names; without one nothing is sent. Sending never waits: a manager
//! that does not read loses messages, and a watchdog that hears nothing ends the run, as it would without a sender.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::{Duration, Instant};

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

    /// Says that the run ends, once.
    pub fn stopping(&mut self) {
        if !std::mem::replace(&mut self.is_stopping, true) {
            let _ = self.socket.send(b"STOPPING=1\nSTATUS=stopped, results are being written");
        }
    }
}
