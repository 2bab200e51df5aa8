//! InvenSense (TDK): MPU-9250 and MPU-6500, ICM-20948, ICM-42688-P. Words are big-endian; a full FIFO drops or overwrites
//! bytes.

use super::Step::{Change, Touch, WaitUs, Write};
use super::*;

/// Gyro ranges of the MPUs (register map RM-MPU-9250A-00, GYRO_CONFIG) and the ICM-20948.
const GYRO_250_TO_2000: &[Range] = &[range(250.0, 0), range(500.0, 1), range(1000.0, 2), range(2000.0, 3)];

/// TEMP_OUT of the MPUs and the ICM-20948 (register map, and PS-MPU-9250A-01 for the sensitivity): raw / 333.87 + 21.
const DEGREES: Temperature = Temperature { from: TemperatureSource::Frames, c_per_lsb: 1.0 / 333.87, c_at_zero: 21.0 };

/// The FIFO of 512 bytes of the MPUs and the ICM-20948 (product specification, "FIFO"). It counts as full from 33 frames
/// on: beyond 32 ArduPilot met corrupt frames, and Linux leaves three frames for those that come while it reads.
const fn fifo_512(count: Reg, data: Reg, layout: Layout, reset: &'static [Step]) -> Fifo {
    Fifo {
        count,
        count_bytes: 2,
        count_mask: 0x1FFF,
        overrun: 0,
        unit: 1,
        data,
        capacity: 512,
        full: 33 * 14,
        layout,
        reset,
    }
}

/// The gyro's test at ±250 °/s, by application note AN-MPU-9250A-03: at least half the factory's answer, or 60 °/s where the
/// factory left no codes (criteria B).
const fn gyro_test(prepare: &'static [Step], switch: (Reg, u8), codes: Reg, settle_us: u32) -> SelfTest {
    let (ratio, uncoded) = ((0.5, f64::INFINITY), (60.0 * 32768.0 / 250.0, f64::INFINITY));
    SelfTest::Factory(FactoryTest { sensor: Sensor::Gyro, prepare, switch, codes, ratio, uncoded, settle_us })
}

/// The accelerometer's test at ±2 g after the gyro's, by the same note: half to one and a half of the factory's answer, or
/// `uncoded_g` where it left no codes.
const fn accel_test(switch: (Reg, u8), codes: Reg, uncoded_g: (f64, f64), settle_us: u32) -> SelfTest {
    let (ratio, uncoded) = ((0.5, 1.5), (uncoded_g.0 * 16384.0, uncoded_g.1 * 16384.0));
    SelfTest::Factory(FactoryTest { sensor: Sensor::Accel, prepare: &[], switch, codes, ratio, uncoded, settle_us })
}

/// Criteria B of AN-MPU-9250A-03 for the accelerometer, g.
const ACCEL_UNCODED_G: (f64, f64) = (0.225, 0.675);

/// Frames of the MPUs and of the ICM-20948: in the order of their registers.
const MPU_FRAME: Layout = Layout::Plain { len: 14, accel: Some(0), temperature: Some(6), gyro: Some(8) };
const ICM_20948_FRAME: Layout = Layout::Plain { len: 14, accel: Some(0), gyro: Some(6), temperature: Some(12) };

/// MPU-9250, whose registers are those of the MPU-6500.
///
/// Checked against Linux's inv_mpu6050, ArduPilot and PX4.
pub const MPU_9250: DieSpec = DieSpec {
    name: "MPU-9250",
    // Register map, WHO_AM_I: 0x71; its sister MPU-9255 answers 0x73.
    who: 0x75,
    who_answers: &[0x71, 0x73],
    ..MPU_6500
};

