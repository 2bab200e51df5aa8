//! How each chip behaves, as its data sheet has it, told apart from the driver's tables.
#![cfg(test)]

use super::simulated::{Model, PUSH};
use crate::imu::chips::Layout;

fn big(n: usize) -> [u8; 2] {
    (n as u16).to_be_bytes()
}

fn little(n: usize) -> [u8; 2] {
    (n as u16).to_le_bytes()
}

/// Full scale of a code.
fn pick(code: u8, of: &[f64]) -> f64 {
    32768.0 / of[usize::from(code)]
}

/// The simulated die of a chip's name.
pub fn model(name: &str, die: usize) -> Model {
    match (name, die) {
        ("mpu-6500", _) => mpu_6500(),
        ("mpu-9250", _) => Model { who: (0x75, 0x71), ..mpu_6500() },
        ("icm-20948", _) => icm_20948(),
        ("icm-42688-p", _) => icm_42688_p(),
        ("lsm6dsox", _) => lsm6dsox(),
        ("bmi270", _) => bmi270(),
        ("bmi088", 0) => bmi088_gyro(),
        ("bmi088", _) => bmi088_accel(),
        _ => panic!("no model of {name}"),
    }
}

fn mpu_6500() -> Model {
    Model {
        who: (0x75, 0x70),
        bank: None,
        reset: (0x6B, 0x80),
        on: |r| r[0][0x6A] & 0x40 != 0 && r[0][0x23] == 0xF8 && r[0][0x6B] == 1,
        rate_hz: |r| 1000.0 / (1.0 + f64::from(r[0][0x19])),
        per_g: |r| pick(r[0][0x1C] >> 3 & 3, &[2.0, 4.0, 8.0, 16.0]),
        per_dps: |r| pick(r[0][0x1B] >> 3 & 3, &[250.0, 500.0, 1000.0, 2000.0]),
        clears: |_, a, v| a == 0x6A && v & 4 != 0,
        count: 0x72,
        data: 0x74,
        capacity: 512,
        layout: Layout::Plain { len: 14, accel: Some(0), temperature: Some(6), gyro: Some(8) },
        counted: big,
        temperature: 3506,
        newest: [0x3B, 0x43],
        big: true,
        testing: |r| [f64::from(r[0][0x1C] >> 7) * PUSH, f64::from(r[0][0x1B] >> 7) * PUSH],
        codes: [(0, 0x0D), (0, 0x00)],
    }
}

fn icm_20948() -> Model {
    Model {
        who: (0x00, 0xEA),
        bank: Some((0x7F, 4)),
        reset: (0x06, 0x80),
        on: |r| r[0][0x03] & 0x40 != 0 && r[0][0x67] == 0x1F && r[0][0x06] == 1 && r[0][0x68] == 0,
        rate_hz: |r| if r[2][0] == r[2][0x11] { 1125.0 / (1.0 + f64::from(r[2][0])) } else { f64::NAN },
        per_g: |r| pick(r[2][0x14] >> 1 & 3, &[2.0, 4.0, 8.0, 16.0]),
        per_dps: |r| pick(r[2][0x01] >> 1 & 3, &[250.0, 500.0, 1000.0, 2000.0]),
        clears: |b, a, v| b == 0 && a == 0x68 && v == 0x1F,
        count: 0x70,
        data: 0x72,
        layout: Layout::Plain { len: 14, accel: Some(0), gyro: Some(6), temperature: Some(12) },
        newest: [0x2D, 0x33],
        testing: |r| [f64::from(r[2][0x15] >> 4) * PUSH, f64::from(r[2][0x02] >> 5) * PUSH],
        codes: [(1, 0x0E), (1, 0x02)],
        ..mpu_6500()
    }
}

fn icm_42688_p() -> Model {
    Model {
        who: (0x75, 0x47),
        bank: Some((0x76, 0)),
        reset: (0x11, 0x01),
        // INTF_CONFIG1 is 0x91 after a reset, of which the adaptive full scale is to be off.
        on: |r| r[0][0x16] == 0x40 && r[0][0x5F] == 0x07 && r[0][0x4E] == 0x0F && r[0][0x4D] == 0x51,
        rate_hz: |r| match (r[0][0x4F] & 15, r[0][0x50] & 15) {
            (7, 7) => 200.0,
            (6, 6) => 1000.0,
            _ => f64::NAN,
        },
        per_g: |r| pick(r[0][0x50] >> 5, &[16.0, 8.0, 4.0, 2.0]),
        per_dps: |r| pick(r[0][0x4F] >> 5, &[2000.0, 1000.0, 500.0, 250.0, 125.0]),
        clears: |b, a, v| b == 0 && a == 0x4B && v == 0x02,
        count: 0x2E,
        data: 0x30,
        capacity: 2048,
        layout: Layout::Packet3,
        temperature: 13,
        newest: [0x1F, 0x25],
        testing: |r| [f64::from(r[0][0x70] >> 5 & 1) * PUSH, f64::from(r[0][0x70] & 1) * PUSH],
        codes: [(2, 0x3B), (1, 0x5F)],
        ..mpu_6500()
    }
}

