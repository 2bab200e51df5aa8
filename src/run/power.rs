//! The power that the board takes and the energy of a run, by Linux's files.
//!
//! Rails of the board (hwmon) are summed, or the one that feeds the others is read. Where there is none the energy counters of x86
//! packages (powercap) are read, which Linux lets root alone do.

use super::governor::{entries, number, text};
use crate::publish::status::message::PowerStatus;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often it looks.
const PERIOD: Duration = Duration::from_secs(1);
/// Labels of the rail that feeds the others, on Jetson Orin Nano and NX, and on Jetson Nano.
const INPUTS: [&str; 2] = ["VDD_IN", "POM_5V_IN"];

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
    last: f64,
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
            if !["ina3221", "ina219"].contains(&text(hwmon.join("name")).as_str()) {
                continue;
            }
            for current in entries(&hwmon, "curr") {
                // Each current has the voltage of its number; those of sums have none.
                let voltage = current.to_string_lossy().replace("/curr", "/in");
                let Some(rail) = voltage.strip_suffix("_input").filter(|_| Path::new(&voltage).exists()) else {
                    continue;
                };
                let feeds_all = INPUTS.contains(&text(format!("{rail}_label").into()).as_str());
                if feeds_all { &mut inputs } else { &mut rails }.push((PathBuf::from(voltage), current));
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
                Some(Package { last: number(&counter)?, counter, range })
            };
            packages = entries(&sys.join("class/powercap"), "").into_iter().filter_map(package).collect();
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
            let before = std::mem::replace(&mut p.last, number(&p.counter)?);
            Some((p.last - before).rem_euclid(p.range) * 1e-6 / elapsed_s)
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

    /// Powers after a second and after two, and the energy then.
    fn after(files: &[(&str, &str)], then: &[(&str, &str)]) -> ([Option<f64>; 2], Option<Energy>) {
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

    const RAILS: [(&str, &str); 6] = [
        ("class/hwmon/hwmon2/name", "ina3221"),
        ("class/hwmon/hwmon2/in1_input", "5000"),
        ("class/hwmon/hwmon2/curr1_input", "2000"),
        ("class/hwmon/hwmon2/in2_input", "1000"),
        ("class/hwmon/hwmon2/curr2_input", "3000"),
        ("class/hwmon/hwmon2/curr4_input", "9999"),
    ];
    const AMD: [(&str, &str); 3] = [
        ("class/hwmon/hwmon3/name", "amdgpu"),
        ("class/hwmon/hwmon3/power1_average", "1500000"),
        ("class/hwmon/hwmon3/power1_input", "7000000"),
    ];
    const PACKAGES: [(&str, &str); 5] = [
        ("class/powercap/intel-rapl:0/name", "package-0"),
        ("class/powercap/intel-rapl:0/energy_uj", "90000000"),
        ("class/powercap/intel-rapl:0/max_energy_range_uj", "100000000"),
        ("class/powercap/intel-rapl:0:0/name", "core"),
        ("class/powercap/intel-rapl:0:0/energy_uj", "1000"),
    ];

    #[test]
    fn rails_are_summed_and_the_one_that_feeds_the_others_is_not() {
        let ([first, second], energy) =
            after(&[&RAILS[..], &AMD, &PACKAGES].concat(), &[("class/hwmon/hwmon2/in1_input", "0")]);
        near(first, 10.0 + 3.0 + 1.5);
        near(second, 4.5);
        near(energy.map(|e| e.joules), 14.5 + 2.0 * 4.5);
        near(energy.map(|e| e.seconds), 3.0);
        let input = [("class/hwmon/hwmon2/in1_label", "VDD_IN"), ("class/hwmon/hwmon2/in2_label", "VDD_SOC")];
        near(after(&[&RAILS[..], &input].concat(), &[]).0[0], 10.0);
    }

    #[test]
    fn counters_of_energy_begin_again_at_their_range() {
        let then = [("class/powercap/intel-rapl:0/energy_uj", "4000000")];
        let ([first, second], energy) = after(&PACKAGES, &then);
        near(first, 0.0);
        near(second, 7.0);
        near(energy.map(|e| e.joules), 14.0);
    }

    #[test]
    fn a_machine_that_tells_nothing_has_no_energy() {
        assert_eq!(after(&[], &[]), ([None; 2], None));
        // Files that are there and say nothing.
        let hidden = [("class/powercap/intel-rapl:0/name", "package-0"), ("class/powercap/intel-rapl:0/energy_uj", "")];
        assert_eq!(after(&[&RAILS[..1], &[("class/hwmon/hwmon2/power1_input", "off")], &hidden].concat(), &[]).1, None);
    }
}
