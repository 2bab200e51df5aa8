//! Each chip's driver against the simulated register file: values, stamps, and every fault.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

mod chips;
pub mod iio;
mod simulated;

use super::bus::{Bus, BusFault};
use super::chips::CHIPS;
use super::counters::ImuCounters;
use super::edges::Edges;
use super::unit::GRAVITY;
use super::{RegisterImu, RegisterOptions, Wiring};
use crate::source::{ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::Span;
use chips::model;
use simulated::{SimBus, SimEdges};
use std::io::Write;

const MS: i64 = 1_000_000;

struct Rig {
    imu: RegisterImu,
    buses: Vec<SimBus>,
    seen: Vec<ImuReading>,
    lost: Vec<String>,
}

fn options(chip: &str) -> RegisterOptions {
    let dies = CHIPS.iter().find(|c| c.name == chip).unwrap().dies.len();
    let wiring = Wiring::I2c { adapter: "simulated".into(), address: 0x68 };
    RegisterOptions {
        chip: chip.into(),
        wiring: vec![wiring; dies],
        rate_hz: 200.0,
        accel_range_g: 8.0,
        gyro_range_dps: 500.0,
        self_test: false,
        configuration: Default::default(),
        frozen_samples: 50,
    }
}

fn buses(chip: &str) -> Vec<SimBus> {
    let dies = CHIPS.iter().find(|c| c.name == chip).unwrap().dies.len();
    let first = SimBus::new(model(chip, 0));
    let second = (dies == 2).then(|| first.beside(model(chip, 1)));
    std::iter::once(first).chain(second).collect()
}

fn boxed(buses: &[SimBus]) -> Vec<Box<dyn Bus>> {
    buses.iter().map(|bus| Box::new(bus.clone()) as Box<dyn Bus>).collect()
}

/// Eight KiB that stand for the BMI270's configuration.
fn configuration() -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(&(0..8192u32).map(|i| (i * 7 + i / 256) as u8).collect::<Vec<_>>()).unwrap();
    file
}

impl Rig {
    fn new(chip: &str) -> Rig {
        Rig::with(chip, buses(chip), None)
    }

    fn with_edges(chip: &str, latency: i64, drop_every: usize) -> Rig {
        let buses = buses(chip);
        buses[0].world().edges = Some(vec![]);
        let edges = SimEdges { bus: buses[0].clone(), latency, drop_every, given: 0 };
        Rig::with(chip, buses, Some(edges))
    }

    fn with(chip: &str, buses: Vec<SimBus>, edges: Option<SimEdges>) -> Rig {
        let file = configuration();
        let options = RegisterOptions { configuration: file.path().into(), ..options(chip) };
        let imu = options.start(boxed(&buses), edges.map(|e| Box::new(e) as Box<dyn Edges>)).unwrap();
        Rig { imu, buses, seen: vec![], lost: vec![] }
    }

    /// Calls `next` for so long of the simulated clock.
    fn run(&mut self, span_ms: i64) {
        let until = self.buses[0].instant() + span_ms * MS;
        let mut batch = ImuBatch::default();
        while self.buses[0].instant() < until {
            let from = self.buses[0].instant();
            match self.imu.next(Span(50 * MS), &mut batch) {
                Ok(Wait::Got) => {
                    assert!(!batch.is_empty());
                    self.seen.extend(batch.iter());
                }
                Ok(Wait::TimedOut) => assert!(batch.is_empty() && self.buses[0].instant() > from),
                Ok(Wait::Ended) => panic!("hardware does not end"),
                Err(fault @ SourceFault::Lost(_)) => {
                    assert!(batch.is_empty());
                    self.lost.push(fault.to_string());
                }
                Err(fault) => panic!("{fault}"),
            }
        }
        let in_order = self.seen.windows(2).all(|w| w[0].sample.t < w[1].sample.t);
        assert!(in_order, "stamps grow strictly");
    }

    fn counted(&self) -> ImuCounters {
        self.imu.counts()
    }

