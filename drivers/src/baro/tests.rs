//! The BMP388 on a simulated register file, the kernel's devices on a folder, and every fault of both.
#![allow(clippy::unwrap_used)]

use super::bmp388::{Bmp388, Coefficients};
use super::*;
use crate::imu::bus::Bus;
use std::fs;
use std::sync::{Arc, Mutex};

/// Coefficients as a sensor's registers hold them: T1 27500, T2 18700, T3 -7, P1 -250, P2 -2400, P3 35, P4 0, P5 25500,
/// P6 30800, P7 3, P8 -15, P9 16000, P10 20, P11 -60.
const RAW: [u8; 21] = {
    let words = [27500u16.to_le_bytes(), 18700u16.to_le_bytes()];
    let p = [(-250i16).to_le_bytes(), (-2400i16).to_le_bytes()];
    let q = [25500u16.to_le_bytes(), 30800u16.to_le_bytes()];
    let p9 = 16000i16.to_le_bytes();
    [
        words[0][0],
        words[0][1],
        words[1][0],
        words[1][1],
        -7i8 as u8,
        p[0][0],
        p[0][1],
        p[1][0],
        p[1][1],
        35,
        0,
        q[0][0],
        q[0][1],
        q[1][0],
        q[1][1],
        3,
        -15i8 as u8,
        p9[0],
        p9[1],
        20,
        -60i8 as u8,
    ]
};
/// What it counts in a room.
const COUNTS: [u32; 2] = [6_600_000, 8_400_000];

struct World {
    registers: [u8; 256],
    now: i64,
    /// When the measurement under way ends.
    ready: Option<i64>,
    faults: Vec<BusFault>,
    /// Measures no more; does not keep what is written to this register.
    hangs: bool,
    stuck: Option<u8>,
}

#[derive(Clone)]
struct SimBus(Arc<Mutex<World>>);

impl SimBus {
    fn new() -> SimBus {
        let mut registers = [0; 256];
        registers[0] = 0x50;
        registers[0x31..0x46].copy_from_slice(&RAW);
        for (i, counts) in COUNTS.iter().enumerate() {
            registers[4 + 3 * i..7 + 3 * i].copy_from_slice(&counts.to_le_bytes()[..3]);
        }
        let world = World { registers, now: 1_000_000_000, ready: None, faults: vec![], hangs: false, stuck: None };
        SimBus(Arc::new(Mutex::new(world)))
    }

    fn set(&self, change: impl FnOnce(&mut World)) {
        change(&mut self.0.lock().unwrap());
    }

    fn open(&self) -> Result<Barometer<Bmp388>, Fault> {
        Barometer::start("bmp388 at i2c 0x76".into(), Bmp388::new(Box::new(self.clone())))
    }
}

impl Bus for SimBus {
    fn read(&mut self, register: u8, into: &mut [u8]) -> Result<(), BusFault> {
        let mut w = self.0.lock().unwrap();
        w.faults.pop().map_or(Ok(()), Err)?;
        let done = w.ready.is_some_and(|t| w.now >= t) && !w.hangs;
        w.registers[3] = if done { 0x70 } else { 0x10 };
        into.copy_from_slice(&w.registers[register as usize..][..into.len()]);
        Ok(())
    }

    fn write(&mut self, register: u8, bytes: &[u8]) -> Result<(), BusFault> {
        let mut w = self.0.lock().unwrap();
        w.faults.pop().map_or(Ok(()), Err)?;
        match (register, bytes[0]) {
            (0x7E, 0xB6) => w.registers[0x1B..0x20].fill(0xFF),
            // Forced mode, both sensors on: 10.9 ms.
            (0x1B, 0x13) => w.ready = Some(w.now + 10_889_000),
            (register, value) if w.stuck != Some(register) => w.registers[register as usize] = value,
            _ => {}
        }
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), BusFault> {
        self.0.lock().unwrap().faults.pop().map_or(Ok(()), Err)
    }

    fn now(&self) -> Nanos {
        Nanos(self.0.lock().unwrap().now)
    }

    fn sleep(&mut self, span: Span) {
        self.set(|w| w.now += span.0.max(0));
    }
}

