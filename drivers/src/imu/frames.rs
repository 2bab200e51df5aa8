//! Bytes of a FIFO into samples, counts as the die gives them.
//!
//! Whatever the bytes are, parsing ends, gives no more samples than they can hold, and says what it could not read. A
//! frame that is cut off at the end is left out: the FIFOs that frame their samples give it again.

use super::chips::Layout;

/// One sample, in counts. A die with one sensor fills one of the two.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Raw {
    /// Acceleration, counts.
    pub accel: Option<[i16; 3]>,
    /// Angular velocity, counts.
    pub gyro: Option<[i16; 3]>,
    /// Temperature, counts.
    pub temperature: Option<i16>,
}

/// What a burst held beside its samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Parsed {
    /// Samples that the die says it dropped before these.
    pub skipped: usize,
    /// Frames that were marked invalid or have an unknown header; what follows an unknown header is left out.
    pub invalid: usize,
}

/// Parses bursts, and keeps what one burst leaves to the next.
#[derive(Clone, Debug)]
pub struct Parser {
    layout: Layout,
    big_endian: bool,
    /// Half a sample of tagged words: the number of its time slot, and the sensor that was there.
    half: Option<(u8, Raw)>,
    temperature: Option<i16>,
}

fn word(bytes: &[u8], at: usize, big_endian: bool) -> i16 {
    let pair = [bytes[at], bytes[at + 1]];
    if big_endian {
        i16::from_be_bytes(pair)
    } else {
        i16::from_le_bytes(pair)
    }
}

/// Three words from byte `at` on.
pub fn triple(bytes: &[u8], at: usize, big_endian: bool) -> [i16; 3] {
    [0, 2, 4].map(|i| word(bytes, at + i, big_endian))
}

impl Parser {
    /// A parser of a FIFO of this layout that has seen nothing yet.
    pub fn new(layout: Layout, big_endian: bool) -> Parser {
        Parser { layout, big_endian, half: None, temperature: None }
    }

    /// Forgets what the last burst left: the FIFO was cleared.
    pub fn reset(&mut self) {
        (self.half, self.temperature) = (None, None);
    }

    /// Appends the samples of a burst to `out`.
    pub fn parse(&mut self, bytes: &[u8], out: &mut Vec<Raw>) -> Parsed {
        match self.layout {
            Layout::Plain { len, accel, gyro, temperature } => {
                let mut parsed = Parsed::default();
                for frame in bytes.chunks_exact(len) {
                    let raw = Raw {
                        accel: accel.map(|at| triple(frame, at, self.big_endian)),
                        gyro: gyro.map(|at| triple(frame, at, self.big_endian)),
                        temperature: temperature.map(|at| word(frame, at, self.big_endian)),
                    };
                    // Seen by ArduPilot in the FIFO of the BMI088's gyro; no motion gives it.
                    if raw.gyro == Some([i16::MIN; 3]) {
                        parsed.invalid += 1;
                    } else {
                        out.push(raw);
                    }
                }
                parsed
            }
            Layout::Packet3 => packets(bytes, out),
            Layout::Bosch { config } => bosch(bytes, config, out),
            Layout::Tagged => self.tagged(bytes, out),
        }
    }

    /// Words of the LSM6DSOX, "FIFO_DATA_OUT_TAG": sensor in bits 7:3, number of the time slot in 2:1.
    fn tagged(&mut self, bytes: &[u8], out: &mut Vec<Raw>) -> Parsed {
        const GYRO: u8 = 0x01;
        const ACCEL: u8 = 0x02;
        const TEMPERATURE: u8 = 0x03;
        let mut parsed = Parsed::default();
        for word in bytes.chunks_exact(7) {
            let (tag, slot, values) = (word[0] >> 3, word[0] >> 1 & 3, triple(word, 1, false));
            if tag == TEMPERATURE {
                self.temperature = Some(values[0]);
                continue;
            }
            if tag != GYRO && tag != ACCEL {
                continue;
            }
            // A slot that ends with one sensor missing lost it in an overflow.
            let stale = self.half.take_if(|(of, _)| *of != slot);
            parsed.skipped += usize::from(stale.is_some());
            let (_, sample) = self.half.get_or_insert((slot, Raw::default()));
            if tag == GYRO {
                sample.gyro = Some(values);
            } else {
                sample.accel = Some(values);
            }
            if sample.gyro.is_some() && sample.accel.is_some() {
                out.push(Raw { temperature: self.temperature, ..*sample });
                self.half = None;
            }
        }
        parsed
    }
}