    /// Largest error of a stamp after the first `skip` samples, ns; every sample must be one of the sensor's.
    fn stamp_error(&self, skip: usize) -> i64 {
        let world = self.buses[0].world();
        let scale = 500f64.to_radians() / 500.0;
        let mut from = 0;
        let mut worst = 0;
        for (i, seen) in self.seen.iter().enumerate() {
            let found = world.truth[from..].iter().position(|(_, t, raw)| {
                let gyro = raw.gyro.unwrap().map(|v| f64::from(v) / (world.model.per_dps)(&world.registers) * scale);
                (seen.sample.gyro_body - glam::DVec3::from(gyro)).length() < 1e-9
                    && (t - seen.sample.t.0).abs() < 100 * MS
            });
            let found = from + found.unwrap_or_else(|| panic!("sample {i} was never taken: {seen:?}"));
            from = found + 1;
            if i >= skip {
                worst = worst.max((world.truth[found].1 - seen.sample.t.0).abs());
            }
        }
        worst
    }
}

#[test]
fn every_chip_gives_every_sample_once_in_its_scale() {
    for chip in CHIPS {
        let mut rig = Rig::new(chip.name);
        rig.run(3000);
        let world = rig.buses[0].world();
        let rate = (world.model.rate_hz)(&world.registers);
        let missing = world.truth.len() as i64 - rig.seen.len() as i64;
        assert!((0..12).contains(&missing), "{}: {missing} of {} are missing", chip.name, world.truth.len());
        let (g, dps) = (9.80665, 1f64.to_radians());
        let (per_g, per_dps) = ((world.model.per_g)(&world.registers), (world.model.per_dps)(&world.registers));
        drop(world);
        // 187.5 Hz of the ICM-20948, 208 Hz of the LSM6DSOX.
        assert!((rate / 200.0 - 1.0).abs() < 0.07, "{}", chip.name);
        assert_eq!(GRAVITY, g);
        // One die: sample for sample, axis for axis, to the bit. The pair's accelerometer is between two of its own.
        for (seen, (_, _, raw)) in rig.seen.iter().zip(&rig.buses[0].world().truth).filter(|_| chip.dies.len() == 1) {
            let (accel, gyro) = (raw.accel.unwrap(), raw.gyro.unwrap());
            for i in 0..3 {
                let (a, w) = (f64::from(accel[i]) / per_g * g, f64::from(gyro[i]) / per_dps * dps);
                assert!((seen.sample.accel_body[i] - a).abs() < 1e-9, "{} {seen:?}", chip.name);
                assert!((seen.sample.gyro_body[i] - w).abs() < 1e-9, "{} {seen:?}", chip.name);
            }
        }
        let settled = rig.seen.len() / 2;
        assert!(rig.stamp_error(settled) < MS, "{}: {} ns", chip.name, rig.stamp_error(settled));
        let warm = rig.seen.last().unwrap();
        assert!((warm.temperature_c.unwrap() - 31.5).abs() < 0.3, "{}: {warm:?}", chip.name);
        assert!((warm.sample.accel_body.z - g).abs() < 0.01 && !warm.saturated, "{}: {warm:?}", chip.name);
        let expected = ImuCounters { imu_rate_millihertz: rig.counted().imu_rate_millihertz, ..ImuCounters::default() };
        let counted = ImuCounters { imu_unpaired: 0, ..rig.counted() };
        assert_eq!(counted, expected, "{}", chip.name);
        assert!(rig.counted().imu_unpaired <= 2, "{}: those before the first of the other die", chip.name);
    }
}

#[test]
fn two_dies_are_joined_at_the_gyros_time() {
    let buses = buses("bmi088");
    buses[1].world().fast = 0.011;
    let mut rig = Rig::with("bmi088", buses, None);
    rig.run(4000);
    let accel = rig.buses[1].world();
    let scale = GRAVITY / (accel.model.per_g)(&accel.registers);
    let mut checked = 0;
    for seen in &rig.seen[200..] {
        let after = accel.truth.partition_point(|(_, t, _)| *t <= seen.sample.t.0);
        let Some([a, b]) = accel.truth.get(after - 1..after + 1) else { continue };
        let (a, b) = (a.2.accel.unwrap(), b.2.accel.unwrap());
        // Between the neighbours, or as the stamps' error lets it, a neighbour further; the saw's fall apart.
        let slack = 0.002 * GRAVITY;
        let (low, high) = (f64::from(a[0].min(b[0])) * scale - slack, f64::from(a[0].max(b[0])) * scale + slack);
        assert!((low..=high).contains(&seen.sample.accel_body.x), "{seen:?} of {low} to {high}");
        checked += 1;
    }
    assert!(checked > 500 && rig.counted().imu_unpaired <= 2, "{checked}, {:?}", rig.counted());
}

