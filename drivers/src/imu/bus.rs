//! Register access over I2C (`i2c-dev`) and SPI (`spidev`): one ioctl for each transfer, every failure a value.
//!
//! A read is one transaction with a repeated start (`I2C_RDWR`) or one full-duplex transfer (`SPI_IOC_MESSAGE`), so that
//! nobody can speak between address and data. The driver of a die sees the trait alone. The trait carries the clock too,
//! so that tests put a simulated register file with a clock of its own behind it.
#![allow(unsafe_code)]

use crate::host::monotonic;
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind};
use std::fs::{File, OpenOptions};
use std::os::fd::{AsRawFd, RawFd};
use std::path::{Path, PathBuf};

/// A die behind its bus, and the clock that its driver runs by.
pub trait Bus: Send {
    /// Reads consecutive registers, or a FIFO, from `register` on.
    fn read(&mut self, register: u8, into: &mut [u8]) -> Result<(), BusFault>;
    /// Writes consecutive registers from `register` on, `WRITE_MAX` bytes at most.
    fn write(&mut self, register: u8, bytes: &[u8]) -> Result<(), BusFault>;
    /// Opens the device again after it was gone.
    fn reopen(&mut self) -> Result<(), BusFault>;
    fn now(&self) -> Nanos {
        monotonic()
    }
    fn sleep(&mut self, span: Span) {
        super::pause(span);
    }
}

/// Why a transfer failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BusFault {
    /// No device acknowledged the address.
    Nack,
    /// Fewer bytes or messages than asked for.
    Short,
    /// The bus was held by others, or the clock was stretched too long.
    Busy,
    Io,
    /// The adapter itself is gone: the file must be opened again.
    Gone,
    /// The kernel refuses such a transfer (errno); asking again is of no use.
    Refused(i32),
}

impl BusFault {
    pub(crate) fn of(errno: i32) -> BusFault {
        match errno {
            libc::ENXIO | libc::EREMOTEIO => BusFault::Nack,
            libc::EAGAIN | libc::ETIMEDOUT | libc::EBUSY | libc::EINTR => BusFault::Busy,
            libc::EIO | libc::EPROTO | libc::EBADMSG => BusFault::Io,
            libc::ENODEV | libc::ESHUTDOWN | libc::ENOENT | libc::EBADF => BusFault::Gone,
            other => BusFault::Refused(other),
        }
    }

    fn last() -> BusFault {
        BusFault::of(std::io::Error::last_os_error().raw_os_error().unwrap_or(libc::EIO))
    }
}

impl std::fmt::Display for BusFault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            BusFault::Nack => write!(f, "no device answers at its address"),
            BusFault::Short => write!(f, "a transfer ended early"),
            BusFault::Busy => write!(f, "the bus is held by others"),
            BusFault::Io => write!(f, "input/output error on the bus"),
            BusFault::Gone => write!(f, "the bus is not there"),
            BusFault::Refused(errno) => write!(f, "{}", std::io::Error::from_raw_os_error(*errno)),
        }
    }
}

/// Bytes of the largest transfer: spidev's default `bufsiz`. Every FIFO that is read in one burst is smaller.
pub const TRANSFER_MAX: usize = 4096;

/// Data bytes of the largest write; chunks of the BMI270's configuration are the largest there are.
pub const WRITE_MAX: usize = 64;

fn open_device(path: &Path) -> Result<File, BusFault> {
    let opened = OpenOptions::new().read(true).write(true).open(path);
    opened.map_err(|e| BusFault::of(e.raw_os_error().unwrap_or(libc::EIO)))
}

/// The boot error of a device that cannot be opened.
fn cannot_open(place: &str, fault: BusFault) -> Fault {
    let fix = match fault {
        BusFault::Refused(libc::EACCES | libc::EPERM) => {
            "let the user read and write it (udev rule, or group i2c or spi)"
        }
        BusFault::Refused(_) => "name an adapter that speaks plain I2C, or a spidev node",
        _ => "check the wiring, the device tree and that i2c-dev or spidev is loaded",
    };
    Fault::new(FaultKind::Unavailable, place, fault.to_string(), fix)
}

/// The one system call of both buses: descriptor, number, argument. Tests put theirs in its place, so that each number
/// fails with each error.
type Ioctl = unsafe fn(RawFd, libc::c_ulong, *mut libc::c_void) -> libc::c_int;

