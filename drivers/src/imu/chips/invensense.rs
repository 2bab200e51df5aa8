//! InvenSense (TDK): MPU-9250 and MPU-6500, ICM-20948, ICM-42688-P. Words are big-endian, the FIFO drops or overwrites
//! bytes when it is full.

use super::Step::{Change, Touch, WaitUs, Write};
use super::*;

/// Ranges of all of them, with the codes of the MPUs (register map RM-MPU-9250A-00, GYRO_CONFIG and
/// ACCEL_CONFIG) and the ICM-20948. A step is full scale over 2^15.
const ACCEL_RANGES: &[(f64, u8, f64)] =
    &[(2.0, 0, 2.0 / 32768.0), (4.0, 1, 4.0 / 32768.0), (8.0, 2, 8.0 / 32768.0), (16.0, 3, 16.0 / 32768.0)];
const GYRO_RANGES: &[(f64, u8, f64)] = &[
    (250.0, 0, 250.0 / 32768.0),
    (500.0, 1, 500.0 / 32768.0),
    (1000.0, 2, 1000.0 / 32768.0),
    (2000.0, 3, 2000.0 / 32768.0),
];

/// Register map, TEMP_OUT, with the sensitivity of product specification PS-MPU-9250A-01: (raw - 0) / 333.87 + 21.
const DEGREES: Temperature = Temperature { from: TemperatureFrom::Frames, c_per_lsb: 1.0 / 333.87, c_at_zero: 21.0 };

/// From here on the old FIFOs of 512 bytes are taken for full: of more than 32 frames ArduPilot met corrupt ones at their
/// end, and Linux leaves three frames for those that come while it reads.
const MPU_FULL: usize = 33 * 14;

/// Steps of the push where the factory left no codes (Criteria B of the same note): 60 °/s at ±250, 225 to 675 mg at ±2 g.
const GYRO_PUSH: (f64, f64) = (60.0 * 32768.0 / 250.0, f64::INFINITY);
const ACCEL_PUSH: (f64, f64) = (0.225 * 16384.0, 0.675 * 16384.0);

/// What the MPUs and the ICM-20948 frame: accelerometer, then by register order temperature or gyro.
const MPU_FRAME: Layout =
    Layout::Plain { len: 14, accel: Some(0), temperature: Some(6), gyro: Some(8), big_endian: true };
const ICM_20948_FRAME: Layout =
    Layout::Plain { len: 14, accel: Some(0), gyro: Some(6), temperature: Some(12), big_endian: true };

/// Checked against Linux's inv_mpu6050, ArduPilot and PX4; its registers are those of the MPU-6500.
pub const MPU_9250: Die = Die {
    name: "MPU-9250",
    // Register map, WHO_AM_I: 0x71; its sister MPU-9255 answers 0x73.
    who: 0x75,
    who_answers: &[0x71, 0x73],
    ..MPU_6500
};

/// Checked against Linux's inv_mpu6050 (which in the test's machine drives the same simulated chip), ArduPilot and PX4.
pub const MPU_6500: Die = Die {
    name: "MPU-6500",
    // Register map RM-MPU-6500A-00, WHO_AM_I.
    who: 0x75,
    who_answers: &[0x70],
    bank_select: None,
    spi_dummy: 0,
    accel: Some(Sense { ranges: ACCEL_RANGES, data: 0x3B, big_endian: true }),
    gyro: Some(Sense { ranges: GYRO_RANGES, data: 0x43, big_endian: true }),
    // Register map, SMPLRT_DIV: 1 kHz / (1 + SMPLRT_DIV) while the low-pass filter is on.
    rates: Rates::Divided { base_hz: 1000.0, code_max: 255 },
    temperature: DEGREES,
    fifo: Fifo {
        // Register map, FIFO_COUNTH and L; 512 bytes (product specification, "FIFO").
        count: 0x72,
        count_bytes: 2,
        count_big_endian: true,
        count_mask: 0x1FFF,
        overrun: 0,
        unit: 1,
        data: 0x74,
        capacity: 512,
        full: MPU_FULL,
        layout: MPU_FRAME,
        reset: MPU_FIFO_RESET,
    },
    // PWR_MGMT_1: H_RESET; at most 100 ms to the first register access (product specification, "Start-up time for
    // register read/write"); then the best clock there is.
    reset: &[Write(0x6B, 0x80), WaitUs(100_000), Write(0x6B, 0x01), WaitUs(1000)],
    configure: configure_mpu,
    cross_axis: None,
    self_tests: MPU_TESTS,
};