#[test]
fn drift_is_recovered_within_10_ppm_polled_and_with_edges() {
    for (edges, fast) in [(false, 0.0), (false, 12e-3), (false, -300e-6), (true, 12e-3), (true, -300e-6)] {
        let mut rig = if edges { Rig::with_edges("icm-42688-p", 25_000, 0) } else { Rig::new("icm-42688-p") };
        rig.buses[0].world().fast = fast;
        rig.run(60_000);
        let drift = rig.imu.units[0].line.rate_hz() / 200.0 - 1.0;
        assert!((drift - fast).abs() < 10e-6, "edges {edges}, {fast}: {drift}");
        let error = rig.stamp_error(rig.seen.len() / 2);
        assert!(error < if edges { 1 } else { 200_000 }, "edges {edges}, {fast}: {error} ns");
        assert_eq!(rig.counted().imu_gaps, 0);
        let rate = rig.counted().imu_rate_millihertz as f64;
        assert!((rate - 200e3 * (1.0 + fast)).abs() < 2.5, "{rate}");
    }
}

#[test]
fn edges_stamp_the_samples_exactly_and_lost_ones_cost_little() {
    for chip in ["mpu-6500", "icm-20948", "lsm6dsox", "bmi270", "bmi088"] {
        let mut rig = Rig::with_edges(chip, 30_000, 0);
        rig.run(2000);
        assert_eq!(rig.stamp_error(2), 0, "{chip}");
        assert!(rig.counted().imu_edges_unmatched <= 1, "{chip}: {:?}", rig.counted());
    }
    let mut rig = Rig::with_edges("mpu-6500", 30_000, 23);
    rig.run(5000);
    assert!(rig.stamp_error(50) < MS / 4, "{}", rig.stamp_error(50));
    let lost = rig.seen.len() as u64 / 23;
    assert!(rig.counted().imu_edges_unmatched.abs_diff(lost) <= 3, "{:?} of {lost}", rig.counted());
    assert_eq!(rig.counted().imu_gaps, 0);
}

#[test]
fn without_its_line_a_unit_goes_on_by_the_clock_and_takes_the_line_back() {
    let mut rig = Rig::with_edges("mpu-6500", 30_000, 0);
    rig.run(1000);
    rig.buses[0].world().edge_fault = true;
    rig.run(3000);
    let faults = rig.counted().imu_edge_faults;
    assert!((2..12).contains(&faults), "{faults}");
    rig.buses[0].world().edge_fault = false;
    rig.run(2000);
    assert!(rig.stamp_error(0) < 3 * MS, "{}", rig.stamp_error(0));
    assert_eq!(rig.stamp_error(rig.seen.len() - 100), 0);
    assert_eq!((rig.counted().imu_edge_faults, rig.counted().imu_gaps, rig.lost.len()), (faults, 0, 0));
}

#[test]
fn a_few_failed_transfers_lose_nothing() {
    for (fault, n) in [(BusFault::Nack, 2), (BusFault::Short, 2), (BusFault::Busy, 1), (BusFault::Io, 2)] {
        let mut rig = Rig::new("mpu-6500");
        rig.run(500);
        rig.buses[0].world().faults.extend(vec![fault; n]);
        rig.run(500);
        let c = rig.counted();
        let counted = [c.imu_nacks, c.imu_short_transfers, c.imu_bus_busy, c.imu_bus_errors];
        assert_eq!(counted.iter().sum::<u64>(), n as u64, "{fault:?}: {counted:?}");
        assert_eq!((c.imu_restarts, c.imu_gaps, rig.lost.len()), (0, 0, 0), "{fault:?}");
        assert!(rig.buses[0].world().truth.len() - rig.seen.len() < 8);
    }
}

