//! A scan of a kernel IIO buffer: which channels stand where in it, and their values in SI units.
//!
//! The kernel packs the enabled channels in the order of their index, each aligned to its own storage. A channel's type
//! reads `be:s16/16>>0`: byte order, sign, bits that count, bits that are stored, repeats, and shift (kernel.org, "Industrial
//! I/O", buffers).

use super::merge::Reading;
use crate::source::RANGE_END;
use crate::types::Nanos;
use glam::DVec3;

/// How a channel is stored, as its `_type` says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Storage {
    /// Whether the high byte comes first.
    pub big_endian: bool,
    /// Whether values are in two's complement.
    pub signed: bool,
    /// Bits of the value.
    pub bits: u32,
    /// Bytes of one value.
    pub bytes: usize,
    /// Values stored one after another, of which the first counts.
    pub repeat: usize,
    /// Bits below the value, which do not count.
    pub shift: u32,
}

impl Storage {
    /// `None` where the text is no type, or one that does not fit its storage.
    pub fn parse(text: &str) -> Option<Storage> {
        let (order, rest) = text.trim().split_once(':')?;
        // Whether it is the second of two words, or none of them.
        let second = |words: [&str; 2], word: &str| words.iter().position(|w| *w == word).map(|i| i == 1);
        let (big_endian, signed) = (second(["le", "be"], order)?, second(["u", "s"], rest.get(..1)?)?);
        let (bits, rest) = rest[1..].split_once('/')?;
        let (stored, shift) = rest.split_once(">>")?;
        let (stored, repeat) = match stored.split_once('X') {
            Some((stored, repeat)) => (stored, repeat.parse().ok()?),
            None => (stored, 1),
        };
        let (bits, stored, shift): (u32, u32, u32) = (bits.parse().ok()?, stored.parse().ok()?, shift.parse().ok()?);
        let fits = (1..=64).contains(&bits) && [8, 16, 32, 64].contains(&stored) && bits.checked_add(shift)? <= stored;
        let bytes = stored as usize / 8;
        (fits && (1..=4).contains(&repeat)).then_some(Storage { big_endian, signed, bits, bytes, repeat, shift })
    }

    /// The value that the first bytes hold.
    pub fn value(self, bytes: &[u8]) -> i64 {
        let mut word = [0u8; 8];
        for (i, byte) in bytes[..self.bytes].iter().enumerate() {
            word[if self.big_endian { self.bytes - 1 - i } else { i }] = *byte;
        }
        let unused = 64 - self.bits;
        let value = u64::from_le_bytes(word) >> self.shift << unused;
        if self.signed {
            value as i64 >> unused
        } else {
            (value >> unused) as i64
        }
    }

    /// End of what its bits can hold.
    fn end(self) -> f64 {
        f64::from(self.bits - u32::from(self.signed)).exp2() - 1.0
    }

    /// Whether a value stands at the end of what its bits can hold.
    fn saturated(self, value: i64) -> bool {
        value.unsigned_abs() as f64 >= RANGE_END * self.end() || !self.signed && value == 0
    }
}

/// A channel: an axis by its number, or another value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    Accel(usize),
    Gyro(usize),
    Temperature,
    Stamp,
    /// Enabled, but of no use here.
    Other,
}

/// The channel of a name in `scan_elements`, without `in_` and `_en`.
pub fn channel(name: &str) -> Channel {
    const KNOWN: [(&str, Channel); 8] = [
        ("accel_x", Channel::Accel(0)),
        ("accel_y", Channel::Accel(1)),
        ("accel_z", Channel::Accel(2)),
        ("anglvel_x", Channel::Gyro(0)),
        ("anglvel_y", Channel::Gyro(1)),
        ("anglvel_z", Channel::Gyro(2)),
        ("temp", Channel::Temperature),
        ("timestamp", Channel::Stamp),
    ];
    KNOWN.iter().find(|(known, _)| *known == name).map_or(Channel::Other, |(_, channel)| *channel)
}