/// FIFO_EN: temperature, gyro, accelerometer. USER_CTRL: FIFO_EN, and FIFO_RST, which clears itself. As Linux and ArduPilot
/// have it, nothing is written to the FIFO meanwhile: half a frame in it would shift all that follow.
const MPU_FIFO_RESET: &[Step] =
    &[Write(0x23, 0x00), Change(0x6A, 0x40, 0x04), Change(0x6A, 0x00, 0x40), Write(0x23, 0xF8)];

fn configure_mpu(s: &Setting) -> Vec<Step> {
    // CONFIG and ACCEL_CONFIG 2, DLPF_CFG and A_DLPFCFG: the band next below half the rate, 41, 92 or 184 Hz.
    let band = match 1000.0 / (1.0 + f64::from(s.rate)) {
        hz if hz <= 120.0 => 3,
        hz if hz <= 250.0 => 2,
        _ => 1,
    };
    let mut steps = vec![
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
    ];
    steps.extend(MPU_FIFO_RESET);
    steps
}

/// Application note "MPU-Hardware Offset Registers and self-test" (AN-MPU-9250A-03): ±250 °/s and ±2 g, filters at 2.
const MPU_TESTS: &[SelfTest] = &[
    SelfTest::Factory(FactoryTest {
        of: Which::Gyro,
        prepare: &[Write(0x19, 0), Write(0x1A, 2), Write(0x1D, 2), Write(0x1B, 0), Write(0x1C, 0)],
        on: &[Write(0x1B, 0xE0)],
        off: &[Write(0x1B, 0x00)],
        codes: [0x00, 0x01, 0x02],
        base: 2620.0,
        ratio: (0.5, f64::INFINITY),
        uncoded: GYRO_PUSH,
        settle_us: 25_000,
    }),
    SelfTest::Factory(FactoryTest {
        of: Which::Accel,
        prepare: &[],
        on: &[Write(0x1C, 0xE0)],
        off: &[Write(0x1C, 0x00)],
        codes: [0x0D, 0x0E, 0x0F],
        base: 2620.0,
        ratio: (0.5, 1.5),
        uncoded: ACCEL_PUSH,
        settle_us: 25_000,
    }),
];

/// Data sheet DS-000189. The motion processor inside is not used.
///
/// Checked against ArduPilot, PX4 and Zephyr's icm20948; the self-test against InvenSense's drivers.
pub const ICM_20948: Die = Die {
    name: "ICM-20948",
    // WHO_AM_I.
    who: banked(0, 0x00),
    who_answers: &[0xEA],
    // REG_BANK_SEL, bits 5:4, in every bank.
    bank_select: Some((0x7F, 4)),
    spi_dummy: 0,
    accel: Some(Sense { ranges: ACCEL_RANGES, data: banked(0, 0x2D), big_endian: true }),
    gyro: Some(Sense { ranges: GYRO_RANGES, data: banked(0, 0x33), big_endian: true }),
    // GYRO_SMPLRT_DIV and ACCEL_SMPLRT_DIV: 1125 Hz / (1 + divider) for both while both run.
    rates: Rates::Divided { base_hz: 1125.0, code_max: 255 },
    // TEMP_OUT: as the MPUs.
    temperature: DEGREES,
    fifo: Fifo {
        // FIFO_COUNTH and L; 512 bytes.
        count: banked(0, 0x70),
        count_bytes: 2,
        count_big_endian: true,
        count_mask: 0x1FFF,
        overrun: 0,
        unit: 1,
        data: banked(0, 0x72),
        capacity: 512,
        full: MPU_FULL,
        layout: ICM_20948_FRAME,
        reset: ICM_20948_FIFO_RESET,
    },
    // PWR_MGMT_1: DEVICE_RESET, then awake on the best clock.
    reset: &[Write(banked(0, 0x06), 0x80), WaitUs(100_000), Write(banked(0, 0x06), 0x01), WaitUs(20_000)],
    configure: configure_icm_20948,
    cross_axis: None,
    self_tests: ICM_20948_TESTS,
};

/// FIFO_EN_2: accelerometer, gyro, temperature. USER_CTRL: FIFO_EN. FIFO_RST: assert and release. As ArduPilot has it,
/// nothing is written to the FIFO meanwhile.
const ICM_20948_FIFO_RESET: &[Step] = &[
    Write(banked(0, 0x67), 0x00),
    Change(banked(0, 0x03), 0x40, 0x00),
    Write(banked(0, 0x68), 0x1F),
    Write(banked(0, 0x68), 0x00),
    Change(banked(0, 0x03), 0x00, 0x40),
    Write(banked(0, 0x67), 0x1F),
];