/// MPU-6500.
///
/// Checked against Linux's inv_mpu6050 (which drives the same simulated chip in tests/hil), ArduPilot and PX4.
pub const MPU_6500: DieSpec = DieSpec {
    name: "MPU-6500",
    // Register map RM-MPU-6500A-00, WHO_AM_I.
    who: 0x75,
    who_answers: &[0x70],
    bank_select: None,
    spi_dummy: 0,
    big_endian: true,
    accel: Some(SensorSpec { ranges: ACCEL_2_TO_16, data: 0x3B }),
    gyro: Some(SensorSpec { ranges: GYRO_250_TO_2000, data: 0x43 }),
    // Register map, SMPLRT_DIV: 1 kHz / (1 + SMPLRT_DIV) while the low-pass filter is on.
    rates: Rates::Divided { base_hz: 1000.0, code_max: 255 },
    temperature: DEGREES,
    // Register map, FIFO_COUNTH and FIFO_R_W.
    fifo: fifo_512(0x72, 0x74, MPU_FRAME, MPU_FIFO_RESET),
    // PWR_MGMT_1: H_RESET; at most 100 ms to the first register access (product specification, "Start-up time for
    // register read/write"); then the best clock there is.
    reset: &[Write(0x6B, 0x80), WaitUs(100_000), Write(0x6B, 0x01), WaitUs(1000)],
    configure: configure_mpu,
    cross_axis: None,
    self_tests: MPU_TESTS,
};

/// FIFO_EN: temperature, gyro, accelerometer. USER_CTRL: FIFO_EN, and FIFO_RST, which clears itself. As in Linux and
/// ArduPilot, nothing goes into the FIFO meanwhile: half a frame in it would shift all that follow.
const MPU_FIFO_RESET: &[Step] =
    &[Write(0x23, 0x00), Change(0x6A, 0x40, 0x04), Change(0x6A, 0x00, 0x40), Write(0x23, 0xF8)];

/// Code of the low-pass filter whose band is next below half the rate `base_hz / (1 + code)`.
fn band(base_hz: f64, code: u8) -> u8 {
    match base_hz / (1.0 + f64::from(code)) {
        hz if hz <= 120.0 => 3,
        hz if hz <= 250.0 => 2,
        _ => 1,
    }
}

fn configure_mpu(s: &Setting) -> Vec<Step> {
    // CONFIG and ACCEL_CONFIG 2, DLPF_CFG and A_DLPFCFG: 41, 92 or 184 Hz.
    let band = band(1000.0, s.rate);
    vec![
        // USER_CTRL: by SPI the I2C interface off.
        Write(0x6A, if s.spi { 0x10 } else { 0x00 }),
        Write(0x6C, 0x00),
        Write(0x19, s.rate),
        // CONFIG, FIFO_MODE: when full it takes no more, so that what is in it keeps its framing.
        Write(0x1A, 0x40 | band),
        Write(0x1B, s.gyro << 3),
        Write(0x1C, s.accel << 3),
        Write(0x1D, band),
        // INT_PIN_CFG and INT_ENABLE: active high, a pulse of 50 µs, raw data ready.
        Write(0x37, 0x10),
        Write(0x38, u8::from(s.data_ready)),
        // The gyro's start-up time is 35 ms; Linux waits 70.
        WaitUs(70_000),
    ]
}

/// Application note "MPU-Hardware Offset Registers and self-test" (AN-MPU-9250A-03): ±250 °/s and ±2 g, filters at 2.
const MPU_TESTS: &[SelfTest] = &[
    gyro_test(
        &[Write(0x19, 0), Write(0x1A, 2), Write(0x1D, 2), Write(0x1B, 0), Write(0x1C, 0)],
        (0x1B, 0xE0),
        0x00,
        25_000,
    ),
    accel_test((0x1C, 0xE0), 0x0D, ACCEL_UNCODED_G, 25_000),
];