#[test]
fn a_burst_of_failures_resets_the_unit_and_it_comes_back() {
    let mut rig = Rig::new("icm-42688-p");
    rig.run(500);
    rig.buses[0].world().faults.extend([BusFault::Nack; 3]);
    let before = rig.seen.len();
    rig.run(1000);
    let c = rig.counted();
    assert_eq!((c.imu_nacks, c.imu_restarts, c.imu_restarts_failed, rig.lost.len()), (3, 1, 0, 0));
    assert!(rig.seen.len() > before + 140, "{}", rig.seen.len() - before);
    assert!(c.imu_gaps == 1 && (10..60).contains(&c.imu_samples_missing), "{c:?}");
    // While it is set up, too.
    rig.buses[0].world().faults.extend([BusFault::Io; 12]);
    rig.run(3000);
    let c = rig.counted();
    assert!(c.imu_bus_errors >= 4 && c.imu_restarts == 2 && c.imu_restarts_failed >= 1, "{c:?}");
    assert!(rig.stamp_error(rig.seen.len() - 100) < 2 * MS);
}

#[test]
fn an_unplugged_unit_is_lost_and_found_again() {
    let mut rig = Rig::new("bmi088");
    rig.run(1000);
    rig.buses.iter().for_each(|b| b.world().unplugged = true);
    rig.run(4000);
    assert!(rig.lost.len() > 4 && rig.lost[0].contains("the bus is not there"), "{:?}", rig.lost);
    let looked = rig.buses[0].world().reopened;
    assert!((5..12).contains(&looked), "{looked} times in four seconds: the pause doubles up to one");
    let before = rig.seen.len();
    rig.buses.iter().for_each(|b| b.world().unplugged = false);
    rig.run(2500);
    assert!(rig.seen.len() > before + 200, "{}", rig.seen.len() - before);
    assert!(rig.counted().imu_restarts == 1 && rig.counted().imu_gaps <= 2, "{:?}", rig.counted());
}

#[test]
fn a_unit_that_lost_its_configuration_is_set_up_anew() {
    let mut rig = Rig::new("lsm6dsox");
    rig.run(500);
    rig.buses[0].world().browned = true;
    rig.run(1500);
    let c = rig.counted();
    assert_eq!((c.imu_silences, c.imu_restarts, c.imu_gaps, rig.lost.len()), (1, 1, 1, 0), "{c:?}");
    assert!(rig.seen.len() > 250);
}

#[test]
fn a_stalled_host_overflows_the_fifo_which_is_counted_and_cleared() {
    for chip in CHIPS {
        let mut rig = Rig::new(chip.name);
        rig.run(500);
        // Longer than any FIFO lasts at 200 Hz.
        rig.buses[0].world().stall = 2000 * MS;
        rig.run(3500);
        let c = rig.counted();
        assert!((1..=2).contains(&c.imu_fifo_overflows), "{}: {c:?}", chip.name);
        assert!(c.imu_gaps >= 1 && c.imu_samples_missing > 100 && c.imu_restarts == 0, "{}: {c:?}", chip.name);
        assert!(rig.stamp_error(0) < 6 * MS, "{}: {}", chip.name, rig.stamp_error(0));
        assert!(rig.stamp_error(rig.seen.len() - 50) < 2 * MS, "{}", chip.name);
    }
}

#[test]
fn what_piled_up_before_the_first_read_is_no_overflow() {
    for chip in CHIPS {
        let mut rig = Rig::new(chip.name);
        rig.buses[0].world().stall = 2000 * MS;
        rig.run(3500);
        let c = rig.counted();
        assert_eq!((c.imu_fifo_overflows, c.imu_gaps, c.imu_restarts), (0, 0, 0), "{}: {c:?}", chip.name);
        assert!(rig.seen.len() > 250, "{}: {}", chip.name, rig.seen.len());
    }
}

#[test]
fn a_fifo_that_says_it_lost_samples_is_cleared_however_little_is_in_it() {
    for (chip, count) in [("bmi088", [0x83, 0]), ("lsm6dsox", [4, 0x48]), ("lsm6dsox", [4, 0x08])] {
        let mut rig = Rig::new(chip);
        rig.run(500);
        rig.buses[0].world().counts.push_back(count);
        rig.run(1000);
        let c = rig.counted();
        assert_eq!((c.imu_fifo_overflows, c.imu_restarts), (1, 0), "{chip}: {c:?}");
        assert!(rig.stamp_error(rig.seen.len() - 50) < 2 * MS, "{chip}");
    }
}

