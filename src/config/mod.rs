//! Board files: strict TOML (unknown keys are refused), units in every name, each key declared once (`section`).
//!
//! A board file states what the board is (`name`, `memory_max_mib`), its `[budget]`, its sensors, and where it departs from
//! the defaults of the method. `--set section.key=value` edits the parsed table before it is checked, so an override obeys the
//! same rules as the file. board-configs/README.md lists every key; tests/config.rs writes it.

mod governor;
mod inject;
mod mavlink;
mod method;
#[cfg(feature = "instruments")]
mod profile;
mod section;
mod sensors;

pub use governor::GovernorConfig;
pub use inject::{InjectConfig, ThreadRule};
pub use mavlink::{Address, MavlinkConfig, StateMessage};
pub use method::{
    Fit, FrontendConfig, GpuConfig, LoopsConfig, MapConfig, NetworkConfig, Projection, StereoConfig, StereoMethod,
    StoreConfig, VioConfig,
};
#[cfg(feature = "instruments")]
pub use profile::{Profile, PROFILES};
pub use section::{Bound, Key};
pub use sensors::{BaroConfig, CameraConfig, GpioConfig, ImuConfig, LogConfig, RecordConfig, RigConfig};

use section::section;
use sensors::Wrong;
use serde::{Deserialize, Serialize};
use std::path::Path;
use stipple_drivers::{input, Fault, FaultKind};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    pub name: String,
    pub memory_max_mib: u64,
    pub budget: Budget,
    #[serde(default)]
    pub rig: RigConfig,
    #[serde(default)]
    pub camera: CameraConfig,
    #[serde(default)]
    pub imu: ImuConfig,
    #[serde(default)]
    pub baro: BaroConfig,
    #[serde(default)]
    pub gpio: GpioConfig,
    #[serde(default)]
    pub record: RecordConfig,
    #[serde(default)]
    pub log: LogConfig,
    #[serde(default)]
    pub governor: GovernorConfig,
    #[serde(default)]
    pub mavlink: MavlinkConfig,
    #[serde(default)]
    pub frontend: FrontendConfig,
    #[serde(default)]
    pub vio: VioConfig,
    #[serde(default)]
    pub stereo: StereoConfig,
    #[serde(default)]
    pub map: MapConfig,
    #[serde(default)]
    pub store: StoreConfig,
    #[serde(default)]
    pub loops: LoopsConfig,
    #[serde(default)]
    pub gpu: GpuConfig,
}

/// The keys above all sections.
const TOP: &[Key] = &[
    Key { name: "name", doc: " Name of the board, for the report.", bound: Bound::Any },
    Key {
        name: "memory_max_mib",
        doc: " The board is refused when its memory table exceeds this. Set it to what the other programs of the board leave.",
        bound: Bound::Within(16.0, 1_048_576.0),
    },
];

section! {
    /// Capacities bought at boot. Every one is a hard limit; what is full is counted, never grown.
    Budget, "budget.", required;
    /// Gaussians in the pool: 192 bytes each on the GPU. As many as the GPU trains at a few steps a frame.
    splats: u32, Bound::Within(256.0, 4_000_000.0);
    /// (Gaussian, tile) pairs of one view, 40 bytes each; a view that needs more is drawn coarser. 13 to 25 for each Gaussian.
    intersections: u32, Bound::Within(1024.0, 64_000_000.0);
    /// Keyframes that the mapper keeps to train and evaluate on. One comes a second, so this is the length of a flight.
    keyframes: u32, Bound::Within(2.0, 4096.0);
    /// Widest camera image that the board accepts.
    image_width_max: u32, Bound::Within(96.0, 4096.0);
    /// Highest camera image that the board accepts.
    image_height_max: u32, Bound::Within(96.0, 4096.0);
}