/// A channel as its files describe it; its value is (raw + offset) * scale in the kernel's units (rad/s, m/s², m°C, ns).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Element {
    /// What it measures.
    pub channel: Channel,
    /// Place in the order of the scan.
    pub index: u32,
    /// How it is stored.
    pub storage: Storage,
    /// Added to the raw value, in its units.
    pub offset: f64,
    /// Kernel's units of one count.
    pub scale: f64,
}

/// The elements of a scan with the byte at which each stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Scan {
    elements: Vec<(usize, Element)>,
    /// Bytes of one scan.
    pub bytes: usize,
}

impl Scan {
    /// The scan of these elements, which may come in any order.
    pub fn new(mut elements: Vec<Element>) -> Scan {
        elements.sort_by_key(|e| e.index);
        let mut at = 0usize;
        let mut largest = 1;
        let mut placed = Vec::new();
        for element in elements {
            let size = element.storage.bytes * element.storage.repeat;
            at = at.next_multiple_of(size);
            placed.push((at, element));
            at += size;
            largest = largest.max(size);
        }
        Scan { elements: placed, bytes: at.next_multiple_of(largest) }
    }

    /// Whether it holds all three axes of a sensor.
    pub fn has_all(&self, axis: fn(usize) -> Channel) -> bool {
        (0..3).all(|i| self.elements.iter().any(|(_, e)| e.channel == axis(i)))
    }

    /// End of what the storage of an axis can hold to either side, in the kernel's units: the sensor's own range may end
    /// before it. `None` where zero is no value of it.
    pub fn range(&self, axis: Channel) -> Option<f64> {
        let (_, e) = self.elements.iter().find(|(_, e)| e.channel == axis)?;
        let (least, most) = (if e.storage.signed { -e.storage.end() } else { 0.0 }, e.storage.end());
        let reach = (most + e.offset).min(-(least + e.offset));
        (reach > 0.0).then_some(reach * e.scale.abs())
    }