#[test]
fn counts_that_cannot_be_are_counted_and_reset_the_unit() {
    let mut rig = Rig::new("icm-20948");
    rig.run(500);
    rig.buses[0].world().counts.extend([[0x0F, 0xFF], [0x1F, 0xFF]]);
    rig.run(300);
    assert_eq!((rig.counted().imu_fifo_garbage, rig.counted().imu_restarts), (2, 0));
    rig.buses[0].world().counts.extend([[0xFF; 2]; 3]);
    rig.run(1000);
    assert_eq!((rig.counted().imu_fifo_garbage, rig.counted().imu_restarts), (5, 1));
    // Less than there is, and not whole frames: the rest comes with the next read.
    rig.buses[0].world().counts.extend([[0, 15], [0, 1], [0, 0]]);
    rig.run(1000);
    assert_eq!((rig.counted().imu_fifo_garbage, rig.counted().imu_restarts), (5, 1));
    assert!(rig.stamp_error(rig.seen.len() - 100) < MS);
}

#[test]
fn a_frozen_sensor_is_reset_and_then_lost_while_it_stays_so() {
    let mut rig = Rig::new("mpu-9250");
    rig.run(500);
    let frozen = rig.buses[0].world().counts_of(7);
    rig.buses[0].world().frozen = Some(frozen);
    rig.run(3000);
    let c = rig.counted();
    assert!(c.imu_frozen >= 2 && c.imu_restarts >= 1, "{c:?}");
    assert!(rig.lost.iter().any(|l| l.contains("same value")), "{:?}", rig.lost);
    rig.buses[0].world().frozen = None;
    let before = rig.seen.len();
    rig.run(2000);
    assert!(rig.seen.len() > before + 200);
    assert_eq!(rig.counted().imu_frozen, c.imu_frozen);
}

#[test]
fn an_axis_at_the_end_of_its_range_is_flagged() {
    let mut rig = Rig::new("bmi270");
    assert!((rig.imu.range().unwrap()[1] / (8.0 * GRAVITY) - 1.0).abs() < 1e-4);
    rig.run(300);
    assert_eq!(rig.counted().imu_saturated, 0);
    rig.buses[0].world().clipped = true;
    let from = rig.seen.len();
    rig.run(300);
    let flagged = rig.seen[from..].iter().filter(|r| r.saturated).count() as u64;
    assert!(flagged > 40 && flagged == rig.counted().imu_saturated, "{flagged}");
    assert!((rig.seen.last().unwrap().sample.accel_body.y + 8.0 * GRAVITY).abs() < 1e-9);
}

/// A BMI088 has no range of 16 g and is set to 24 g: while the board's word was taken for it, true readings above 15.8 g
/// counted as saturated.
#[test]
fn the_range_that_a_unit_is_set_to_is_stated() {
    let options = RegisterOptions { accel_range_g: 16.0, gyro_range_dps: 2000.0, ..options("bmi088") };
    let [gyro, accel] = options.start(boxed(&buses("bmi088")), None).unwrap().range().unwrap();
    assert!((gyro.to_degrees() / 2000.0 - 1.0).abs() < 1e-4 && (accel / GRAVITY / 24.0 - 1.0).abs() < 1e-4);
}

#[test]
fn temperatures_below_zero_are_below_zero() {
    for (chip, die, raw, celsius) in [
        ("bmi088", 1, -344i16, -20.0),
        ("bmi270", 0, -22016, -20.0),
        ("icm-42688-p", 0, -93, -19.9),
        ("lsm6dsox", 0, -11520, -20.0),
        // Not known yet.
        ("bmi088", 1, i16::MIN >> 5, f32::NAN),
        ("bmi270", 0, i16::MIN, f32::NAN),
    ] {
        let buses = buses(chip);
        buses[die].world().model.temperature = raw;
        let mut rig = Rig::with(chip, buses, None);
        rig.run(1500);
        let seen = rig.seen.last().unwrap().temperature_c.unwrap_or(f32::NAN);
        assert!((seen - celsius).abs() < 0.05 || seen.is_nan() && celsius.is_nan(), "{chip}: {seen}");
    }
}

