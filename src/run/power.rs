//! The power that is measured on the board and the energy of a run, by Linux's files.
//!
//! Sensors of power (hwmon) are summed, or the rail that feeds the others is read. Without such sensors the energy counters of x86
//! packages (powercap) are read, which Linux lets root alone do.

use super::governor::{entries, number, text};
use crate::publish::status::message::PowerStatus;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often it looks.
const PERIOD: Duration = Duration::from_secs(1);
/// Label of the rail that feeds the others, on Jetson Orin Nano and NX.
const INPUT: &str = "VDD_IN";
/// Channels of an INA3221: what else its driver lists are sums, and voltages of shunts.
const CHANNELS: [u32; 3] = [1, 2, 3];
/// A counter that grew faster than this, W, was set back meanwhile.
const PACKAGE_MAX_W: f64 = 1000.0;

/// Energy of a run as far as it could be measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Energy {
    pub joules: f64,
    /// Time that it was measured.
    pub seconds: f64,
}

/// Counter of a processor's energy, µJ.
struct Package {
    counter: PathBuf,
    /// Where it begins again.
    range: f64,
    last: (Instant, f64),
}

/// Sensors of power, and the energy so far.
pub struct PowerMeter {
    /// Files in µW, and pairs of files in mV and mA.
    powers: Vec<PathBuf>,
    rails: Vec<(PathBuf, PathBuf)>,
    packages: Vec<Package>,
    last: Instant,
    watts: Option<f64>,
    energy: Energy,
}

impl PowerMeter {
    /// The sensors under `sys`, which is /sys. Energy counts from `now`.
    pub fn find(sys: &Path, now: Instant) -> PowerMeter {
        let (mut powers, mut rails, mut inputs) = (vec![], vec![], vec![]);
        for hwmon in entries(&sys.join("class/hwmon"), "hwmon") {
            let ending = |end: &str| {
                let mut found = entries(&hwmon, "power");
                found.retain(|path| path.to_string_lossy().ends_with(end));
                found
            };
            let average = ending("_average");
            powers.extend(if average.is_empty() { ending("_input") } else { average });
            if text(hwmon.join("name")) != "ina3221" {
                continue;
            }
            for n in CHANNELS {
                let [voltage, current] = ["in", "curr"].map(|kind| hwmon.join(format!("{kind}{n}_input")));
                let feeds_all = text(hwmon.join(format!("in{n}_label"))) == INPUT;
                if voltage.exists() && current.exists() {
                    if feeds_all { &mut inputs } else { &mut rails }.push((voltage, current));
                }
            }
        }
        if !inputs.is_empty() {
            (powers, rails) = (vec![], inputs);
        }
        let mut packages = vec![];
        if powers.is_empty() && rails.is_empty() {
            let package = |zone: PathBuf| {
                let counter = zone.join("energy_uj");
                let range = number(&zone.join("max_energy_range_uj"))?;
                text(zone.join("name")).starts_with("package").then_some(())?;
                Some(Package { last: (now, number(&counter)?), counter, range })
            };
            packages = entries(&sys.join("class/powercap"), "intel-rapl:").into_iter().filter_map(package).collect();
        }
        PowerMeter { powers, rails, packages, last: now, watts: None, energy: Energy::default() }
    }

    /// Reads the sensors once a second; answers the power, W, that it read last.
    pub fn look(&mut self, now: Instant) -> Option<f64> {
        let elapsed = now.saturating_duration_since(self.last);
        if elapsed < PERIOD {
            return self.watts;
        }
        self.last = now;
        let elapsed_s = elapsed.as_secs_f64();
        let of_files = self.powers.iter().filter_map(|path| number(path)).map(|uw| uw * 1e-6);
        let of_rails = self.rails.iter().filter_map(|(v, i)| Some(number(v)? * number(i)? * 1e-6));
        let of_packages = self.packages.iter_mut().filter_map(|p| {
            let (then, before) = std::mem::replace(&mut p.last, (now, number(&p.counter)?));
            let joules = (p.last.1 - before).rem_euclid(p.range) * 1e-6;
            Some(joules / now.saturating_duration_since(then).as_secs_f64()).filter(|watts| *watts < PACKAGE_MAX_W)
        });
        self.watts = of_files.chain(of_rails).chain(of_packages).reduce(|a, b| a + b);
        if let Some(watts) = self.watts {
            self.energy.joules += watts * elapsed_s;
            self.energy.seconds += elapsed_s;
        }
        self.watts
    }

    /// `None` where nothing could be measured yet.
    pub fn energy(&self) -> Option<Energy> {
        Some(self.energy).filter(|energy| energy.seconds > 0.0)
    }