    /// The reading of one scan, and its stamp where it has one; `raw` becomes the axes' raw values, accelerometer first.
    pub fn reading(&self, bytes: &[u8], raw: &mut [i64; 6]) -> (Reading, Option<Nanos>) {
        let (mut accel, mut gyro) = ([0.0; 3], [0.0; 3]);
        let mut reading = Reading::default();
        let mut stamp = None;
        for (at, element) in &self.elements {
            let value = element.storage.value(&bytes[*at..]);
            let si = (value as f64 + element.offset) * element.scale;
            match element.channel {
                Channel::Accel(i) => (accel[i], raw[i]) = (si, value),
                Channel::Gyro(i) => (gyro[i], raw[3 + i]) = (si, value),
                Channel::Temperature => reading.temperature_c = Some((si * 1e-3) as f32),
                Channel::Stamp => stamp = Some(Nanos(value)),
                Channel::Other => {}
            }
            let axis = matches!(element.channel, Channel::Accel(_) | Channel::Gyro(_));
            reading.saturated |= axis && element.storage.saturated(value);
        }
        reading.accel = self.has_all(Channel::Accel).then_some(DVec3::from(accel));
        reading.gyro = self.has_all(Channel::Gyro).then_some(DVec3::from(gyro));
        (reading, stamp)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn types_are_read_as_the_kernel_writes_them() {
        let storage = Storage::parse("be:s16/16>>0\n").unwrap();
        assert_eq!(storage, Storage { big_endian: true, signed: true, bits: 16, bytes: 2, repeat: 1, shift: 0 });
        assert_eq!(storage.value(&[0xFF, 0xFE, 9]), -2);
        let storage = Storage::parse("le:s12/16>>4").unwrap();
        assert_eq!((storage.value(&[0x0F, 0x80]), storage.value(&[0xF0, 0x7F])), (-2048, 2047));
        assert!(storage.saturated(2047) && storage.saturated(-2048) && !storage.saturated(-2026));
        let storage = Storage::parse("le:u24/32>>8").unwrap();
        assert_eq!(storage.value(&[9, 1, 0, 0x80]), 0x80_0001);
        let storage = Storage::parse("le:s64/64>>0").unwrap();
        assert_eq!(storage.value(&i64::MIN.to_le_bytes()), i64::MIN);
        assert_eq!(Storage::parse("be:s16/16X2>>0").unwrap().repeat, 2);
    }

    #[test]
    fn types_that_cannot_be_are_none() {
        for text in [
            "",
            "be",
            "xe:s16/16>>0",
            "be:f16/16>>0",
            "be:s17/16>>0",
            "be:s16/24>>0",
            "be:s16/16>>1",
            "le:s0/8>>0",
            "le:s16/16X9>>0",
            "le:s16/16>>-1",
            "le:s4294967295/64>>4294967295",
        ] {
            assert_eq!(Storage::parse(text), None, "{text}");
        }
    }

    fn element(channel: Channel, index: u32, storage: &str, offset: f64, scale: f64) -> Element {
        Element { channel, index, storage: Storage::parse(storage).unwrap(), offset, scale }
    }

    #[test]
    fn channels_are_aligned_to_their_storage_in_the_order_of_their_index() {
        let axes = (0..3).map(|i| element(Channel::Accel(i), i as u32, "be:s16/16>>0", 0.0, 0.5));
        let stamp = element(Channel::Stamp, 9, "le:s64/64>>0", 0.0, 1.0);
        let temperature = element(Channel::Temperature, 3, "be:s16/16>>0", 7011.0, 2.995);
        let scan = Scan::new(std::iter::once(stamp).chain(axes).chain([temperature]).collect());
        assert_eq!(scan.bytes, 16);
        let mut bytes = [0, 1, 0xFF, 0xFE, 0x7F, 0xFF, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        bytes[8..].copy_from_slice(&123_456_789i64.to_le_bytes());
        let mut raw = [0; 6];
        let (reading, t) = scan.reading(&bytes, &mut raw);
        assert_eq!((reading.accel, reading.gyro), (Some(DVec3::new(0.5, -1.0, 16383.5)), None));
        assert_eq!((t, reading.saturated, raw), (Some(Nanos(123_456_789)), true, [1, -2, 32767, 0, 0, 0]));
        assert!((reading.temperature_c.unwrap() - 20.998).abs() < 1e-3);
        let odd = Scan::new(vec![element(Channel::Other, 0, "le:u8/8>>0", 0.0, 1.0), stamp]);
        assert_eq!((odd.bytes, odd.elements[1].0), (16, 8));
    }

    /// Values are (raw + offset) * scale: the nearer end counts, and where zero is no value none is known.
    #[test]
    fn ranges_reach_as_far_to_either_side() {
        for (storage, offset, end) in [
            ("le:s12/16>>4", 0.0, Some(1023.5)),
            ("le:s12/16>>4", -47.0, Some(1000.0)),
            ("le:u12/16>>4", -2048.0, Some(1023.5)),
            ("le:u12/16>>4", -2000.0, Some(1000.0)),
            ("le:u12/16>>4", 0.0, None),
            ("le:u12/16>>4", -5000.0, None),
        ] {
            let scan = Scan::new(vec![element(Channel::Gyro(0), 0, storage, offset, -0.5)]);
            assert_eq!(scan.range(Channel::Gyro(0)), end, "{storage} {offset}");
        }
    }

    proptest! {
        #[test]
        fn any_type_and_bytes_are_read_or_refused(text in "[bl]e:[su][0-9]{1,3}/[0-9]{1,3}(X[0-9])?>>[0-9]{1,2}", bytes: [u8; 8]) {
            if let Some(storage) = Storage::parse(&text) {
                let value = storage.value(&bytes);
                prop_assert!(storage.bits == 64 || value.unsigned_abs() < 1 << storage.bits);
            }
        }
    }
}