#[test]
fn self_tests_pass_a_whole_unit_and_name_the_axis_that_fails() {
    for chip in CHIPS {
        let file = configuration();
        let options = RegisterOptions { self_test: true, configuration: file.path().into(), ..options(chip.name) };
        let start = |push: [f64; 2], code: u8| {
            let buses = buses(chip.name);
            buses.iter().for_each(|b| (b.world().push, b.world().code) = (push, code));
            options.start(boxed(&buses), None).map(|_| ())
        };
        let passes = |push, code| start(push, code).unwrap_or_else(|fault| panic!("{}: {fault}", chip.name));
        let fails = |push, code, which: &str| {
            let fault = start(push, code).unwrap_err().to_string();
            let said = fault.contains(&format!("self-test of {which}")) && fault.contains("keep the board still");
            assert!(said, "{}: {fault}", chip.name);
        };
        passes([1.0; 2], 60);
        fails([0.02, 1.0], 60, "accelerometer");
        fails([1.0, 0.02], 60, "gyro");
        // Of a die that the factory left no codes, the push alone must do: 288 mg and 72 °/s do, 1.4 g and 36 °/s do not.
        if chip.name.starts_with("mpu") || chip.name.starts_with("icm") {
            passes([1.0, 2.0], 0);
            fails([5.0, 2.0], 0, "accelerometer");
            fails([1.0, 1.0], 0, "gyro");
        }
    }
}

#[test]
fn what_is_not_there_or_another_chip_does_not_start() {
    let start = |chip: &str, other: &str| {
        let file = configuration();
        let options = RegisterOptions { configuration: file.path().into(), ..options(chip) };
        options.start(boxed(&[SimBus::new(model(other, 0))]), None).map(|_| ())
    };
    assert!(start("mpu-9250", "mpu-9250").is_ok());
    let fault = start("mpu-9250", "icm-42688-p").unwrap_err().to_string();
    assert!(fault.contains("WHO_AM_I answers 0x47") && fault.contains("imu.chip"), "{fault}");
    let bus = SimBus::new(model("mpu-9250", 0));
    bus.world().faults.extend([BusFault::Nack; 9]);
    let fault = options("mpu-9250").start(boxed(std::slice::from_ref(&bus)), None).map(|_| ()).unwrap_err();
    assert!(fault.to_string().contains("imu.address"), "{fault}");
    assert_eq!(bus.world().registers[0][0x6B], 0, "nothing was written to what may be another chip");
}

#[test]
fn the_bmi270_asks_for_its_configuration_and_gets_it_whole() {
    let fault = options("bmi270").start(boxed(&buses("bmi270")), None).map(|_| ()).unwrap_err().to_string();
    assert!(fault.contains("bmi270_config_file") && fault.contains("imu.configuration"), "{fault}");
    let rig = Rig::new("bmi270");
    let file = configuration();
    assert_eq!(rig.buses[0].world().upload, std::fs::read(file.path()).unwrap());
    let with = |path: &std::path::Path, buses: Vec<SimBus>| {
        let options = RegisterOptions { configuration: path.into(), ..options("bmi270") };
        options.start(boxed(&buses), None).map(|_| ()).unwrap_err().to_string()
    };
    // That of another variant, or half a file.
    let short = tempfile::NamedTempFile::new().unwrap();
    short.as_file().write_all(&[7; 328]).unwrap();
    for (path, said) in [(short.path(), "328 bytes, not 8192"), ("no/such/file".as_ref(), "cannot be read")] {
        let fault = with(path, buses("bmi270"));
        assert!(fault.contains(said) && fault.contains("bmi270_config_file"), "{fault}");
    }
    let refuses = buses("bmi270");
    refuses[0].world().configured = 2;
    let fault = with(file.path(), refuses);
    assert!(fault.contains("INTERNAL_STATUS is 0x02") && fault.contains("imu.configuration"), "{fault}");
}

#[test]
fn the_gyros_cross_axis_of_the_bmi270_is_taken_out() {
    let buses = buses("bmi270");
    // Minus three in seven bits.
    buses[0].world().cross = 0x7D;
    let mut rig = Rig::with("bmi270", buses, None);
    rig.run(200);
    let world = rig.buses[0].world();
    let steps = |rad: f64| rad.to_degrees() * (world.model.per_dps)(&world.registers);
    for (seen, (_, _, raw)) in rig.seen.iter().zip(&world.truth) {
        let [x, _, z] = raw.gyro.unwrap().map(i32::from);
        assert!((steps(seen.sample.gyro_body.x) - f64::from(x + 3 * z / 512)).abs() < 1e-6, "{x} {z} {seen:?}");
    }
}