/// ICM-20948. Data sheet DS-000189. The motion processor inside is not used.
///
/// Checked against ArduPilot, PX4 and Zephyr's icm20948; the self-test against InvenSense's drivers.
pub const ICM_20948: DieSpec = DieSpec {
    name: "ICM-20948",
    // WHO_AM_I.
    who: 0x00,
    who_answers: &[0xEA],
    // REG_BANK_SEL, bits 5:4, in every bank.
    bank_select: Some((0x7F, 4)),
    spi_dummy: 0,
    big_endian: true,
    accel: Some(SensorSpec { ranges: ACCEL_2_TO_16, data: 0x2D }),
    gyro: Some(SensorSpec { ranges: GYRO_250_TO_2000, data: 0x33 }),
    // GYRO_SMPLRT_DIV and ACCEL_SMPLRT_DIV: 1125 Hz / (1 + divider) for both while both run.
    rates: Rates::Divided { base_hz: 1125.0, code_max: 255 },
    temperature: DEGREES,
    // FIFO_COUNTH and FIFO_R_W.
    fifo: fifo_512(0x70, 0x72, ICM_20948_FRAME, ICM_20948_FIFO_RESET),
    // PWR_MGMT_1: DEVICE_RESET, then awake on the best clock.
    reset: &[Write(0x06, 0x80), WaitUs(100_000), Write(0x06, 0x01), WaitUs(20_000)],
    configure: configure_icm_20948,
    cross_axis: None,
    self_tests: ICM_20948_TESTS,
};

/// FIFO_EN_2: accelerometer, gyro, temperature. USER_CTRL: FIFO_EN. FIFO_RST: assert and release. As in ArduPilot, nothing
/// goes into the FIFO meanwhile.
const ICM_20948_FIFO_RESET: &[Step] = &[
    Write(0x67, 0x00),
    Change(0x03, 0x40, 0x00),
    Write(0x68, 0x1F),
    Write(0x68, 0x00),
    Change(0x03, 0x00, 0x40),
    Write(0x67, 0x1F),
];

fn configure_icm_20948(s: &Setting) -> Vec<Step> {
    // GYRO_CONFIG_1 and ACCEL_CONFIG: bands of 51, 120 or 152 Hz (gyro), 50, 111 or 246 Hz (accelerometer).
    let band = band(1125.0, s.rate);
    vec![
        Write(0x07, 0x00),
        // USER_CTRL: by SPI the I2C interface off.
        Write(0x03, if s.spi { 0x10 } else { 0x00 }),
        Write(banked(2, 0x00), s.rate),
        Write(banked(2, 0x01), band << 3 | s.gyro << 1 | 1),
        // ODR_ALIGN_EN: both sensors start their samples together.
        Write(banked(2, 0x09), 0x01),
        Write(banked(2, 0x10), 0x00),
        Write(banked(2, 0x11), s.rate),
        Write(banked(2, 0x14), band << 3 | s.accel << 1 | 1),
        // INT_PIN_CFG and INT_ENABLE_1: active high, a pulse, raw data ready.
        Write(0x0F, 0x10),
        Write(0x11, u8::from(s.data_ready)),
        // The gyro's start-up time is 35 ms; Linux waits 70.
        WaitUs(70_000),
        // FIFO_MODE: takes no more when full.
        Write(0x69, 0x1F),
    ]
}

/// SELF_TEST_X_GYRO to Z_ACCEL (codes), GYRO_CONFIG_2 and ACCEL_CONFIG_2 (switches); the procedure is that of the MPUs.
const ICM_20948_TESTS: &[SelfTest] = &[
    gyro_test(
        &[
            Write(0x07, 0x00),
            Write(banked(2, 0x00), 0x0A),
            Write(banked(2, 0x11), 0x0A),
            Write(banked(2, 0x01), 0x11),
            Write(banked(2, 0x14), 0x39),
        ],
        (banked(2, 0x02), 0x38),
        banked(1, 0x02),
        40_000,
    ),
    accel_test((banked(2, 0x15), 0x1C), banked(1, 0x0E), ACCEL_UNCODED_G, 40_000),
];