/// Packets of the ICM-42688-P, "FIFO packet structure", packet 3: header bits 7 (empty), 6 (accelerometer), 5 (gyro), 4 (20
/// bits).
fn packets(bytes: &[u8], out: &mut Vec<Raw>) -> Parsed {
    const BOTH: u8 = 0x60;
    const KIND: u8 = 0xF0;
    /// "FIFO header": the value of a sensor that has no sample yet.
    const NONE_YET: i16 = i16::MIN;
    let mut parsed = Parsed::default();
    for packet in bytes.chunks_exact(16) {
        let (accel, gyro) = (triple(packet, 1, true), triple(packet, 7, true));
        if packet[0] & KIND != BOTH || accel == [NONE_YET; 3] || gyro == [NONE_YET; 3] {
            parsed.invalid += 1;
            continue;
        }
        let temperature = Some(i16::from(packet[13] as i8));
        out.push(Raw { accel: Some(accel), gyro: Some(gyro), temperature });
    }
    parsed
}

/// Frames of Bosch's FIFOs, "FIFO frames": kind in bits 7:6 of the header, content in 5:2, interrupt tags in 1:0.
fn bosch(bytes: &[u8], config: usize, out: &mut Vec<Raw>) -> Parsed {
    const ACCEL: u8 = 0x84;
    const GYRO: u8 = 0x88;
    const BOTH: u8 = 0x8C;
    const SKIP: u8 = 0x40;
    const TIME: u8 = 0x44;
    const CONFIG: u8 = 0x48;
    const DROPPED: u8 = 0x50;
    const EMPTY: u8 = 0x80;
    let mut parsed = Parsed::default();
    let mut at = 0;
    while at < bytes.len() {
        let (kind, body) = (bytes[at] & 0xFC, at + 1);
        let len = match kind {
            ACCEL | GYRO => 6,
            BOTH => 12,
            SKIP | DROPPED => 1,
            TIME => 3,
            CONFIG => config,
            EMPTY => break,
            // Nothing behind a header that means nothing can be trusted.
            _ => {
                parsed.invalid += 1;
                break;
            }
        };
        let Some(frame) = bytes.get(body..body + len) else { break };
        match kind {
            ACCEL => out.push(Raw { accel: Some(triple(frame, 0, false)), ..Raw::default() }),
            // The gyro stands before the accelerometer. A frame of the gyro alone says that the other has not
            // started yet.
            BOTH => out.push(Raw {
                gyro: Some(triple(frame, 0, false)),
                accel: Some(triple(frame, 6, false)),
                temperature: None,
            }),
            SKIP => parsed.skipped += usize::from(frame[0]),
            _ => {}
        }
        at = body + len;
    }
    parsed
}

#[cfg(test)]
mod tests {
    use super::super::chips::{Chip, CHIPS};
    use super::*;
    use proptest::prelude::*;

    fn parser(name: &str, die: usize) -> Parser {
        let spec = &Chip::named(name).expect("driven").dies[die];
        Parser::new(spec.fifo.layout, spec.big_endian)
    }

    fn parse(mut parser: Parser, bytes: &[u8]) -> (Vec<Raw>, Parsed) {
        let mut out = vec![];
        let parsed = parser.parse(bytes, &mut out);
        (out, parsed)
    }