    /// What is told of it.
    pub fn status(&self) -> Option<PowerStatus> {
        Some(PowerStatus { watts: self.watts?, joules: self.energy.joules })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::governor::tests::write;
    use super::*;

    type Files<'a> = &'a [(&'a str, &'a str)];

    /// Powers after a second, and after two more where the files of `then` have changed; the energy then.
    fn after(files: Files, then: Files) -> ([Option<f64>; 2], Option<Energy>) {
        let (dir, start) = (tempfile::tempdir().unwrap(), Instant::now());
        write(dir.path(), files);
        let mut meter = PowerMeter::find(dir.path(), start);
        assert_eq!((meter.look(start + PERIOD / 2), meter.energy()), (None, None), "not yet");
        let first = meter.look(start + PERIOD);
        write(dir.path(), then);
        let second = meter.look(start + 3 * PERIOD);
        assert_eq!(meter.status().map(|s| s.watts), second);
        ([first, second], meter.energy())
    }

    fn near(got: Option<f64>, want: f64) {
        assert!(got.is_some_and(|got| (got - want).abs() < 1e-9), "{got:?}, not {want}");
    }

    /// An INA3221 with two channels, of 10 W and 3 W; shunts, sums and limits are none.
    const RAILS: [(&str, &str); 10] = [
        ("class/hwmon/hwmon2/name", "ina3221"),
        ("class/hwmon/hwmon2/in1_input", "5000"),
        ("class/hwmon/hwmon2/curr1_input", "2000"),
        ("class/hwmon/hwmon2/curr1_crit", "9000"),
        ("class/hwmon/hwmon2/in2_input", "1000"),
        ("class/hwmon/hwmon2/curr2_input", "3000"),
        ("class/hwmon/hwmon2/in4_input", "12000"),
        ("class/hwmon/hwmon2/curr4_input", "9999"),
        ("class/hwmon/hwmon2/in7_input", "12000"),
        ("class/hwmon/hwmon2/in7_label", "sum of shunt voltages"),
    ];
    const INPUT_RAIL: [(&str, &str); 2] =
        [("class/hwmon/hwmon2/in1_label", "VDD_IN"), ("class/hwmon/hwmon2/in2_label", "VDD_SOC")];
    const AMD: [(&str, &str); 3] = [
        ("class/hwmon/hwmon3/name", "amdgpu"),
        ("class/hwmon/hwmon3/power1_average", "1500000"),
        ("class/hwmon/hwmon3/power1_input", "7000000"),
    ];
    /// A sensor whose driver tells the power beside what it is the product of.
    const INA219: [(&str, &str); 4] = [
        ("class/hwmon/hwmon4/name", "ina219"),
        ("class/hwmon/hwmon4/in1_input", "5000"),
        ("class/hwmon/hwmon4/curr1_input", "400"),
        ("class/hwmon/hwmon4/power1_input", "2000000"),
    ];
    const COUNTER: &str = "class/powercap/intel-rapl:0/energy_uj";
    /// A package, its part, the same by another way, and the platform.
    const PACKAGES: [(&str, &str); 12] = [
        ("class/powercap/intel-rapl:0/name", "package-0"),
        (COUNTER, "90000000"),
        ("class/powercap/intel-rapl:0/max_energy_range_uj", "100000000"),
        ("class/powercap/intel-rapl:0:0/name", "core"),
        ("class/powercap/intel-rapl:0:0/energy_uj", "1000"),
        ("class/powercap/intel-rapl:0:0/max_energy_range_uj", "100000000"),
        ("class/powercap/intel-rapl-mmio:0/name", "package-0"),
        ("class/powercap/intel-rapl-mmio:0/energy_uj", "1000"),
        ("class/powercap/intel-rapl-mmio:0/max_energy_range_uj", "100000000"),
        ("class/powercap/intel-rapl:1/name", "psys"),
        ("class/powercap/intel-rapl:1/energy_uj", "1000"),
        ("class/powercap/intel-rapl:1/max_energy_range_uj", "100000000"),
    ];

    #[test]
    fn sensors_are_summed_unless_one_rail_feeds_the_others() {
        let all = [&RAILS[..], &AMD, &INA219, &PACKAGES].concat();
        let ([first, second], energy) = after(&all, &[("class/hwmon/hwmon2/in1_input", "0")]);
        near(first, 10.0 + 3.0 + 1.5 + 2.0);
        near(second, 6.5);
        near(energy.map(|e| e.joules), 16.5 + 2.0 * 6.5);
        near(energy.map(|e| e.seconds), 3.0);
        near(after(&[&all[..], &INPUT_RAIL].concat(), &[]).0[0], 10.0);
    }

    #[test]
    fn counters_of_packages_begin_again_at_their_range() {
        let others = ["intel-rapl:0:0", "intel-rapl-mmio:0", "intel-rapl:1"];
        let others = others.map(|zone| (format!("class/powercap/{zone}/energy_uj"), "4000000"));
        let mut then: Vec<_> = others.iter().map(|(name, uj)| (name.as_str(), *uj)).collect();
        then.push((COUNTER, "4000000"));
        let ([first, second], energy) = after(&PACKAGES, &then);
        near(first, 0.0);
        near(second, 7.0);
        near(energy.map(|e| e.joules), 14.0);
    }

    #[test]
    fn a_reading_that_fails_is_made_good_by_the_next_and_a_counter_set_back_is_none() {
        let (dir, start) = (tempfile::tempdir().unwrap(), Instant::now());
        write(dir.path(), &PACKAGES);
        write(dir.path(), &[("class/powercap/intel-rapl:0/max_energy_range_uj", "262143000000")]);
        let mut meter = PowerMeter::find(dir.path(), start);
        let mut at = |s: u32, uj: &str| {
            write(dir.path(), &[(COUNTER, uj)]);
            meter.look(start + s * PERIOD)
        };
        near(at(1, "95000000"), 5.0);
        assert_eq!(at(2, ""), None);
        near(at(3, "105000000"), 5.0);
        assert_eq!(at(4, "0"), None, "set back");
        near(at(5, "6000000"), 6.0);
    }

    #[test]
    fn a_machine_that_tells_nothing_has_no_energy() {
        assert_eq!(after(&[], &[]), ([None; 2], None));
        // Files that are there and say nothing.
        let silent = [("class/hwmon/hwmon2/power1_input", "off"), PACKAGES[0], (COUNTER, "")];
        assert_eq!(after(&[&RAILS[..1], &silent].concat(), &[]).1, None);
    }
}