/// Every key of a board file, section by section.
pub fn keys() -> impl Iterator<Item = &'static Key> {
    let sections = [
        TOP,
        Budget::KEYS,
        RigConfig::KEYS,
        CameraConfig::KEYS,
        ImuConfig::KEYS,
        BaroConfig::KEYS,
        GpioConfig::KEYS,
        RecordConfig::KEYS,
        LogConfig::KEYS,
        GovernorConfig::KEYS,
        MavlinkConfig::KEYS,
        FrontendConfig::KEYS,
        VioConfig::KEYS,
        StereoConfig::KEYS,
        NetworkConfig::KEYS,
        MapConfig::KEYS,
        StoreConfig::KEYS,
        LoopsConfig::KEYS,
        GpuConfig::KEYS,
    ];
    // A key that is a section of its own has its keys listed.
    sections.into_iter().flatten().filter(|key| key.name != "stereo.network")
}

impl Board {
    /// Reads a board file, applies `key.path=value` overrides, validates.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Board, Fault> {
        let place = path.display().to_string();
        let text = input::read_settings(path).map_err(|e| match e.kind() {
            std::io::ErrorKind::InvalidData => {
                Fault::new(FaultKind::Config, &place, "is not text", "save the board file as UTF-8")
            }
            _ => {
                let what = format!("cannot read the board file: {e}");
                Fault::new(FaultKind::NoInput, &place, what, "name one, such as those of board-configs/")
            }
        })?;
        Board::parse(&place, &text, overrides)
    }

    /// Parses the text of a board file, `place` in errors, applies overrides, validates.
    pub fn parse(place: &str, text: &str, overrides: &[String]) -> Result<Board, Fault> {
        // Checked as written first, so that an error names the line of the file.
        let mut board: Board = toml::from_str(text).map_err(|e| in_file(place, text, &e))?;
        let mut table: toml::Table = toml::from_str(text).map_err(|e| in_file(place, text, &e))?;
        let mut constants = vec![];
        for assignment in overrides {
            let (key, value) = parse_assignment(assignment)?;
            if board.tune(key, &value) {
                constants.push((key, value));
                continue;
            }
            set(&mut table, assignment, key, value)?;
            // After each, so that the one that is wrong is the one that is named.
            board = Board::deserialize(table.clone()).map_err(|e| in_override(assignment, e.message()))?;
        }
        // Deserializing anew has put them back.
        for (key, value) in &constants {
            board.tune(key, value);
        }
        board.validate().map_err(|(key, what)| {
            let set_by = overrides.iter().rev().find(|o| o.split('=').next().is_some_and(|k| k.trim() == key));
            let at = match (set_by, line_of(text, key)) {
                (Some(assignment), _) => shown(assignment),
                (None, Some(line)) => format!("{place}:{line}"),
                (None, None) => format!("{place} (default)"),
            };
            Fault::new(FaultKind::Config, at, what, format!("change {key}"))
        })?;
        Ok(board)
    }

    /// Sets a constant of the method, for instruments; false where the key is none.
    #[cfg(feature = "instruments")]
    fn tune(&mut self, key: &str, value: &toml::Value) -> bool {
        match key.split_once('.') {
            Some(("frontend", name)) => self.frontend.tune(name, value),
            Some(("vio", name)) => self.vio.tune(name, value),
            Some(("stereo", name)) if name.starts_with("network.") => self.stereo.network.tune(&name[8..], value),
            Some(("stereo", name)) => self.stereo.tune(name, value),
            Some(("map", name)) => self.map.tune(name, value),
            Some(("gpu", name)) => self.gpu.tune(name, value),
            _ => false,
        }
    }

    /// The value of a key of the board, or of a constant of the method.
    #[cfg(feature = "instruments")]
    pub fn value(&self, key: &str) -> Option<toml::Value> {
        let table = toml::Table::try_from(self).ok()?;
        lookup(&table, key).cloned().or_else(|| match key.split_once('.')? {
            ("frontend", name) => self.frontend.constant(name),
            ("vio", name) => self.vio.constant(name),
            ("stereo", name) => self.stereo.constant(name).or_else(|| self.stereo.network.constant(name)),
            ("map", name) => self.map.constant(name),
            ("gpu", name) => self.gpu.constant(name),
            _ => None,
        })
    }

    #[cfg(not(feature = "instruments"))]
    fn tune(&mut self, _: &str, _: &toml::Value) -> bool {
        false
    }

    /// The first key that is out of bounds or contradicts another, and what is wrong with it.
    fn validate(&self) -> Result<(), Wrong> {
        let table = toml::Table::try_from(self).expect("a board is a table of numbers, strings and booleans");
        for Key { name, bound, .. } in keys() {
            let value = lookup(&table, name).expect("every key is a field of the board");
            let number = value.as_float().or(value.as_integer().map(|i| i as f64)).unwrap_or(f64::NAN);
            if !bound.holds(number) {
                return Err((name, format!("{name} = {value} must be {bound}")));
            }
        }
        let rules = [
            (
                self.stereo.network.normalises(),
                "stereo.network.deviation",
                "must be three positive numbers, stereo.network.mean three finite ones",
            ),
            (self.stereo.depth_max_m > self.stereo.depth_min_m, "stereo.depth_max_m", "must exceed stereo.depth_min_m"),
            (
                self.budget.intersections >= self.budget.splats,
                "budget.intersections",
                "must not be less than budget.splats: a Gaussian in view covers at least one tile",
            ),
        ];
        let broken =
            rules.into_iter().find(|(holds, _, _)| !holds).map(|(_, key, rule)| (key, format!("{key} {rule}")));
        let wrong = broken.or_else(|| self.camera.wrong()).or_else(|| self.baro.wrong()).or_else(|| self.gpio.wrong());
        let wrong = wrong.or_else(|| self.mavlink.wrong());
        wrong.or_else(|| self.imu.wrong(&self.gpio)).map_or(Ok(()), Err)
    }
}

