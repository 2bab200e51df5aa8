//! libgpiod itself, where there is no chip: lines that work are driven in the virtual machine (tests/hil).
#![allow(clippy::unwrap_used)]

use stipple_drivers::gpio::{DataReady, Edge, LineName, Output};
use stipple_drivers::FaultKind;

#[test]
fn what_is_no_chip_is_refused_with_what_to_do() {
    let line = |chip: &str| LineName { chip: chip.into(), line: "3".into() };
    let fault = DataReady::open(&line("no-such-chip"), Edge::Rising).map(|_| ()).unwrap_err();
    assert!(fault.to_string().contains("no-such-chip line 3") && fault.to_string().contains("gpiodetect"), "{fault}");
    let fault = Output::open(&line("/dev/null"), true).map(|_| ()).unwrap_err();
    assert_eq!(fault.kind, FaultKind::Unavailable);
}