/// # Safety
/// `argument` points to what the kernel reads and writes under this number.
unsafe fn ioctl(fd: RawFd, number: libc::c_ulong, argument: *mut libc::c_void) -> libc::c_int {
    // SAFETY: by the contract of this function.
    unsafe { libc::ioctl(fd, number as _, argument) }
}

#[repr(C)]
struct I2cMessage {
    address: u16,
    flags: u16,
    len: u16,
    buf: *mut u8,
}

#[repr(C)]
struct I2cTransfer {
    messages: *mut I2cMessage,
    count: u32,
}

// From <linux/i2c-dev.h> and <linux/i2c.h>.
const I2C_RDWR: libc::c_ulong = 0x0707;
const I2C_FUNCS: libc::c_ulong = 0x0705;
const I2C_FUNC_I2C: libc::c_ulong = 1;
const I2C_M_RD: u16 = 1;

/// A die at one address of an I2C adapter.
pub struct I2c {
    /// `/dev/i2c-1`, a link to it, or the adapter's name.
    place: String,
    address: u16,
    file: File,
    ioctl: Ioctl,
}

impl I2c {
    /// Opens the adapter `place` (a path, or its driver's name for it); nothing is sent yet. A fault where it
    /// is missing, refuses, or cannot burst a FIFO.
    pub fn open(place: &str, address: u16) -> Result<I2c, Fault> {
        I2c::open_in(place, address, ioctl)
    }

    fn open_in(place: &str, address: u16, ioctl: Ioctl) -> Result<I2c, Fault> {
        let file = I2c::file(place, ioctl).map_err(|e| cannot_open(place, e))?;
        Ok(I2c { place: place.into(), address, file, ioctl })
    }

    fn file(place: &str, ioctl: Ioctl) -> Result<File, BusFault> {
        let path = adapter(place, Path::new("/sys/class/i2c-dev")).ok_or(BusFault::Gone)?;
        let file = open_device(&path)?;
        let mut functions: libc::c_ulong = 0;
        // SAFETY: I2C_FUNCS writes one unsigned long to the pointer, which outlives the call.
        let done = unsafe { ioctl(file.as_raw_fd(), I2C_FUNCS, (&raw mut functions).cast()) };
        if done < 0 {
            return Err(BusFault::last());
        }
        // An adapter that only emulates SMBus cannot burst a FIFO.
        if functions & I2C_FUNC_I2C == 0 {
            Err(BusFault::Refused(libc::EOPNOTSUPP))
        } else {
            Ok(file)
        }
    }

    fn transfer(&self, messages: &mut [I2cMessage]) -> Result<(), BusFault> {
        let mut transfer = I2cTransfer { messages: messages.as_mut_ptr(), count: messages.len() as u32 };
        // SAFETY: every message points to `len` bytes that its caller borrows for the call, the list to `count` of them.
        let done = unsafe { (self.ioctl)(self.file.as_raw_fd(), I2C_RDWR, (&raw mut transfer).cast()) };
        completed(done, messages.len())
    }
}

/// Whether all that was asked for went through: messages by I2C, bytes by SPI.
fn completed(done: i32, asked: usize) -> Result<(), BusFault> {
    match done {
        _ if done < 0 => Err(BusFault::last()),
        _ if done as usize == asked => Ok(()),
        _ => Err(BusFault::Short),
    }
}

/// The device file of an adapter that is named by its path, or by the name its driver gives it: numbers change with the
/// order in which drivers are probed.
fn adapter(place: &str, class: &Path) -> Option<PathBuf> {
    if place.starts_with('/') {
        return Some(place.into());
    }
    let named = |entry: &std::fs::DirEntry| {
        std::fs::read_to_string(entry.path().join("name")).is_ok_and(|name| name.trim() == place)
    };
    let entry = std::fs::read_dir(class).ok()?.filter_map(Result::ok).find(named)?;
    Some(Path::new("/dev").join(entry.file_name()))
}

impl Bus for I2c {
    fn read(&mut self, register: u8, into: &mut [u8]) -> Result<(), BusFault> {
        let (mut register, address) = (register, self.address);
        let len = u16::try_from(into.len()).map_err(|_| BusFault::Refused(libc::EMSGSIZE))?;
        self.transfer(&mut [
            I2cMessage { address, flags: 0, len: 1, buf: &mut register },
            I2cMessage { address, flags: I2C_M_RD, len, buf: into.as_mut_ptr() },
        ])
    }