    #[test]
    fn plain_frames_are_read_in_their_chips_order() {
        let bytes = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 99];
        let mpu = Raw {
            accel: Some([0x0102, 0x0304, 0x0506]),
            temperature: Some(0x0708),
            gyro: Some([0x090A, 0x0B0C, 0x0D0E]),
        };
        assert_eq!(parse(parser("mpu-6500", 0), &bytes), (vec![mpu], Parsed::default()), "the cut frame is left out");
        let icm = Raw {
            accel: Some([0x0102, 0x0304, 0x0506]),
            gyro: Some([0x0708, 0x090A, 0x0B0C]),
            temperature: Some(0x0D0E),
        };
        assert_eq!(parse(parser("icm-20948", 0), &bytes).0, [icm]);
        let gyro = Raw { gyro: Some([-2, 0x0403, i16::MIN]), ..Raw::default() };
        let bytes = [0, 0x80, 0, 0x80, 0, 0x80, 0xFE, 0xFF, 3, 4, 0, 0x80];
        let (out, parsed) = parse(parser("bmi088", 0), &bytes);
        assert_eq!((out, parsed), (vec![gyro], Parsed { skipped: 0, invalid: 1 }), "nothing measures that");
    }

    #[test]
    fn headers_of_bosch_say_what_follows() {
        let accel = [0x84, 1, 0, 2, 0, 0xFF, 0xFF];
        let time = [0x44, 9, 9, 9];
        let skip = [0x40, 5];
        let dropped = [0x50, 0];
        let empty = [0x80, 0, 0];
        let bytes = [&accel[..], &time, &[0x48, 7], &skip, &dropped, &[0x87], &accel[1..], &empty].concat();
        let sample = Raw { accel: Some([1, 2, -1]), ..Raw::default() };
        let (out, parsed) = parse(parser("bmi088", 1), &bytes);
        assert_eq!((out, parsed), (vec![sample; 2], Parsed { skipped: 5, invalid: 0 }), "tags in bits 1:0 are no part");
        let both = [0x8C, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0];
        let bytes = [&[0x48, 7, 7, 7, 7][..], &both, &both[..9]].concat();
        let sample = Raw { gyro: Some([1, 2, 3]), accel: Some([4, 5, 6]), temperature: None };
        assert_eq!(parse(parser("bmi270", 0), &bytes), (vec![sample], Parsed::default()));
        let bytes = [&both[..], &[0x00], &both].concat();
        assert_eq!(parse(parser("bmi270", 0), &bytes), (vec![sample], Parsed { skipped: 0, invalid: 1 }));
    }

    #[test]
    fn packets_of_a_sensor_that_has_not_started_are_left_out() {
        let mut packet = [0x68, 0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0xFF, 0xFA, 0xF6, 0, 0];
        let sample = Raw { accel: Some([1, 2, 3]), gyro: Some([4, 5, -6]), temperature: Some(-10) };
        assert_eq!(parse(parser("icm-42688-p", 0), &packet).0, [sample]);
        packet[1..7].copy_from_slice(&[0x80, 0, 0x80, 0, 0x80, 0]);
        assert_eq!(parse(parser("icm-42688-p", 0), &packet), (vec![], Parsed { skipped: 0, invalid: 1 }));
        packet[0] = 0x80;
        assert_eq!(parse(parser("icm-42688-p", 0), &packet).1.invalid, 1);
    }

    fn tagged(tag: u8, slot: u8, values: [i16; 3]) -> Vec<u8> {
        std::iter::once(tag << 3 | slot << 1).chain(values.iter().flat_map(|v| v.to_le_bytes())).collect()
    }

    #[test]
    fn tagged_words_are_joined_by_their_slot_across_bursts() {
        let mut parser = parser("lsm6dsox", 0);
        let mut out = vec![];
        let words =
            [tagged(1, 0, [1, 2, 3]), tagged(2, 0, [4, 5, 6]), tagged(3, 0, [-512, 0, 0]), tagged(2, 1, [7; 3])];
        assert_eq!(parser.parse(&words.concat(), &mut out), Parsed::default());
        assert_eq!(out, [Raw { gyro: Some([1, 2, 3]), accel: Some([4, 5, 6]), temperature: None }]);
        out.clear();
        assert_eq!(parser.parse(&tagged(1, 1, [8; 3]), &mut out), Parsed::default());
        assert_eq!(out, [Raw { gyro: Some([8; 3]), accel: Some([7; 3]), temperature: Some(-512) }]);
    }

    #[test]
    fn half_a_slot_is_counted() {
        let words = [tagged(1, 0, [1; 3]), tagged(1, 1, [2; 3]), tagged(2, 1, [3; 3]), tagged(7, 1, [0; 3])].concat();
        let (out, parsed) = parse(parser("lsm6dsox", 0), &words);
        assert_eq!((out.len(), parsed), (1, Parsed { skipped: 1, invalid: 0 }));
    }

    proptest! {
        #[test]
        fn any_bytes_end_in_no_more_samples_than_fit(bytes in proptest::collection::vec(any::<u8>(), 0..3000)) {
            for die in CHIPS.iter().flat_map(|c| c.dies) {
                let (out, _) = parse(Parser::new(die.fifo.layout, die.big_endian), &bytes);
                prop_assert!(out.len() <= bytes.len() / die.fifo.layout.frame());
            }
        }
    }
}
