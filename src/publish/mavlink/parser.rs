//! MAVLink messages, version 1 and 2, from a stream of bytes that may hold anything.

use mavlink::dialects::common::{MavMessage, HEARTBEAT_DATA, TIMESYNC_DATA};
use mavlink::{calculate_crc, MavlinkVersion, Message, MessageData, MAV_STX, MAV_STX_V2};

/// Bytes of the longest message.
pub const LONGEST: usize = 280;
/// Bytes that are kept: a message that is not whole, and what one read gives.
const KEPT: usize = 4 * LONGEST;
/// Flag of version 2: a signature follows, of so many bytes.
const SIGNED: u8 = 1;
const SIGNATURE: usize = 13;

/// A message of a kind that is listened to.
#[derive(Clone, Debug, PartialEq)]
pub enum Heard {
    Heartbeat(HEARTBEAT_DATA),
    Timesync(TIMESYNC_DATA),
    /// Any other, or one of these with values that this version of the protocol does not know.
    Other,
}

/// A message, and who sent it.
#[derive(Clone, Debug, PartialEq)]
pub struct Received {
    pub system: u8,
    pub component: u8,
    pub heard: Heard,
}

/// Finds messages in bytes.
#[derive(Default)]
pub struct Parser {
    bytes: Vec<u8>,
    /// What comes next follows a byte that belongs to no message.
    is_lost: bool,
    /// Bytes so far that belong to no message.
    pub malformed: u64,
}

enum Found {
    Message(Received, usize),
    /// More bytes are needed.
    Part,
    None,
}

impl Parser {
    pub fn new() -> Parser {
        Parser { bytes: Vec::with_capacity(KEPT), is_lost: false, malformed: 0 }
    }

    /// Takes bytes, and gives each message in them to `hear`. `is_whole`: the bytes are a datagram, whose messages end with it.
    pub fn take(&mut self, mut bytes: &[u8], is_whole: bool, mut hear: impl FnMut(Received)) {
        while !bytes.is_empty() {
            let (now, later) = bytes.split_at(bytes.len().min(KEPT - self.bytes.len()));
            self.bytes.extend_from_slice(now);
            bytes = later;
            let mut at = 0;
            while at < self.bytes.len() {
                match find(&self.bytes[at..], self.is_lost) {
                    Found::Message(received, length) => {
                        (at, self.is_lost) = (at + length, false);
                        hear(received);
                    }
                    // Every message is shorter than what is kept, so that there is room for its rest.
                    Found::Part => break,
                    Found::None => {
                        (at, self.is_lost) = (at + 1, true);
                        self.malformed += 1;
                    }
                }
            }
            self.bytes.drain(..at);
        }
        if is_whole {
            self.malformed += self.bytes.len() as u64;
            self.bytes.clear();
            self.is_lost = false;
        }
    }
}