    fn write(&mut self, register: u8, bytes: &[u8]) -> Result<(), BusFault> {
        let mut message = [0u8; WRITE_MAX + 1];
        let framed = message.get_mut(..bytes.len() + 1).ok_or(BusFault::Refused(libc::EMSGSIZE))?;
        framed[0] = register;
        framed[1..].copy_from_slice(bytes);
        let (len, buf) = (framed.len() as u16, framed.as_mut_ptr());
        self.transfer(&mut [I2cMessage { address: self.address, flags: 0, len, buf }])
    }

    fn reopen(&mut self) -> Result<(), BusFault> {
        self.file = I2c::file(&self.place, self.ioctl)?;
        Ok(())
    }
}

/// `struct spi_ioc_transfer` of <linux/spi/spidev.h>.
#[repr(C)]
#[derive(Default)]
struct SpiTransfer {
    tx: u64,
    rx: u64,
    len: u32,
    speed_hz: u32,
    delay_us: u16,
    bits: u8,
    cs_change: u8,
    tx_nbits: u8,
    rx_nbits: u8,
    word_delay_us: u8,
    pad: u8,
}

const _: () = assert!(size_of::<SpiTransfer>() == 32);

// From <linux/spi/spidev.h>: _IOW('k', 0, 32 bytes), _IOW('k', 1, u8), _IOW('k', 3, u8), _IOW('k', 4, u32).
const SPI_IOC_MESSAGE_1: libc::c_ulong = 0x4020_6b00;
const SPI_IOC_WR_MODE: libc::c_ulong = 0x4001_6b01;
const SPI_IOC_WR_BITS: libc::c_ulong = 0x4001_6b03;
const SPI_IOC_WR_HZ: libc::c_ulong = 0x4004_6b04;
/// Clock idle high, data taken at its rising edge: a mode that every chip of the table takes.
const SPI_MODE: u8 = 3;
/// Bit of the address byte that makes it a read, on every chip of the table.
const SPI_READ: u8 = 0x80;

/// A die at one chip select of an SPI controller.
pub struct Spi {
    path: PathBuf,
    hz: u32,
    /// Bytes between address and data of a read.
    dummy: usize,
    file: File,
    ioctl: Ioctl,
    tx: Box<[u8; TRANSFER_MAX]>,
    rx: Box<[u8; TRANSFER_MAX]>,
}

impl Spi {
    /// Opens a spidev node with a clock of `hz`; `dummy` bytes stand between address and data of a read.
    /// A fault where the node is missing or refuses.
    pub fn open(path: &str, hz: u32, dummy: usize) -> Result<Spi, Fault> {
        Spi::open_in(path, hz, dummy, ioctl)
    }

    fn open_in(path: &str, hz: u32, dummy: usize, ioctl: Ioctl) -> Result<Spi, Fault> {
        let file = Spi::file(Path::new(path), hz, ioctl).map_err(|e| cannot_open(path, e))?;
        let [tx, rx] = [0, 0].map(|zero| Box::new([zero; TRANSFER_MAX]));
        Ok(Spi { path: path.into(), hz, dummy, file, ioctl, tx, rx })
    }

    fn file(path: &Path, mut hz: u32, ioctl: Ioctl) -> Result<File, BusFault> {
        let file = open_device(path)?;
        let (fd, mut mode, mut bits) = (file.as_raw_fd(), SPI_MODE, 8u8);
        // SAFETY: each of the three reads as many bytes from its pointer as its number encodes; all outlive the calls.
        let failed = unsafe {
            ioctl(fd, SPI_IOC_WR_MODE, (&raw mut mode).cast()) < 0
                || ioctl(fd, SPI_IOC_WR_BITS, (&raw mut bits).cast()) < 0
                || ioctl(fd, SPI_IOC_WR_HZ, (&raw mut hz).cast()) < 0
        };
        if failed {
            Err(BusFault::last())
        } else {
            Ok(file)
        }
    }

    /// Sends the first `len` bytes of `tx` and fills as many of `rx`.
    fn transfer(&mut self, len: usize) -> Result<(), BusFault> {
        let mut transfer = SpiTransfer {
            tx: self.tx.as_ptr() as u64,
            rx: self.rx.as_mut_ptr() as u64,
            len: len as u32,
            speed_hz: self.hz,
            bits: 8,
            ..SpiTransfer::default()
        };
        // SAFETY: both buffers hold TRANSFER_MAX bytes, of which the callers ask for no more, and outlive the call.
        let done = unsafe { (self.ioctl)(self.file.as_raw_fd(), SPI_IOC_MESSAGE_1, (&raw mut transfer).cast()) };
        completed(done, len)
    }
}