fn configure_icm_20948(s: &Setting) -> Vec<Step> {
    // GYRO_CONFIG_1 and ACCEL_CONFIG: bands of 51, 120 or 152 Hz (gyro), 50, 111 or 246 Hz (accelerometer).
    let band = match 1125.0 / (1.0 + f64::from(s.rate)) {
        hz if hz <= 120.0 => 3,
        hz if hz <= 250.0 => 2,
        _ => 1,
    };
    let mut steps = vec![
        Write(banked(0, 0x07), 0x00),
        // USER_CTRL: by SPI the I2C interface off.
        Write(banked(0, 0x03), if s.spi { 0x10 } else { 0x00 }),
        Write(banked(2, 0x00), s.rate),
        Write(banked(2, 0x01), band << 3 | s.gyro << 1 | 1),
        // ODR_ALIGN_EN: both sensors start their samples together.
        Write(banked(2, 0x09), 0x01),
        Write(banked(2, 0x10), 0x00),
        Write(banked(2, 0x11), s.rate),
        Write(banked(2, 0x14), band << 3 | s.accel << 1 | 1),
        // INT_PIN_CFG and INT_ENABLE_1: active high, a pulse, raw data ready.
        Write(banked(0, 0x0F), 0x10),
        Write(banked(0, 0x11), u8::from(s.data_ready)),
        // The gyro's start-up time is 35 ms; Linux waits 70.
        WaitUs(70_000),
        // FIFO_MODE: takes no more when full.
        Write(banked(0, 0x69), 0x1F),
    ];
    steps.extend(ICM_20948_FIFO_RESET);
    steps
}

/// SELF_TEST_X_GYRO to Z_ACCEL (codes), GYRO_CONFIG_2 and ACCEL_CONFIG_2 (switches); the procedure is that of the MPUs.
const ICM_20948_TESTS: &[SelfTest] = &[
    SelfTest::Factory(FactoryTest {
        of: Which::Gyro,
        prepare: &[
            Write(banked(0, 0x07), 0x00),
            Write(banked(2, 0x00), 0x0A),
            Write(banked(2, 0x11), 0x0A),
            Write(banked(2, 0x01), 0x11),
            Write(banked(2, 0x14), 0x39),
        ],
        on: &[Write(banked(2, 0x02), 0x38)],
        off: &[Write(banked(2, 0x02), 0x00)],
        codes: [banked(1, 0x02), banked(1, 0x03), banked(1, 0x04)],
        base: 2620.0,
        ratio: (0.5, f64::INFINITY),
        uncoded: GYRO_PUSH,
        settle_us: 40_000,
    }),
    SelfTest::Factory(FactoryTest {
        of: Which::Accel,
        prepare: &[],
        on: &[Write(banked(2, 0x15), 0x1C)],
        off: &[Write(banked(2, 0x15), 0x00)],
        codes: [banked(1, 0x0E), banked(1, 0x0F), banked(1, 0x10)],
        base: 2620.0,
        ratio: (0.5, 1.5),
        uncoded: ACCEL_PUSH,
        settle_us: 40_000,
    }),
];

/// Data sheet DS-000347, register descriptions.
///
/// Checked against Linux's inv_icm42600, Zephyr's icm4268x, ArduPilot, PX4 and Betaflight; the self-test against InvenSense's
/// drivers. No data sheet has the bits of INTF_CONFIG1, nor the count that is 0 at first (Linux).
pub const ICM_42688_P: Die = Die {
    name: "ICM-42688-P",
    // WHO_AM_I.
    who: banked(0, 0x75),
    who_answers: &[0x47],
    // REG_BANK_SEL, bits 2:0.
    bank_select: Some((0x76, 0)),
    spi_dummy: 0,
    accel: Some(Sense {
        // ACCEL_CONFIG0.
        ranges: &[(2.0, 3, 2.0 / 32768.0), (4.0, 2, 4.0 / 32768.0), (8.0, 1, 8.0 / 32768.0), (16.0, 0, 16.0 / 32768.0)],
        data: banked(0, 0x1F),
        big_endian: true,
    }),
    gyro: Some(Sense {
        // GYRO_CONFIG0.
        ranges: &[
            (125.0, 4, 125.0 / 32768.0),
            (250.0, 3, 250.0 / 32768.0),
            (500.0, 2, 500.0 / 32768.0),
            (1000.0, 1, 1000.0 / 32768.0),
            (2000.0, 0, 2000.0 / 32768.0),
        ],
        data: banked(0, 0x25),
        big_endian: true,
    }),
    rates: Rates::Listed(&[(25.0, 10), (50.0, 9), (100.0, 8), (200.0, 7), (500.0, 15), (1000.0, 6), (2000.0, 5)]),
    // "FIFO", packet 3: the byte of the FIFO / 2.07 + 25.
    temperature: Temperature { from: TemperatureFrom::Frames, c_per_lsb: 1.0 / 2.07, c_at_zero: 25.0 },
    fifo: Fifo {
        // FIFO_COUNTH and L; 2 KiB ("FIFO"), and what the read path holds.
        count: banked(0, 0x2E),
        count_bytes: 2,
        count_big_endian: true,
        count_mask: 0xFFFF,
        overrun: 0,
        unit: 1,
        data: banked(0, 0x30),
        capacity: 2080,
        full: 2048 - 16 + 1,
        layout: Layout::Packet3,
        reset: ICM_42688_P_FIFO_RESET,
    },
    // DEVICE_CONFIG: soft reset, 1 ms; the read settles the interface.
    reset: &[Write(banked(0, 0x11), 0x01), WaitUs(2000), Touch(banked(0, 0x75))],
    configure: configure_icm_42688_p,
    cross_axis: None,
    self_tests: ICM_42688_P_TESTS,
};

