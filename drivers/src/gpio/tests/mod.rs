//! Every call of both versions of libgpiod with every error, and the grid of the trigger.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

pub mod simulated;

use super::*;
use simulated::{FAILS, LEVELS, OPEN, SIGNALS, VERSION, WAITING};

const ERRNOS: [i32; 8] =
    [libc::EACCES, libc::EBUSY, libc::EINVAL, libc::EIO, libc::ENODEV, libc::ENOENT, libc::ENOTTY, libc::EPERM];

fn line(chip: &str, line: &str) -> LineName {
    LineName { chip: chip.into(), line: line.into() }
}

/// Runs a test with each version of the library.
fn with_each_version(test: impl Fn()) {
    for version in [1, 2] {
        VERSION.set(version);
        test();
        FAILS.set(("", 0));
        assert_eq!(OPEN.get(), 0, "version {version}");
    }
}

#[test]
fn every_error_of_every_call_of_opening_is_said_and_leaves_nothing_open() {
    const CALLS: [&[&str]; 2] = [
        &["open", "get line", "find line", "request"],
        &[
            "open",
            "information",
            "find offset",
            "settings",
            "direction",
            "edge",
            "lines",
            "add",
            "configuration",
            "request",
            "buffer",
        ],
    ];
    with_each_version(|| {
        for (errno, call) in ERRNOS.iter().flat_map(|e| CALLS[VERSION.get() as usize - 1].iter().map(|c| (*e, *c))) {
            let name = if call.starts_with("find") { "LED" } else { "3" };
            FAILS.set((call, errno));
            let (input, output) =
                (DataReady::open(&line("chip", name), Edge::Falling), Output::open(&line("chip", name), true));
            for fault in [input.map(|_| ()).unwrap_err(), output.map(|_| ()).unwrap_err()] {
                // Version 1 does not say why it has no such line.
                let said = if call.ends_with(" line") { libc::ENOENT } else { errno };
                assert!(
                    fault.to_string().contains(&std::io::Error::from_raw_os_error(said).to_string()),
                    "{call} {fault}"
                );
                assert!(fault.place == format!("GPIO chip line {name}") && !fault.fix.is_empty(), "{fault}");
            }
            assert_eq!(OPEN.get(), 0, "{call}");
        }
        assert!(Output::open(&line("a\0b", "3"), false).is_err(), "a name with a zero byte");
    });
}

#[test]
fn without_the_library_the_fault_says_what_was_looked_for_and_what_to_install() {
    VERSION.set(0);
    let (input, output) = (DataReady::open(&line("chip", "3"), Edge::Rising), Output::open(&line("chip", "3"), false));
    for fault in [input.map(|_| ()).unwrap_err(), output.map(|_| ()).unwrap_err()] {
        assert!(
            fault.to_string().starts_with("GPIO chip line 3") && fault.to_string().contains("libgpiod.so.3"),
            "{fault}"
        );
        assert!(fault.fix.contains("apt install libgpiod3"), "{fault}");
    }
}

#[test]
fn what_is_no_libgpiod_is_not_taken_for_one() {
    let said = library::load(&["libno-such-gpiod.so.3", "libc.so.6"]).map(|_| ()).unwrap_err();
    assert!(said.contains("libno-such-gpiod.so.3") && said.contains("gpiod_chip_open_lookup"), "{said}");
}

#[test]
fn version_2_finds_a_chip_by_its_label_name_number_and_path() {
    VERSION.set(2);
    for chip in ["chip", "gpiochip2", "2", "/dev/gpiochip2"] {
        assert!(Output::open(&line(chip, "3"), false).is_ok(), "{chip}");
    }
    for chip in ["ship", "gpiochip1", "12", "/dev/gpiochip1"] {
        let fault = Output::open(&line(chip, "3"), false).map(|_| ()).unwrap_err();
        assert!(fault.fix.starts_with("gpiodetect"), "{fault}");
    }
}

#[test]
fn every_error_of_an_input_is_a_value_and_a_signal_is_none() {
    with_each_version(|| {
        let mut input = DataReady::open(&line("chip", "3"), Edge::Rising).unwrap();
        let mut queue = EdgeQueue::default();
        for errno in ERRNOS {
            FAILS.set(("wait", errno));
            assert_eq!((input.wait(Span(1)), input.drain(&mut queue)), (Err(EdgeFault(errno)), Err(EdgeFault(errno))));
            WAITING.with_borrow_mut(|w| *w = vec![monotonic().0]);
            FAILS.set(("read", errno));
            assert_eq!(input.drain(&mut queue), Err(EdgeFault(errno)));
            FAILS.set(("request", errno));
            assert_eq!(input.reopen(), Err(EdgeFault(errno)));
            assert_eq!((input.wait(Span(0)), OPEN.get()), (Err(EdgeFault(libc::ENODEV)), 0));
            FAILS.set(("", 0));
            assert_eq!((input.reopen(), OPEN.get()), (Ok(()), VERSION.get() as usize));
        }
        FAILS.set(("wait", libc::EINTR));
        assert_eq!(input.wait(Span(1)), Ok(false));
        FAILS.set(("", 0));
        // More than one read takes.
        WAITING.with_borrow_mut(|w| *w = (0..EVENTS as i64 + 3).map(|i| monotonic().0 - 1000 + i).collect());
        assert_eq!(
            (input.drain(&mut queue), queue.stamps().len(), input.wait(Span(0))),
            (Ok(()), EVENTS + 3, Ok(false))
        );
    });
}

#[test]
fn every_error_of_an_output_is_said_and_the_next_pulse_is_tried() {
    with_each_version(|| {
        let mut trigger = Trigger::new(Output::open(&line("chip", "3"), false).unwrap(), Span(1000), 1000.0);
        for errno in ERRNOS {
            for call in ["set", "clear"] {
                FAILS.set((call, errno));
                let said = trigger.pulse().unwrap_err().to_string();
                assert!(said.starts_with("GPIO chip line 3"), "{said}");
            }
            FAILS.set(("", 0));
            trigger.wait();
            assert!(trigger.pulse().is_ok());
            assert!(LEVELS.with_borrow(|l| l.ends_with(&[1, 0])), "high, then low");
        }
    });
}

#[test]
fn a_signal_does_not_bring_a_pulse_forward() {
    with_each_version(|| {
        let mut trigger = Trigger::new(Output::open(&line("chip", "3"), false).unwrap(), Span(1000), 50.0);
        let due = trigger.due;
        SIGNALS.set(3);
        trigger.wait();
        assert!(SIGNALS.get() == 0 && monotonic() >= due);
    });
}

#[test]
fn every_errno_says_what_to_do() {
    let fix = |errno| cannot_use(&line("chip", "3"), errno).fix;
    assert!(fix(libc::EBUSY).contains("gpioinfo says which"));
    assert!(fix(libc::EACCES).contains("udev"));
    assert!(fix(libc::ENOTTY).contains("can do this"));
    assert!(fix(libc::ENOENT).contains("gpioinfo list"));
}

#[test]
fn pulses_keep_their_grid_however_late_one_is() {
    let (due, missed) = next_due(Nanos(100), Span(50), Nanos(103));
    assert_eq!((due, missed), (Nanos(150), 0));
    let (due, missed) = next_due(Nanos(100), Span(50), Nanos(260));
    assert_eq!((due, missed), (Nanos(300), 3), "150, 200 and 250 are over");
    assert_eq!(next_due(Nanos(100), Span(50), Nanos(40)).0, Nanos(150));
}