fn lsm6dsox() -> Model {
    Model {
        who: (0x0F, 0x6C),
        reset: (0x12, 0x01),
        on: |r| r[0][0x0A] == 0x16 && r[0][0x12] == 0x44,
        rate_hz: |r| match (r[0][0x10] >> 4, r[0][0x11] >> 4, r[0][0x09]) {
            (5, 5, 0x55) => 208.0,
            _ => f64::NAN,
        },
        per_g: |r| 1.0 / [0.061e-3, 0.488e-3, 0.122e-3, 0.244e-3][usize::from(r[0][0x10] >> 2 & 3)],
        per_dps: |r| 1.0 / [8.75e-3, 17.5e-3, 35e-3, 70e-3][usize::from(r[0][0x11] >> 2 & 3)],
        clears: |_, a, v| a == 0x0A && v == 0,
        count: 0x3A,
        data: 0x78,
        capacity: 3584,
        layout: Layout::Tagged,
        counted: |n| {
            let words = n / 7;
            // Watermark and overrun flags stand in the bits above the count.
            [words as u8, (words >> 8) as u8 | if words == 512 { 0xC8 } else { 0x80 }]
        },
        temperature: 1664,
        newest: [0x28, 0x22],
        big: false,
        testing: |r| [f64::from(r[0][0x14] & 1) * 1000.0 / 0.122, f64::from(r[0][0x14] >> 2 & 1) * 300.0 / 70e-3],
        codes: [(7, 0); 2],
        ..mpu_6500()
    }
}

fn bmi270() -> Model {
    Model {
        who: (0x00, 0x24),
        reset: (0x7E, 0xB6),
        on: |r| r[0][0x49] == 0xD0 && r[0][0x7D] == 0x0E && r[0][0x21] == 1 && r[0][0x7C] == 0,
        rate_hz: |r| match (r[0][0x40], r[0][0x42]) {
            (0xA9, 0xE9) => 200.0,
            (0xAA, 0xEA) => 400.0,
            _ => f64::NAN,
        },
        per_g: |r| pick(r[0][0x41], &[2.0, 4.0, 8.0, 16.0]),
        per_dps: |r| pick(r[0][0x43] & 7, &[2000.0, 1000.0, 500.0, 250.0, 125.0]),
        clears: |_, a, v| a == 0x7E && v == 0xB0,
        count: 0x24,
        data: 0x26,
        capacity: 2048,
        layout: Layout::Bosch { config: 4 },
        counted: little,
        temperature: 4352,
        newest: [0x0C, 0x12],
        big: false,
        // 16 g and its half of either sign: a push of ten counts each way.
        testing: |r| [if r[0][0x6D] == 0x0D { 9.0 * 2048.0 } else { -9.0 * 2048.0 }, 0.0],
        codes: [(7, 0); 2],
        ..mpu_6500()
    }
}

fn bmi088_gyro() -> Model {
    Model {
        who: (0x00, 0x0F),
        reset: (0x14, 0xB6),
        on: |r| r[0][0x3E] == 0x40,
        rate_hz: |r| [2000.0, 2000.0, 1000.0, 400.0, 200.0, 100.0, 200.0, 100.0][usize::from(r[0][0x10])],
        per_dps: |r| pick(r[0][0x0F], &[2000.0, 1000.0, 500.0, 250.0, 125.0]),
        clears: |_, a, _| a == 0x3E,
        count: 0x0E,
        data: 0x3F,
        capacity: 600,
        layout: Layout::Plain { len: 6, accel: None, gyro: Some(0), temperature: None },
        // With its flag of an overrun.
        counted: |n| [(n / 6) as u8 | if n == 600 { 0x80 } else { 0 }, 0],
        newest: [0; 2],
        codes: [(7, 0); 2],
        ..mpu_6500()
    }
}

fn bmi088_accel() -> Model {
    Model {
        who: (0x00, 0x1E),
        reset: (0x7E, 0xB6),
        on: |r| r[0][0x49] == 0x50 && r[0][0x7D] == 4 && r[0][0x7C] == 0,
        rate_hz: |r| match r[0][0x40] {
            0xA9 => 200.0,
            0xAA => 400.0,
            0xAB => 800.0,
            _ => f64::NAN,
        },
        per_g: |r| pick(r[0][0x41], &[3.0, 6.0, 12.0, 24.0]),
        clears: |_, a, v| a == 0x7E && v == 0xB0,
        count: 0x24,
        data: 0x26,
        capacity: 1024,
        layout: Layout::Bosch { config: 1 },
        counted: little,
        temperature: 68,
        newest: [0x12, 0x70],
        big: false,
        testing: |r| [if r[0][0x6D] == 0x0D { 900.0 } else { -900.0 }, 0.0],
        codes: [(7, 0); 2],
        ..mpu_6500()
    }
}