const PATIENCE: Span = Span(100_000_000);

fn pressure(batch: &AidBatch) -> f64 {
    let Aid::Pressure(pa) = batch[0].value;
    pa
}

#[test]
fn compensation_is_that_of_the_data_sheet() {
    // Appendix 9.2 and 9.3, term by term as they are printed.
    let [t1, t2, t3] = [27500.0 * 256.0, 18700.0 / 2f64.powi(30), -7.0 / 2f64.powi(48)];
    let c = Coefficients::new(&RAW).unwrap();
    let (up, ut) = (f64::from(COUNTS[0]), f64::from(COUNTS[1]));
    let t_lin = (ut - t1) * t2 + (ut - t1) * (ut - t1) * t3;
    assert!((c.celsius(COUNTS[1]) - t_lin).abs() < 1e-12 && (20.0..30.0).contains(&t_lin), "{t_lin}");
    let (p1, p2) = ((-250.0 - 16384.0) / 2f64.powi(20), (-2400.0 - 16384.0) / 2f64.powi(29));
    let (p3, p4, p5, p6) = (35.0 / 2f64.powi(32), 0.0, 25500.0 * 8.0, 30800.0 / 64.0);
    let (p7, p8, p9) = (3.0 / 256.0, -15.0 / 32768.0, 16000.0 / 2f64.powi(48));
    let (p10, p11) = (20.0 / 2f64.powi(48), -60.0 / 2f64.powi(65));
    let out1 = p5 + p6 * t_lin + p7 * t_lin.powi(2) + p8 * t_lin.powi(3);
    let out2 = up * (p1 + p2 * t_lin + p3 * t_lin.powi(2) + p4 * t_lin.powi(3));
    let pa = out1 + out2 + up.powi(2) * (p9 + p10 * t_lin) + up.powi(3) * p11;
    assert!((c.pascal(COUNTS[0], t_lin) - pa).abs() < 1e-6, "{pa}");
    assert!(RANGE.contains(&pa), "{pa}");
    assert_eq!((Coefficients::new(&[0; 21]), Coefficients::new(&[0xFF; 21])), (None, None));
}

#[test]
fn it_measures_fifty_times_a_second_and_stamps_the_middle() {
    let bus = SimBus::new();
    let (mut baro, mut batch, mut stamps) = (bus.open().unwrap(), AidBatch::default(), vec![]);
    for _ in 0..100 {
        assert_eq!(baro.next(PATIENCE, &mut batch), Ok(Wait::Got));
        assert!(RANGE.contains(&pressure(&batch)));
        let age = baro.sensor.now() - batch[0].t;
        assert!((5_000_000..8_000_000).contains(&age.0), "{age:?}");
        stamps.push(batch[0].t);
    }
    assert!(stamps.windows(2).all(|t| (t[1] - t[0]).0 == 20_000_000), "{stamps:?}");
    assert_eq!(baro.next(Span(1_000_000), &mut batch), Ok(Wait::TimedOut));
    assert!(batch.is_empty() && baro.counters().iter().all(|(_, n)| *n == 0));
}

#[test]
fn what_is_wrong_at_the_start_is_said() {
    let line = |spoil: fn(&mut World)| {
        let bus = SimBus::new();
        bus.set(spoil);
        bus.open().map(|_| ()).unwrap_err().to_string()
    };
    assert!(line(|w| w.registers[0] = 0x58).contains("0x58"), "a BMP280");
    assert!(line(|w| w.faults = vec![BusFault::Nack]).contains("no device answers"));
    assert!(line(|w| w.registers[0x31..0x46].fill(0)).contains("blank"));
    assert!(line(|w| w.stuck = Some(0x1C)).contains("0x1c stays at 0xff"));
}

#[test]
fn transfers_fail_and_it_goes_on() {
    let bus = SimBus::new();
    let (mut baro, mut batch) = (bus.open().unwrap(), AidBatch::default());
    for fault in [BusFault::Nack, BusFault::Io, BusFault::Busy] {
        bus.set(|w| w.faults = vec![fault]);
        assert_eq!(baro.next(PATIENCE, &mut batch), Ok(Wait::Got), "the next measurement is good");
    }
    assert_eq!((baro.counters.baro_bus_errors, baro.counters.baro_restarts), (3, 0));
}

