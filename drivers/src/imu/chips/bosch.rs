//! Bosch: BMI088 (two dies in one package) and BMI270. Words are little-endian; FIFO frames carry headers, except those of
//! the BMI088's gyro.

use super::Step::{Touch, Upload, WaitUs, Write};
use super::*;

/// BMI088, gyroscope: a die with address, FIFO and clock of its own. Data sheet BST-BMI088-DS001.
///
/// Checked against Bosch's BMI08x_SensorAPI, Zephyr's bmi08x, ArduPilot and PX4 (whose codes of 250 and 125 °/s differ
/// from the two first, and from the data sheet). ArduPilot alone reports frames of nothing but -32768.
pub const BMI088_GYRO: DieSpec = DieSpec {
    name: "BMI088 gyro",
    // GYRO_CHIP_ID.
    who: 0x00,
    who_answers: &[0x0F],
    bank_select: None,
    spi_dummy: 0,
    big_endian: false,
    accel: None,
    // GYRO_RANGE.
    gyro: Some(SensorSpec { ranges: GYRO_125_TO_2000, data: 0x02 }),
    // GYRO_BANDWIDTH: with the wider band where there are two.
    rates: Rates::Listed(&[(100.0, 7), (200.0, 6), (400.0, 3), (1000.0, 2), (2000.0, 1)]),
    temperature: Temperature { from: TemperatureSource::Nowhere, c_per_lsb: 0.0, c_at_zero: 0.0 },
    fifo: Fifo {
        // FIFO_STATUS: frames in bits 6:0; 100 frames deep ("FIFO", gyroscope).
        count: 0x0E,
        count_bytes: 1,
        count_mask: 0x7F,
        // FIFO_STATUS, fifo_overrun.
        overrun: 0x80,
        unit: 6,
        data: 0x3F,
        capacity: 600,
        full: 600,
        layout: Layout::Plain { len: 6, accel: None, gyro: Some(0), temperature: None },
        // FIFO_CONFIG_1: writing the mode clears it, and the overrun flag. FIFO rather than STREAM: where old frames make
        // room for new ones while it is read, the axes come out rotated (ArduPilot, pull request 20434).
        reset: &[Write(0x3E, 0x40)],
    },
    // GYRO_SOFTRESET: 30 ms.
    reset: &[Write(0x14, 0xB6), WaitUs(35_000)],
    configure: configure_bmi088_gyro,
    cross_axis: None,
    // GYRO_SELF_TEST: BIST trigger, ready and failed.
    self_tests: &[SelfTest::BuiltIn(BuiltInTest {
        sensor: Sensor::Gyro,
        prepare: &[],
        trigger: (0x3C, 0x01),
        answer: 0x3C,
        done: 0x02,
        verdict: 0x04,
        good: 0x00,
    })],
};

fn configure_bmi088_gyro(s: &Setting) -> Vec<Step> {
    vec![
        Write(0x0F, s.gyro),
        Write(0x10, s.rate),
        // INT3_INT4_IO_CONF, INT3_INT4_IO_MAP and GYRO_INT_CTRL: data ready on INT3, push-pull, active high; INT4 stays
        // open, as it is after a reset.
        Write(0x16, 0x0D),
        Write(0x18, if s.data_ready { 0x01 } else { 0x00 }),
        Write(0x15, if s.data_ready { 0x80 } else { 0x00 }),
        WaitUs(30_000),
        // FIFO_CONFIG_0: no watermark.
        Write(0x3D, 0x00),
    ]
}

/// The FIFO of the BMI088's accelerometer and the BMI270, whose frames carry headers: FIFO_LENGTH_0 and 1 at 0x24, FIFO_DATA
/// at 0x26, and the command that flushes it. `frame` is the largest frame of samples, `config` the frame that says that the
/// configuration changed, bytes.
const fn headed_fifo(capacity: usize, frame: usize, config: usize) -> Fifo {
    Fifo {
        count: 0x24,
        count_bytes: 2,
        count_mask: 0x3FFF,
        overrun: 0,
        unit: 1,
        data: 0x26,
        capacity,
        full: capacity - frame + 1,
        layout: Layout::Bosch { config },
        reset: &[Write(0x7E, 0xB0)],
    }
}

