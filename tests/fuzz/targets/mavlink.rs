//! Bytes from an autopilot's link: the first byte says how they are cut and whether they come as datagrams.
#![no_main]

use libfuzzer_sys::fuzz_target;
use stipple::publish::mavlink::parser::Parser;

fuzz_target!(|data: &[u8]| {
    let Some((how, data)) = data.split_first() else { return };
    let (cut, is_whole) = (1 + usize::from(how >> 1), how & 1 == 1);
    let mut parser = Parser::new();
    let mut found = 0;
    data.chunks(cut).for_each(|bytes| parser.take(bytes, is_whole, |_| found += 1));
    // A message is eight bytes at least.
    assert!(8 * found + parser.malformed <= data.len() as u64);
});
