//! The line to an autopilot: UDP, or a UART. Neither reading nor writing waits.

use crate::config::Address;
use mio::net::UdpSocket;
use mio::unix::SourceFd;
use mio::{Interest, Registry, Token};
use rustix::termios::{self, ControlModes, OptionalActions, QueueSelector};
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::time::{Duration, Instant};

enum Line {
    /// Connected.
    UdpTo(UdpSocket),
    /// Answers to this address, once there is one.
    UdpAt(UdpSocket, Option<SocketAddr>),
    Serial(File),
}

/// An open line.
pub struct Link {
    line: Line,
    /// Bytes a second; infinite over UDP.
    rate: f64,
    /// When what was written has left.
    busy_until: Instant,
    /// Rest of the message under way, which the line did not take yet.
    rest: Vec<u8>,
}

impl Link {
    /// Opens the line and asks for its events.
    pub fn open(address: &Address, registry: &Registry, token: Token) -> io::Result<Link> {
        let (line, rate) = match address {
            Address::UdpTo(peer) => {
                let any: IpAddr =
                    if peer.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
                let mut socket = UdpSocket::bind((any, 0).into())?;
                socket.connect(*peer)?;
                registry.register(&mut socket, token, Interest::READABLE)?;
                (Line::UdpTo(socket), f64::INFINITY)
            }
            Address::UdpAt(own) => {
                let mut socket = UdpSocket::bind(*own)?;
                registry.register(&mut socket, token, Interest::READABLE)?;
                (Line::UdpAt(socket, None), f64::INFINITY)
            }
            Address::Serial(device, baud) => {
                let flags = libc::O_NONBLOCK | libc::O_NOCTTY;
                let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(device)?;
                let mut modes = termios::tcgetattr(&file)?;
                modes.make_raw();
                modes.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
                modes.control_modes -= ControlModes::CRTSCTS | ControlModes::CSTOPB;
                modes.set_speed(*baud)?;
                termios::tcsetattr(&file, OptionalActions::Now, &modes)?;
                registry.register(&mut SourceFd(&file.as_raw_fd()), token, Interest::READABLE)?;
                // A start bit and a stop bit beside the eight.
                (Line::Serial(file), f64::from(*baud) / 10.0)
            }
        };
        Ok(Link { line, rate, busy_until: Instant::now(), rest: Vec::with_capacity(super::parser::LONGEST) })
    }

    /// Whether a datagram is what one read gives.
    pub fn gives_datagrams(&self) -> bool {
        !matches!(self.line, Line::Serial(_))
    }

    /// Reads into `bytes`; how many, and who sent them where that is not known beforehand. `None` where there is nothing.
    pub fn read(&mut self, bytes: &mut [u8]) -> io::Result<Option<(usize, Option<SocketAddr>)>> {
        let read = match &mut self.line {
            Line::UdpTo(socket) => socket.recv(bytes).map(|n| (n, None)),
            Line::UdpAt(socket, _) => socket.recv_from(bytes).map(|(n, from)| (n, Some(from))),
            Line::Serial(file) => match file.read(bytes) {
                // The other end of a pseudo-terminal is closed, or a converter is unplugged.
                Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
                read => read.map(|n| (n, None)),
            },
        };
        match read {
            Ok(read) => Ok(Some(read)),
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(None),
            // Nobody listens there yet.
            Err(e) if e.kind() == ErrorKind::ConnectionRefused => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Answers go there until it is forgotten, where the address is not known beforehand.
    pub fn answer_to(&mut self, peer: SocketAddr) {
        if let Line::UdpAt(_, known) = &mut self.line {
            known.get_or_insert(peer);
        }
    }

    /// Nobody is answered until there is another.
    pub fn forget_peer(&mut self) {
        if let Line::UdpAt(_, known) = &mut self.line {
            *known = None;
        }
    }

    /// When the next message can be written, at the earliest.
    pub fn free_at(&self) -> Instant {
        self.busy_until
    }

    /// Whether a message can be written now. Writes what is left of the one before.
    pub fn is_free(&mut self) -> io::Result<bool> {
        if let (Line::Serial(file), false) = (&mut self.line, self.rest.is_empty()) {
            let written = write(file, &self.rest)?;
            self.rest.drain(..written);
            if !self.rest.is_empty() {
                // A line that takes nothing is asked again then.
                self.busy_until = Instant::now() + Duration::from_millis(5);
            }
        }
        Ok(self.rest.is_empty() && Instant::now() >= self.busy_until)
    }

    /// Writes a message; false where the line refuses it. To be called where the line is free.
    pub fn write(&mut self, message: &[u8]) -> io::Result<bool> {
        let took = match &mut self.line {
            Line::UdpTo(socket) => is_sent(socket.send(message))?,
            // No address of a stranger is a fault of the socket.
            Line::UdpAt(socket, Some(peer)) => socket.send_to(message, *peer).is_ok(),
            Line::UdpAt(_, None) => false,
            Line::Serial(file) => {
                let written = write(file, message)?;
                // What is begun is ended; what is not is forgotten, since a newer one comes.
                if written > 0 {
                    self.rest.extend_from_slice(&message[written..]);
                }
                written > 0
            }
        };
        let now = Instant::now();
        if took && self.rate.is_finite() {
            self.busy_until = now.max(self.busy_until) + Duration::from_secs_f64(message.len() as f64 / self.rate);
        }
        Ok(took)
    }
}

impl Drop for Link {
    /// Forgets what the UART did not send: closing it would wait for that, for half a minute.
    fn drop(&mut self) {
        if let Line::Serial(file) = &self.line {
            let _ = termios::tcflush(file, QueueSelector::OFlush);
        }
    }
}

fn write(file: &mut File, bytes: &[u8]) -> io::Result<usize> {
    match file.write(bytes) {
        Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(0),
        written => written,
    }
}

/// Whether a datagram left. A peer or a network that is not there yet is no fault of the socket.
fn is_sent(sent: io::Result<usize>) -> io::Result<bool> {
    use ErrorKind::{
        ConnectionRefused, HostUnreachable, Interrupted, NetworkDown, NetworkUnreachable, PermissionDenied, WouldBlock,
    };
    match sent {
        Ok(_) => Ok(true),
        Err(e) => match e.kind() {
            ConnectionRefused | HostUnreachable | NetworkUnreachable | NetworkDown | WouldBlock | Interrupted
            // A firewall forbids it, or the unit of the service.
            | PermissionDenied => {
                Ok(false)
            }
            // No room in the queue of the network's interface.
            _ if e.raw_os_error() == Some(libc::ENOBUFS) => Ok(false),
            _ => Err(e),
        },
    }
}
