//! ST: LSM6DSOX. Words are little-endian; the FIFO gives a tag and three values for each sensor.

use super::Step::{WaitUs, Write};
use super::*;

/// A range whose full scale is not 2^15 steps.
const fn stepped(full_scale: f64, code: u8, per_lsb: f64) -> Range {
    Range { full_scale, code, per_lsb }
}

/// CTRL1_XL and "Mechanical characteristics": codes out of order.
const ACCEL_RANGES: &[Range] =
    &[stepped(2.0, 0, 0.061e-3), stepped(4.0, 2, 0.122e-3), stepped(8.0, 3, 0.244e-3), stepped(16.0, 1, 0.488e-3)];
/// CTRL2_G and "Mechanical characteristics": full scale is less than 2^15 steps.
const GYRO_RANGES: &[Range] =
    &[stepped(250.0, 0, 8.75e-3), stepped(500.0, 1, 17.5e-3), stepped(1000.0, 2, 35e-3), stepped(2000.0, 3, 70e-3)];
/// CTRL1_XL and CTRL2_G, ODR, of both sensors.
const RATES: &[(f64, u8)] =
    &[(12.5, 1), (26.0, 2), (52.0, 3), (104.0, 4), (208.0, 5), (417.0, 6), (833.0, 7), (1667.0, 8), (3333.0, 9)];

/// LSM6DSOX. Data sheet DS12814 and application note AN5272.
///
/// Checked against ST's lsm6dsox-pid with its self-test example and Linux's st_lsm6dsx. ST's alone confirms the flags of an
/// overrun, the temperature in the FIFO and the self-tests; the length of the data-ready pulse is in the data sheet alone.
pub const LSM6DSOX: DieSpec = DieSpec {
    name: "LSM6DSOX",
    // WHO_AM_I.
    who: 0x0F,
    who_answers: &[0x6C],
    bank_select: None,
    spi_dummy: 0,
    big_endian: false,
    accel: Some(SensorSpec { ranges: ACCEL_RANGES, data: 0x28 }),
    gyro: Some(SensorSpec { ranges: GYRO_RANGES, data: 0x22 }),
    rates: Rates::Listed(RATES),
    // "Temperature sensor characteristics": 256 steps a degree from 25 °C.
    temperature: Temperature { from: TemperatureSource::Frames, c_per_lsb: 1.0 / 256.0, c_at_zero: 25.0 },
    fifo: Fifo {
        // FIFO_STATUS1 and 2: words in the low ten bits; 3 KiB of six bytes each ("FIFO").
        count: 0x3A,
        count_bytes: 2,
        count_mask: 0x03FF,
        // FIFO_STATUS2: FIFO_OVR_IA, and FIFO_OVR_LATCHED, which reading it clears.
        overrun: 0x4800,
        unit: 7,
        data: 0x78,
        capacity: 512 * 7,
        full: 510 * 7,
        layout: Layout::Tagged,
        // FIFO_CTRL4: bypass empties it; then a stream with temperature at 1.6 Hz.
        reset: &[Write(0x0A, 0x00), Write(0x0A, 0x16)],
    },
    // CTRL3_C: SW_RESET; the 50 ms are Linux's.
    reset: &[Write(0x12, 0x01), WaitUs(50_000)],
    configure: configure_lsm6dsox,
    cross_axis: None,
    self_tests: &[
        // AN5272, "Accelerometer self-test": ±4 g, 52 Hz, 50 to 1700 mg.
        SelfTest::Excitation(ExcitationTest {
            sensor: Sensor::Accel,
            prepare: &[Write(0x12, 0x44), Write(0x10, 0x38), WaitUs(100_000)],
            on: &[Write(0x14, 0x01), WaitUs(100_000)],
            off: &[Write(0x14, 0x00), WaitUs(100_000)],
            per_lsb: 0.122e-3,
            within: [(0.05, 1.7); 3],
        }),
        // AN5272, "Gyroscope self-test": ±2000 °/s, 208 Hz, 150 to 700 °/s.
        SelfTest::Excitation(ExcitationTest {
            sensor: Sensor::Gyro,
            prepare: &[Write(0x11, 0x5C), WaitUs(100_000)],
            on: &[Write(0x14, 0x04), WaitUs(100_000)],
            off: &[Write(0x14, 0x00), WaitUs(100_000)],
            per_lsb: 70e-3,
            within: [(150.0, 700.0); 3],
        }),
    ],
};

fn configure_lsm6dsox(s: &Setting) -> Vec<Step> {
    vec![
        // CTRL3_C: block update, address increment. CTRL9_XL: no I3C. CTRL4_C: by SPI no I2C.
        Write(0x12, 0x44),
        Write(0x18, 0xE2),
        Write(0x13, if s.spi { 0x04 } else { 0x00 }),
        Write(0x10, s.rate << 4 | s.accel << 2),
        Write(0x11, s.rate << 4 | s.gyro << 2),
        // COUNTER_BDR_REG1: data ready as pulses of 75 µs, as nobody reads the data registers. INT1_CTRL: the gyro's,
        // on INT1.
        Write(0x0B, 0x80),
        Write(0x0D, if s.data_ready { 0x02 } else { 0x00 }),
        // The gyro's turn-on time: ST's own examples give it 100 ms.
        WaitUs(100_000),
        // FIFO_CTRL3: both into the FIFO at their rate.
        Write(0x09, s.rate << 4 | s.rate),
    ]
}