/// ACC_CONF, acc_odr.
const BMI088_ACCEL_RATES: &[(f64, u8)] =
    &[(12.5, 5), (25.0, 6), (50.0, 7), (100.0, 8), (200.0, 9), (400.0, 10), (800.0, 11), (1600.0, 12)];

/// The self-test of both accelerometers: positive less negative excitation, at least so much on each axis, g.
const fn accel_test(prepare: &'static [Step], full_scale_g: f64, [x, y, z]: [f64; 3]) -> SelfTest {
    SelfTest::Excitation(ExcitationTest {
        sensor: Sensor::Accel,
        prepare,
        on: &[Write(0x6D, 0x0D), WaitUs(55_000)],
        off: &[Write(0x6D, 0x09), WaitUs(55_000)],
        per_lsb: full_scale_g / 32768.0,
        within: [(x, f64::INFINITY), (y, f64::INFINITY), (z, f64::INFINITY)],
    })
}

/// BMI088, accelerometer. Data sheet BST-BMI088-DS001.
///
/// Checked against Bosch's BMI08x_SensorAPI, Zephyr's bmi08x, Linux's bmi088-accel, ArduPilot and PX4.
pub const BMI088_ACCEL: DieSpec = DieSpec {
    name: "BMI088 accelerometer",
    // ACC_CHIP_ID.
    who: 0x00,
    who_answers: &[0x1E],
    bank_select: None,
    // "SPI interface of accelerometer part": a dummy byte follows the address of a read.
    spi_dummy: 1,
    big_endian: false,
    accel: Some(SensorSpec {
        // ACC_RANGE: 2^(range + 1) * 1.5 g; revision 1.3 leaves the 1.5 out at "ACC data".
        ranges: &[range(3.0, 0), range(6.0, 1), range(12.0, 2), range(24.0, 3)],
        data: 0x12,
    }),
    gyro: None,
    rates: Rates::Listed(BMI088_ACCEL_RATES),
    // TEMP_MSB and TEMP_LSB: 0.125 °C a step from 23 °C.
    temperature: Temperature { from: TemperatureSource::ElevenBits(0x22), c_per_lsb: 0.125, c_at_zero: 23.0 },
    // "FIFO", accelerometer: 1 KiB.
    fifo: headed_fifo(1024, 7, 1),
    // ACC_SOFTRESET, 1 ms, then "Power on and sensor initialisation": a read turns the interface to SPI, then active
    // mode and the sensor on. After a write in suspend mode nothing may follow for 1 ms; Bosch's driver leaves 5.
    reset: &[
        Write(0x7E, 0xB6),
        WaitUs(2000),
        Touch(0x00),
        Write(0x7C, 0x00),
        WaitUs(5000),
        Write(0x7D, 0x04),
        WaitUs(50_000),
    ],
    configure: configure_bmi088_accel,
    cross_axis: None,
    // "Self-test: accelerometer": 24 g, 1600 Hz (0xAC as the text explains; the 0xA7 that it prints is 50 Hz); 1, 1 and 0.5 g.
    self_tests: &[accel_test(&[Write(0x41, 0x03), Write(0x40, 0xAC), WaitUs(3000)], 24.0, [1.0, 1.0, 0.5])],
};

fn configure_bmi088_accel(s: &Setting) -> Vec<Step> {
    vec![
        Write(0x6D, 0x00),
        // ACC_CONF: normal filter.
        Write(0x40, 0xA0 | s.rate),
        Write(0x41, s.accel),
        WaitUs(2000),
        // FIFO_CONFIG_0 and 1: a stream of accelerometer frames; both registers have bits that must be one.
        Write(0x48, 0x02),
        Write(0x49, 0x50),
    ]
}