#[test]
fn sensor_that_is_gone_hangs_or_raves_is_lost_and_found_again() {
    type Change = fn(&mut World);
    let cases: [(&str, Change, Change); 4] = [
        ("unplugged", |w| w.faults = vec![BusFault::Gone; 100], |w| w.faults.clear()),
        ("does not measure", |w| w.hangs = true, |w| w.hangs = false),
        (
            "has no pressure",
            |w| w.registers[4..7].copy_from_slice(&[0, 0, 0x80]),
            |w| w.registers[4..7].copy_from_slice(&COUNTS[0].to_le_bytes()[..3]),
        ),
        // All bits set: the pressure of no air.
        (
            "which no air has",
            |w| w.registers[4..10].fill(0xFF),
            |w| w.registers[4..7].copy_from_slice(&COUNTS[0].to_le_bytes()[..3]),
        ),
    ];
    for (name, spoil, mend) in cases {
        let bus = SimBus::new();
        let (mut baro, mut batch) = (bus.open().unwrap(), AidBatch::default());
        bus.set(spoil);
        let lost = (0..5).find_map(|_| baro.next(PATIENCE, &mut batch).err());
        assert!(matches!(lost, Some(SourceFault::Lost(_))), "{name}");
        assert!(batch.is_empty());
        bus.set(mend);
        bus.set(|w| w.registers[7..10].copy_from_slice(&COUNTS[1].to_le_bytes()[..3]));
        let back = (0..50).position(|_| baro.next(PATIENCE, &mut batch) == Ok(Wait::Got));
        assert!(back.is_some() && baro.counters.baro_restarts >= 1, "{name}");
        assert!(RANGE.contains(&pressure(&batch)));
    }
}

#[test]
fn kernels_device_is_read_by_its_name_and_found_again_under_another_number() {
    let sysfs = tempfile::tempdir().unwrap();
    let device = |number: u32, files: &[(&str, &str)]| {
        let folder = sysfs.path().join(format!("iio:device{number}"));
        fs::create_dir_all(&folder).unwrap();
        files.iter().for_each(|(file, text)| fs::write(folder.join(file), text).unwrap());
        folder
    };
    device(0, &[("name", "bmp388\n"), ("in_temp_input", "21000\n")]);
    let folder = device(1, &[("name", "bmp388\n"), ("in_pressure_input", "98.123456\n")]);
    let open = |name: &str| Barometer::start("IIO device".into(), Iio::new(name, sysfs.path()));
    let (mut baro, mut batch) = (open("bmp388").unwrap(), AidBatch::default());
    assert_eq!(baro.next(PATIENCE, &mut batch), Ok(Wait::Got));
    assert!((pressure(&batch) - 98_123.456).abs() < 1e-6);
    for text in ["", "nan", "loud noise", "9e99"] {
        fs::write(folder.join("in_pressure_input"), text).unwrap();
        assert!((0..4).any(|_| baro.next(PATIENCE, &mut batch).is_err()), "`{text}` is no pressure");
        fs::write(folder.join("in_pressure_input"), "98.2").unwrap();
        assert!((0..40).any(|_| baro.next(PATIENCE, &mut batch) == Ok(Wait::Got)));
    }
    // Raw counts, scale and offset; and two of a name.
    device(
        2,
        &[("name", "ms5611"), ("in_pressure_raw", "9800"), ("in_pressure_scale", "0.01"), ("in_pressure_offset", "5")],
    );
    let mut raw = open("ms5611").unwrap();
    assert_eq!(raw.next(PATIENCE, &mut batch), Ok(Wait::Got));
    assert!((pressure(&batch) - 98_050.0).abs() < 1e-6);
    device(3, &[("name", "ms5611"), ("in_pressure_raw", "1")]);
    assert!(open("ms5611").map(|_| ()).unwrap_err().to_string().contains("2 IIO devices"));
    assert!(open("nobody").map(|_| ()).unwrap_err().to_string().contains("0 IIO devices"));
}
