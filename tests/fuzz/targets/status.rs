//! Bytes from a reader of the status socket: the first byte says how they are cut.
#![no_main]

use libfuzzer_sys::fuzz_target;
use mio::net::UnixStream;
use std::io::Write;
use stipple::publish::status::client::Client;

fuzz_target!(|data: &[u8]| {
    let Some((how, data)) = data.split_first() else { return };
    let (ours, mut theirs) = UnixStream::pair().unwrap();
    let mut client = Client::new(ours);
    let (mut answered, mut ends) = (0, false);
    for bytes in data.chunks(1 + 4 * usize::from(*how)) {
        // A full socket takes less; what is left out was never sent.
        let _ = theirs.write(bytes);
        while let Some(requests) = client.read().filter(|requests| !requests.is_empty()) {
            assert!(!ends, "a refused connection asks no more");
            answered += requests.len();
            ends = requests.iter().any(Result::is_err);
            let fits = client.queue(b"an answer\n");
            assert!(fits || answered > 1000);
            client.write(&[]);
        }
    }
    assert!(answered <= data.iter().filter(|byte| **byte == b'\n').count() + 1);
});