impl Bus for Spi {
    fn read(&mut self, register: u8, into: &mut [u8]) -> Result<(), BusFault> {
        let head = 1 + self.dummy;
        let len = head + into.len();
        self.tx.get_mut(..len).ok_or(BusFault::Refused(libc::EMSGSIZE))?.fill(0);
        self.tx[0] = register | SPI_READ;
        self.transfer(len)?;
        into.copy_from_slice(&self.rx[head..len]);
        Ok(())
    }

    fn write(&mut self, register: u8, bytes: &[u8]) -> Result<(), BusFault> {
        let len = 1 + bytes.len();
        self.tx.get_mut(1..len).ok_or(BusFault::Refused(libc::EMSGSIZE))?.copy_from_slice(bytes);
        self.tx[0] = register & !SPI_READ;
        self.transfer(len)
    }

    fn reopen(&mut self) -> Result<(), BusFault> {
        self.file = Spi::file(&self.path, self.hz, self.ioctl)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::cell::Cell;

    #[test]
    fn every_errno_of_a_transfer_is_told_apart() {
        let told = [
            (libc::ENXIO, BusFault::Nack),
            (libc::EREMOTEIO, BusFault::Nack),
            (libc::ETIMEDOUT, BusFault::Busy),
            (libc::EAGAIN, BusFault::Busy),
            (libc::EIO, BusFault::Io),
            (libc::ENODEV, BusFault::Gone),
            (libc::ESHUTDOWN, BusFault::Gone),
            (libc::ENOTTY, BusFault::Refused(libc::ENOTTY)),
            (libc::EMSGSIZE, BusFault::Refused(libc::EMSGSIZE)),
        ];
        for (errno, fault) in told {
            assert_eq!(BusFault::of(errno), fault);
        }
    }

    #[test]
    fn a_transfer_that_ends_early_is_short() {
        assert_eq!(completed(2, 2), Ok(()));
        assert_eq!(completed(1, 2), Err(BusFault::Short));
        assert_eq!(completed(0, 2), Err(BusFault::Short));
    }

    #[test]
    fn what_is_no_bus_is_refused_with_what_to_do() {
        let fault = I2c::open("/dev/null", 0x68).map(|_| ()).unwrap_err();
        assert!(fault.to_string().contains("plain I2C"), "{fault}");
        let fault = Spi::open("/dev/null", 1_000_000, 0).map(|_| ()).unwrap_err();
        assert!(fault.to_string().contains("spidev node"), "{fault}");
        let fault = I2c::open("/dev/no-such-adapter", 0x68).map(|_| ()).unwrap_err();
        assert!(fault.to_string().contains("wiring"), "{fault}");
        assert_eq!(fault.kind, FaultKind::Unavailable);
    }

    /// What the next call under a number answers: an errno, or fewer messages or bytes than were asked for.
    #[derive(Clone, Copy)]
    enum Answer {
        Errno(i32),
        Short,
    }

    thread_local! {
        static ANSWER: Cell<Option<(libc::c_ulong, Answer)>> = const { Cell::new(None) };
        static FUNCTIONS: Cell<libc::c_ulong> = const { Cell::new(I2C_FUNC_I2C) };
    }

    /// An adapter and a controller on which everything goes well, save what `ANSWER` says.
    unsafe fn simulated(_: RawFd, number: libc::c_ulong, argument: *mut libc::c_void) -> libc::c_int {
        let all = match number {
            // SAFETY: the argument is what this number takes, here and below.
            I2C_RDWR => unsafe { (*argument.cast::<I2cTransfer>()).count as i32 },
            SPI_IOC_MESSAGE_1 => unsafe { (*argument.cast::<SpiTransfer>()).len as i32 },
            I2C_FUNCS => unsafe {
                *argument.cast::<libc::c_ulong>() = FUNCTIONS.get();
                0
            },
            _ => 0,
        };
        match ANSWER.get().filter(|(struck, _)| *struck == number) {
            None => all,
            Some((_, Answer::Short)) => all - 1,
            Some((_, Answer::Errno(errno))) => {
                // SAFETY: the errno of this thread.
                unsafe { *libc::__errno_location() = errno };
                -1
            }
        }
    }

    /// What the kernel's documentation of both buses names, and what adapters return besides.
    const ERRNOS: [i32; 14] = [
        libc::EAGAIN,
        libc::EBADMSG,
        libc::EBUSY,
        libc::EFAULT,
        libc::EINVAL,
        libc::EIO,
        libc::EMSGSIZE,
        libc::ENODEV,
        libc::ENOMEM,
        libc::ENOTTY,
        libc::ENXIO,
        libc::EREMOTEIO,
        libc::ESHUTDOWN,
        libc::ETIMEDOUT,
    ];

    #[test]
    fn every_error_of_every_call_comes_back_as_a_value() {
        let i2c = || I2c::open_in("/dev/null", 0x68, simulated);
        let spi = || Spi::open_in("/dev/null", 1_000_000, 1, simulated);
        let (mut adapter, mut controller) = (i2c().unwrap(), spi().unwrap());
        let mut four = [0; 4];
        assert_eq!((adapter.read(0, &mut four), adapter.write(0, &four), adapter.reopen()), (Ok(()), Ok(()), Ok(())));
        assert_eq!((controller.read(0, &mut four), controller.write(0, &four)), (Ok(()), Ok(())));
        for errno in ERRNOS {
            let fault = Err(BusFault::of(errno));
            let strike = |number| ANSWER.set(Some((number, Answer::Errno(errno))));
            let boots = |answer: Result<(), Fault>| {
                let line = answer.unwrap_err().to_string();
                assert!(line.starts_with("/dev/null: ") && line.contains(&BusFault::of(errno).to_string()), "{line}");
            };
            strike(I2C_FUNCS);
            boots(i2c().map(|_| ()));
            assert_eq!(adapter.reopen(), fault);
            strike(I2C_RDWR);
            assert_eq!((adapter.read(0, &mut four), adapter.write(0, &four)), (fault, fault));
            for setting in [SPI_IOC_WR_MODE, SPI_IOC_WR_BITS, SPI_IOC_WR_HZ] {
                strike(setting);
                boots(spi().map(|_| ()));
                assert_eq!(controller.reopen(), fault);
            }
            strike(SPI_IOC_MESSAGE_1);
            assert_eq!((controller.read(0, &mut four), controller.write(0, &four)), (fault, fault));
        }
        ANSWER.set(Some((I2C_RDWR, Answer::Short)));
        assert_eq!((adapter.read(0, &mut four), adapter.write(0, &four)), (Err(BusFault::Short), Err(BusFault::Short)));
        ANSWER.set(Some((SPI_IOC_MESSAGE_1, Answer::Short)));
        assert_eq!(controller.read(0, &mut four), Err(BusFault::Short));
        // An adapter of SMBus alone.
        ANSWER.set(None);
        FUNCTIONS.set(0x0eff_0008);
        let line = i2c().map(|_| ()).unwrap_err().to_string();
        assert!(line.contains("plain I2C"), "{line}");
    }

    #[test]
    fn transfers_too_long_are_refused_before_they_are_made() {
        let mut i2c = I2c::open_in("/dev/null", 0x68, simulated).unwrap();
        let mut spi = Spi::open_in("/dev/null", 1, 1, simulated).unwrap();
        let refused = Err(BusFault::Refused(libc::EMSGSIZE));
        assert_eq!(i2c.write(0, &[0; WRITE_MAX + 1]), refused);
        assert_eq!(i2c.read(0, &mut vec![0; 1 << 16]), refused);
        let mut long = [0; TRANSFER_MAX];
        assert_eq!(spi.read(0, &mut long), refused, "the address needs room too");
        assert_eq!(spi.write(0, &long), refused);
    }

    #[test]
    fn who_may_not_open_it_is_told_to_ask_for_the_group() {
        for errno in [libc::EACCES, libc::EPERM] {
            assert!(cannot_open("/dev/i2c-1", BusFault::of(errno)).fix.contains("udev"));
        }
    }

    #[test]
    fn adapters_are_found_by_the_name_their_driver_gives() {
        let class = tempfile::tempdir().unwrap();
        for (number, name) in [(0, "SMBus I801"), (7, "hil-imu i2c")] {
            let entry = class.path().join(format!("i2c-{number}"));
            std::fs::create_dir(&entry).unwrap();
            std::fs::write(entry.join("name"), format!("{name}\n")).unwrap();
        }
        assert_eq!(adapter("hil-imu i2c", class.path()), Some("/dev/i2c-7".into()));
        assert_eq!(adapter("hil-imu", class.path()), None);
        assert_eq!(adapter("/dev/i2c-3", class.path()), Some("/dev/i2c-3".into()));
    }
}