/// BMI270. Data sheet BST-BMI270-DS000, register description.
///
/// Checked against Bosch's BMI270_SensorAPI, Linux's bmi270, ArduPilot and PX4. Bosch's alone confirms the cross-axis factor
/// and the gyro's self-test of the data sheet.
pub const BMI270: DieSpec = DieSpec {
    name: "BMI270",
    // CHIP_ID.
    who: 0x00,
    who_answers: &[0x24],
    bank_select: None,
    // "SPI interface": a dummy byte follows the address of a read.
    spi_dummy: 1,
    big_endian: false,
    // ACC_RANGE and GYR_RANGE.
    accel: Some(SensorSpec { ranges: ACCEL_2_TO_16, data: 0x0C }),
    gyro: Some(SensorSpec { ranges: GYRO_125_TO_2000, data: 0x12 }),
    // ACC_CONF and GYR_CONF, odr, of both.
    rates: Rates::Listed(&[(25.0, 6), (50.0, 7), (100.0, 8), (200.0, 9), (400.0, 10), (800.0, 11), (1600.0, 12)]),
    // TEMPERATURE_0 and 1: 1/512 K a step from 23 °C.
    temperature: Temperature { from: TemperatureSource::Word(0x22), c_per_lsb: 1.0 / 512.0, c_at_zero: 23.0 },
    // "FIFO": 2 KiB.
    fifo: headed_fifo(2048, 13, 4),
    // CMD: soft reset; a read turns the interface to SPI; then "Device initialisation": the configuration
    // file, without which it measures nothing.
    reset: &[Write(0x7E, 0xB6), WaitUs(2000), Touch(0x00), WaitUs(500), Write(0x7C, 0x00), WaitUs(500), Upload],
    configure: configure_bmi270,
    // GYR_CAS, factor_zx.
    cross_axis: Some(0x3C),
    self_tests: &[
        // "Accelerometer self-test": 16 g, 1600 Hz, high amplitude; 16, 15 and 10 g.
        accel_test(&[Write(0x7D, 0x04), Write(0x41, 0x03), Write(0x40, 0xAC), WaitUs(3000)], 16.0, [16.0, 15.0, 10.0]),
        // "Gyroscope self-test": only the accelerometer is on, g_trigger of CMD starts it, GYR_SELF_TEST_AXES says when it is
        // done and which axes passed.
        SelfTest::BuiltIn(BuiltInTest {
            sensor: Sensor::Gyro,
            prepare: &[Write(0x6D, 0x00), WaitUs(55_000)],
            trigger: (0x7E, 0x02),
            answer: 0x6E,
            done: 0x01,
            verdict: 0x0E,
            good: 0x0E,
        }),
    ],
};

fn configure_bmi270(s: &Setting) -> Vec<Step> {
    vec![
        Write(0x6D, 0x00),
        // ACC_CONF and GYR_CONF: normal filters, for performance rather than power.
        Write(0x40, 0xA0 | s.rate),
        Write(0x41, s.accel),
        Write(0x42, 0xE0 | s.rate),
        // GYR_RANGE, with ois_range as in Betaflight and ArduPilot: without it they met 250 for 2000 °/s in the FIFO.
        Write(0x43, 0x08 | s.gyro),
        // PWR_CTRL: accelerometer, gyro and temperature on; the gyro's start-up time is 45 ms.
        Write(0x7D, 0x0E),
        WaitUs(60_000),
        // INT1_IO_CTRL and INT_MAP_DATA: data ready on INT1, push-pull, active high.
        Write(0x53, 0x0A),
        Write(0x58, if s.data_ready { 0x04 } else { 0x00 }),
        // FIFO_DOWNS, FIFO_CONFIG_0 and 1: filtered data; no time frames; headers, accelerometer and gyro.
        Write(0x45, 0x88),
        Write(0x48, 0x00),
        Write(0x49, 0xD0),
    ]
}
