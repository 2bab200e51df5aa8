//! What the kernel says about this process: peak resident set and CPU time of a thread, read
//! from /proc. Reading allocates nothing, so sealed threads may ask.

use std::fs::File;
use std::io::Read;

/// Largest resident set so far, bytes; `None` where /proc is absent.
pub fn rss_peak_bytes() -> Option<u64> {
    let mut buffer = [0u8; 4096];
    let text = read_small("/proc/self/status", &mut buffer)?;
    let kib = text.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.split_whitespace().next()?;
    Some(kib.parse::<u64>().ok()? * 1024)
}

/// CPU time the calling thread has used, s. The scheduler refreshes it at ticks and switches, so
/// use it over spans of seconds, not of one frame.
pub fn thread_cpu_secs() -> Option<f64> {
    let mut buffer = [0u8; 128];
    let text = read_small("/proc/thread-self/schedstat", &mut buffer)?;
    Some(text.split_whitespace().next()?.parse::<u64>().ok()? as f64 * 1e-9)
}

fn read_small<'a>(path: &str, buffer: &'a mut [u8]) -> Option<&'a str> {
    let mut file = File::open(path).ok()?;
    let mut len = 0;
    while len < buffer.len() {
        match file.read(&mut buffer[len..]).ok()? {
            0 => break,
            n => len += n,
        }
    }
    std::str::from_utf8(&buffer[..len]).ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn peak_resident_set_grows_with_touched_memory() {
        let before = rss_peak_bytes().unwrap();
        let touched = std::hint::black_box(vec![1u8; 64 << 20]);
        let after = rss_peak_bytes().unwrap();
        assert!(after >= before && after >= touched.len() as u64, "{before} {after}");
    }

    #[test]
    fn sleeping_costs_no_cpu_time_and_spinning_does() {
        let start = thread_cpu_secs().unwrap();
        std::thread::sleep(Duration::from_millis(60));
        let slept = thread_cpu_secs().unwrap() - start;
        while thread_cpu_secs().unwrap() - start < 0.05 {
            std::hint::black_box(Instant::now());
        }
        assert!(slept < 0.04, "{slept}");
    }
}