/// The message that begins with the first of some bytes. Where the place of beginnings `is_lost`, only one whose checksum is
/// known can show it.
fn find(bytes: &[u8], is_lost: bool) -> Found {
    let (version, header) = match bytes[0] {
        MAV_STX => (MavlinkVersion::V1, 6),
        MAV_STX_V2 => (MavlinkVersion::V2, 10),
        _ => return Found::None,
    };
    if bytes.len() < header {
        return Found::Part;
    }
    let (payload, is_v2) = (bytes[1] as usize, version == MavlinkVersion::V2);
    // A flag that is not known changes the form of the message.
    if is_v2 && bytes[2] & !SIGNED != 0 {
        return Found::None;
    }
    let signature = if is_v2 && bytes[2] & SIGNED != 0 { SIGNATURE } else { 0 };
    let end = header + payload;
    let length = end + 2 + signature;
    if bytes.len() < length {
        return Found::Part;
    }
    let (system, component, id) = if is_v2 {
        (bytes[5], bytes[6], u32::from_le_bytes([bytes[7], bytes[8], bytes[9], 0]))
    } else {
        (bytes[3], bytes[4], bytes[5].into())
    };
    let crc = MavMessage::extra_crc(id);
    let is_sound = calculate_crc(&bytes[1..end], crc).to_le_bytes() == bytes[end..end + 2];
    // What is of another dialect cannot be checked: it is one where the next follows it, or nothing.
    let is_foreign = crc == 0 && !is_lost && bytes.get(length).is_none_or(|next| [MAV_STX, MAV_STX_V2].contains(next));
    if !is_sound && !is_foreign {
        return Found::None;
    }
    let content = &bytes[header..end];
    let heard = match id {
        HEARTBEAT_DATA::ID => HEARTBEAT_DATA::deser(version, content).map(Heard::Heartbeat),
        TIMESYNC_DATA::ID => TIMESYNC_DATA::deser(version, content).map(Heard::Timesync),
        _ => Ok(Heard::Other),
    };
    Found::Message(Received { system, component, heard: heard.unwrap_or(Heard::Other) }, length)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use mavlink::dialects::common::ATTITUDE_DATA;
    use mavlink::{MAVLinkV1MessageRaw, MAVLinkV2MessageRaw, MavHeader};

    const HEADER: MavHeader = MavHeader { system_id: 1, component_id: 2, sequence: 3 };

    fn timesync(ts1: i64) -> TIMESYNC_DATA {
        TIMESYNC_DATA { tc1: 0, ts1, ..TIMESYNC_DATA::default() }
    }

    fn v2(data: &impl MessageData) -> Vec<u8> {
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message_data(HEADER, data);
        raw.raw_bytes().to_vec()
    }

    fn v1(data: &impl MessageData) -> Vec<u8> {
        let mut raw = MAVLinkV1MessageRaw::new();
        raw.serialize_message_data(HEADER, data);
        raw.raw_bytes().to_vec()
    }

    fn heard(parser: &mut Parser, bytes: &[u8], is_whole: bool) -> Vec<Heard> {
        let mut list = vec![];
        parser.take(bytes, is_whole, |received| {
            assert_eq!((received.system, received.component), (1, 2));
            list.push(received.heard);
        });
        list
    }

    #[test]
    fn messages_of_both_versions_are_found_in_a_stream_with_noise_however_it_is_cut() {
        // Noise may end in what looks like a beginning.
        let noise = [7, 0xfd, 0xfe, 0, 9, 0xfd, 200];
        let stream =
            [&noise[..], &v2(&timesync(5)), &v1(&timesync(6)), &v2(&ATTITUDE_DATA::default()), &noise].concat();
        let later = vec![v2(&timesync(7)); 20].concat();
        let stream = [stream, later].concat();
        let seven = Heard::Timesync(timesync(7));
        let mut all = vec![Heard::Timesync(timesync(5)), Heard::Timesync(timesync(6)), Heard::Other];
        all.extend(vec![seven; 20]);
        for cut in [1, 3, 17, 100, 5000] {
            let mut parser = Parser::new();
            let list: Vec<_> = stream.chunks(cut).flat_map(|bytes| heard(&mut parser, bytes, false)).collect();
            // A beginning that is none waits for what it announced, and is given up then.
            assert!(list.starts_with(&all[..list.len()]) && list.len() >= 22, "{cut}: {list:?}");
        }
    }

    #[test]
    fn datagram_ends_its_messages() {
        let (mut parser, one) = (Parser::new(), v2(&timesync(5)));
        assert_eq!(heard(&mut parser, &one[..20], true), []);
        assert_eq!((parser.malformed, parser.bytes.len()), (20, 0));
        assert_eq!(heard(&mut parser, &one, true), [Heard::Timesync(timesync(5))]);
    }

    #[test]
    fn flipped_bit_is_a_message_no_more() {
        let one = v2(&timesync(0x0102_0304_0506_0708));
        for bit in 0..8 * one.len() {
            let (mut parser, mut flipped) = (Parser::new(), one.clone());
            flipped[bit / 8] ^= 1 << (bit % 8);
            let list = heard(&mut parser, &flipped, true);
            // Of another id, it is one that cannot be checked.
            let is_id = (7..10).contains(&(bit / 8));
            assert!(list.is_empty() || is_id && list == [Heard::Other], "bit {bit}: {list:?}");
        }
    }
}