/// SIGNAL_PATH_RESET: FIFO_FLUSH. The first count after it is always 0, whatever there is.
const ICM_42688_P_FIFO_RESET: &[Step] = &[Write(banked(0, 0x4B), 0x02), WaitUs(100), Touch(banked(0, 0x2E))];

fn configure_icm_42688_p(s: &Setting) -> Vec<Step> {
    let mut steps = vec![
        // INT_CONFIG and INT_CONFIG1: a pulse, push-pull, active high; INT_ASYNC_RESET off, as its text
        // demands for the pins to work.
        Write(banked(0, 0x14), 0x03),
        Write(banked(0, 0x64), 0x00),
        // INTF_CONFIG0: count in bytes, big-endian; by SPI the I2C interface off.
        Write(banked(0, 0x4C), 0x30 | if s.spi { 0x03 } else { 0x00 }),
        // INTF_CONFIG1, bits 7:6: no adaptive full scale. While it switches, at some 100 °/s, the gyro stands still for 1 to
        // 2 ms (ArduPilot, pull request 25332; Betaflight, 13132; PX4, 22254).
        Change(banked(0, 0x4D), 0xC0, 0x40),
        Write(banked(0, 0x4F), s.gyro << 5 | s.rate),
        Write(banked(0, 0x50), s.accel << 5 | s.rate),
        // PWR_MGMT0: both in low-noise mode; nothing may be written for 200 µs, the gyro needs 45 ms.
        Write(banked(0, 0x4E), 0x0F),
        WaitUs(60_000),
        // INT_SOURCE0: data ready on INT1.
        Write(banked(0, 0x65), if s.data_ready { 0x08 } else { 0x00 }),
        // FIFO_CONFIG1: temperature, gyro, accelerometer. FIFO_CONFIG: a stream.
        Write(banked(0, 0x5F), 0x07),
        Write(banked(0, 0x16), 0x40),
    ];
    steps.extend(ICM_42688_P_FIFO_RESET);
    steps
}

/// SELF_TEST_CONFIG; codes XG_ST_DATA of bank 1 and XA_ST_DATA of bank 2; at ±250 °/s and ±2 g, 1 kHz.
const ICM_42688_P_TESTS: &[SelfTest] = &[
    SelfTest::Factory(FactoryTest {
        of: Which::Gyro,
        prepare: &[Write(banked(0, 0x4F), 0x66), Write(banked(0, 0x50), 0x66), Write(banked(0, 0x4E), 0x0F)],
        on: &[Write(banked(0, 0x70), 0x07)],
        off: &[Write(banked(0, 0x70), 0x00)],
        codes: [banked(1, 0x5F), banked(1, 0x60), banked(1, 0x61)],
        base: 2620.0,
        ratio: (0.5, f64::INFINITY),
        uncoded: GYRO_PUSH,
        settle_us: 200_000,
    }),
    SelfTest::Factory(FactoryTest {
        of: Which::Accel,
        prepare: &[],
        on: &[Write(banked(0, 0x70), 0x78)],
        off: &[Write(banked(0, 0x70), 0x00)],
        codes: [banked(2, 0x3B), banked(2, 0x3C), banked(2, 0x3D)],
        base: 2620.0,
        ratio: (0.5, 1.5),
        // 50 to 1200 mg.
        uncoded: (0.05 * 16384.0, 1.2 * 16384.0),
        settle_us: 200_000,
    }),
];