fn lookup<'a>(table: &'a toml::Table, key: &str) -> Option<&'a toml::Value> {
    match key.split_once('.') {
        Some((section, rest)) => lookup(table.get(section)?.as_table()?, rest),
        None => table.get(key),
    }
}

/// Line of the file on which a key stands.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let document = toml::de::DeTable::parse(text).ok()?;
    let mut parts = key.split('.');
    let mut value = document.get_ref().get(parts.next()?)?;
    for part in parts {
        value = value.get_ref().get(part)?;
    }
    Some(line_at(text, value.span().start))
}

fn line_at(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|b| **b == b'\n').count()
}

fn in_file(place: &str, text: &str, e: &toml::de::Error) -> Fault {
    // A missing key has no place of its own: the span is empty or the whole table.
    let line = e.span().filter(|s| !s.is_empty()).map(|s| line_at(text, s.start));
    let at = line.map_or(place.to_string(), |l| format!("{place}:{l}"));
    let written = line.and_then(|l| text.lines().nth(l - 1)).map_or(String::new(), |l| format!(" (`{}`)", l.trim()));
    Fault::new(FaultKind::Config, at, format!("{}{written}", plain(e.message())), "board-configs/ shows every section")
}

/// What the parser says, on one line and with types as a stranger calls them.
fn plain(message: &str) -> String {
    let types = [("expected f64", "expected a number"), ("expected u32", "expected a whole number, not negative")];
    types.iter().fold(message.replace('\n', " "), |said, (of_rust, word)| said.replace(of_rust, word))
}

/// An override as part of a one-line message.
fn shown(assignment: &str) -> String {
    format!("--set {}", assignment.replace('\n', "\\n"))
}

fn in_override(assignment: &str, what: &str) -> Fault {
    let fix = "write section.key=value with a key of board-configs/";
    Fault::new(FaultKind::Config, shown(assignment), plain(what), fix)
}

/// The key and the value of one `a.b=value`; the value is TOML, and a bare word is a string.
fn parse_assignment(assignment: &str) -> Result<(&str, toml::Value), Fault> {
    let wrong = |what: &str| Fault::new(FaultKind::Usage, shown(assignment), what, "write --set section.key=value");
    let (key, value) = assignment.split_once('=').ok_or_else(|| wrong("there is no '='"))?;
    let parsed: toml::Table = toml::from_str(&format!("v = {value}"))
        .or_else(|_| toml::from_str(&format!("v = {value:?}")))
        .map_err(|_| wrong("the value is not TOML"))?;
    // A line break could smuggle in a second key.
    let value = parsed.get("v").filter(|_| parsed.len() == 1).ok_or_else(|| wrong("the value is not one value"))?;
    Ok((key.trim(), value.clone()))
}