/// ICM-42688-P. Data sheet DS-000347, register descriptions.
///
/// Checked against Linux's inv_icm42600, Zephyr's icm4268x, ArduPilot, PX4 and Betaflight; the self-test against InvenSense's
/// drivers. The bits of INTF_CONFIG1, and that the first count is 0 (Linux), are in no data sheet.
pub const ICM_42688_P: DieSpec = DieSpec {
    name: "ICM-42688-P",
    // WHO_AM_I.
    who: 0x75,
    who_answers: &[0x47],
    // REG_BANK_SEL, bits 2:0.
    bank_select: Some((0x76, 0)),
    spi_dummy: 0,
    big_endian: true,
    accel: Some(SensorSpec {
        // ACCEL_CONFIG0.
        ranges: &[range(2.0, 3), range(4.0, 2), range(8.0, 1), range(16.0, 0)],
        data: 0x1F,
    }),
    // GYRO_CONFIG0.
    gyro: Some(SensorSpec { ranges: GYRO_125_TO_2000, data: 0x25 }),
    rates: Rates::Listed(&[(25.0, 10), (50.0, 9), (100.0, 8), (200.0, 7), (500.0, 15), (1000.0, 6), (2000.0, 5)]),
    // "FIFO", packet 3: the byte of the FIFO / 2.07 + 25.
    temperature: Temperature { from: TemperatureSource::Frames, c_per_lsb: 1.0 / 2.07, c_at_zero: 25.0 },
    fifo: Fifo {
        // FIFO_COUNTH and L; 2 KiB ("FIFO"), and what the read path holds.
        count: 0x2E,
        count_bytes: 2,
        count_mask: 0xFFFF,
        overrun: 0,
        unit: 1,
        data: 0x30,
        capacity: 2080,
        full: 2048 - 16 + 1,
        layout: Layout::Packet3,
        reset: ICM_42688_P_FIFO_RESET,
    },
    // DEVICE_CONFIG: soft reset, 1 ms; the read settles the interface.
    reset: &[Write(0x11, 0x01), WaitUs(2000), Touch(0x75)],
    configure: configure_icm_42688_p,
    cross_axis: None,
    self_tests: ICM_42688_P_TESTS,
};

/// SIGNAL_PATH_RESET: FIFO_FLUSH. The first count after it is always 0, whatever the FIFO holds.
const ICM_42688_P_FIFO_RESET: &[Step] = &[Write(0x4B, 0x02), WaitUs(100), Touch(0x2E)];

fn configure_icm_42688_p(s: &Setting) -> Vec<Step> {
    vec![
        // INT_CONFIG and INT_CONFIG1: a pulse, push-pull, active high; INT_ASYNC_RESET off, as its text
        // demands for the pins to work.
        Write(0x14, 0x03),
        Write(0x64, 0x00),
        // INTF_CONFIG0: count in bytes, big-endian; by SPI the I2C interface off.
        Write(0x4C, 0x30 | if s.spi { 0x03 } else { 0x00 }),
        // INTF_CONFIG1, bits 7:6: no adaptive full scale. While it switches, at some 100 °/s, the gyro stands still for 1 to
        // 2 ms (ArduPilot, pull request 25332; Betaflight, 13132; PX4, 22254).
        Change(0x4D, 0xC0, 0x40),
        Write(0x4F, s.gyro << 5 | s.rate),
        Write(0x50, s.accel << 5 | s.rate),
        // PWR_MGMT0: both in low-noise mode; nothing may be written for 200 µs, the gyro needs 45 ms.
        Write(0x4E, 0x0F),
        WaitUs(60_000),
        // INT_SOURCE0: data ready on INT1.
        Write(0x65, if s.data_ready { 0x08 } else { 0x00 }),
        // FIFO_CONFIG1: temperature, gyro, accelerometer. FIFO_CONFIG: a stream.
        Write(0x5F, 0x07),
        Write(0x16, 0x40),
    ]
}

/// SELF_TEST_CONFIG; codes XG_ST_DATA of bank 1 and XA_ST_DATA of bank 2; at ±250 °/s and ±2 g, 1 kHz.
const ICM_42688_P_TESTS: &[SelfTest] = &[
    gyro_test(&[Write(0x4F, 0x66), Write(0x50, 0x66), Write(0x4E, 0x0F)], (0x70, 0x07), banked(1, 0x5F), 200_000),
    accel_test((0x70, 0x78), banked(2, 0x3B), (0.05, 1.2), 200_000),
];