/// Puts the value of an assignment into the table of a board.
fn set(table: &mut toml::Table, assignment: &str, key: &str, value: toml::Value) -> Result<(), Fault> {
    let wrong = |what: &str| Fault::new(FaultKind::Usage, shown(assignment), what, "write --set section.key=value");
    let mut at = table;
    let mut parts: Vec<&str> = key.split('.').collect();
    let last = parts.pop().filter(|k| !k.is_empty()).ok_or_else(|| wrong("there is no key before '='"))?;
    for part in parts {
        at = at
            .entry(part)
            .or_insert_with(|| toml::Value::Table(toml::Table::new()))
            .as_table_mut()
            .ok_or_else(|| wrong(&format!("`{part}` is a value, not a section")))?;
    }
    at.insert(last.to_string(), value);
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::collections::BTreeSet;

    const MINIMAL: &str = "name = \"t\"\nmemory_max_mib = 64\n[budget]\nsplats = 1000\nintersections = 10000\n\
        keyframes = 8\nimage_width_max = 752\nimage_height_max = 480\n";

    /// Dotted names of every key in a table, and whether it is a number.
    fn names(table: &toml::Table, prefix: &str, into: &mut BTreeSet<(String, bool)>) {
        for (key, value) in table {
            match value {
                toml::Value::Table(t) if key != "controls" => names(t, &format!("{prefix}{key}."), into),
                v => drop(into.insert((format!("{prefix}{key}"), v.is_integer() || v.is_float()))),
            }
        }
    }

    #[test]
    fn every_key_is_declared_once_and_every_number_has_a_bound() {
        let board = Board::parse("t.toml", MINIMAL, &[]).unwrap();
        let mut written = BTreeSet::new();
        names(&toml::Table::try_from(&board).unwrap(), "", &mut written);
        let declared: Vec<(String, bool)> =
            keys().map(|k| (k.name.to_string(), !matches!(k.bound, Bound::Any))).collect();
        assert_eq!(declared.iter().cloned().collect::<BTreeSet<_>>(), written);
        assert_eq!(declared.len(), written.len());
    }

    #[test]
    fn bounds_say_what_they_are_and_refuse_what_is_not_a_number() {
        for bound in keys().map(|k| k.bound).filter(|b| !matches!(b, Bound::Any)) {
            let below = if let Bound::Within(least, _) = bound { least.min(0.0) - 1.0 } else { -1.0 };
            assert!(!bound.holds(f64::NAN) && !bound.holds(f64::INFINITY) && !bound.holds(below), "{bound}");
        }
        assert!(Bound::Multiple(16.0, 512.0, 16.0).holds(32.0) && !Bound::Multiple(16.0, 512.0, 16.0).holds(40.0));
        assert!(Bound::PowerOfTwo(1.0, 4.0).holds(2.0) && !Bound::PowerOfTwo(1.0, 4.0).holds(3.0));
        assert_eq!(Bound::Multiple(16.0, 512.0, 16.0).to_string(), "a multiple of 16, 16 to 512");
    }

    #[test]
    fn constants_are_set_by_name_for_instruments_and_survive_later_overrides() {
        let set = ["vio.huber_px=2".to_string(), "map.scale=4".to_string()];
        let board = Board::parse("t.toml", MINIMAL, &set).unwrap();
        assert_eq!((board.vio.huber_px, board.map.scale), (2.0, 4));
        let file = format!("{MINIMAL}[vio]\nhuber_px = 2.0\n");
        assert!(Board::parse("t.toml", &file, &[]).is_err(), "no board file sets a constant of the method");
    }

    #[test]
    fn lines_are_found_in_sections_and_in_dotted_keys() {
        let text = "name = \"t\"\n\n[budget]\nsplats = 3\n[map]\nscale = 2\n";
        assert_eq!(line_of(text, "name"), Some(1));
        assert_eq!(line_of(text, "budget.splats"), Some(4));
        assert_eq!(line_of(text, "map.scale"), Some(6));
        assert_eq!(line_of("a.b = 1\n", "a.b"), Some(1));
        assert_eq!(line_of(text, "map.seed"), None);
    }
}
