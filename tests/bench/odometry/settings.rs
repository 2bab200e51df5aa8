//! The settings a sweep visits: the defaults, one parameter at a time moved away from them, and a
//! few whole shapes. A setting is a list of `--set` assignments, so any of them can be replayed.

use crate::run::default_board;
use stipple::config::Board;

/// Parameter and values; the default joins them where it is not among them.
const PARAMETERS: [(&str, &[f64]); 11] = [
    ("frontend.carried_px", &[0.0, 2.0, 4.0, 8.0, 16.0, 1000.0]),
    ("frontend.grid_px", &[40.0, 50.0, 60.0, 70.0, 80.0]),
    ("frontend.fast_threshold_min", &[5.0, 10.0, 20.0]),
    ("frontend.iterations", &[2.0, 3.0, 5.0, 8.0]),
    ("vio.iterations_max", &[2.0, 4.0, 7.0, 10.0]),
    ("vio.states", &[2.0, 3.0, 4.0, 5.0]),
    ("vio.keyframes", &[4.0, 7.0, 10.0]),
    ("vio.keyframe_connected_min", &[0.6, 0.7, 0.8, 0.9]),
    ("vio.observation_sigma_px", &[0.25, 0.5, 1.0]),
    ("vio.gyro_noise_scale", &[1.0, 2.0, 4.0]),
    ("vio.accel_noise_scale", &[2.0, 4.0, 8.0]),
];

/// The defaults of all parameters that set the run time, moved together.
const SHAPES: [Named; 4] = [
    ("smallest", &["frontend.grid_px=80", "frontend.iterations=2", "vio.iterations_max=2"]),
    ("large", &["frontend.grid_px=50", "frontend.iterations=5"]),
    ("larger", &["frontend.grid_px=40", "frontend.iterations=7", "vio.iterations_max=10"]),
    ("largest", &["frontend.grid_px=30", "frontend.iterations=10", "vio.iterations_max=12"]),
];
/// A name and its assignments.
type Named = (&'static str, &'static [&'static str]);
/// Place of the defaults among the shapes.
const DEFAULT_SHAPE: usize = 1;
pub const DEFAULT: &str = "default";

pub struct Setting {
    /// `default`, an assignment, or `shape` and its name.
    pub name: String,
    pub set: Vec<String>,
    pub board: Board,
}

/// A curve of the plots: settings by index, along the parameter.
pub struct Curve {
    pub name: &'static str,
    /// Value or name of each point.
    pub values: Vec<String>,
    pub settings: Vec<usize>,
}

fn setting(name: String, set: Vec<String>) -> Setting {
    let board = default_board(&set).expect("the sweep stays within the bounds");
    Setting { name, set, board }
}

fn assigned(key: &str, value: f64) -> Setting {
    let set = format!("{key}={value}");
    setting(set.clone(), vec![set])
}

/// The first is the default.
pub fn all() -> Vec<Setting> {
    let mut all = vec![setting(DEFAULT.into(), vec![])];
    for (key, values) in PARAMETERS {
        let default = value_of(&all[0].board, key);
        all.extend(values.iter().filter(|v| **v != default).map(|v| assigned(key, *v)));
    }
    let owned = |set: &[&str]| set.iter().map(|s| s.to_string()).collect();
    all.extend(SHAPES.iter().map(|(name, set)| setting(format!("shape {name}"), owned(set))));
    all
}

/// Parameters of the sweep.
pub fn keys() -> [&'static str; PARAMETERS.len()] {
    PARAMETERS.map(|(key, _)| key)
}

/// The default and the other values of one parameter; `None` where the sweep has no such parameter.
pub fn of(key: &str) -> Option<Vec<Setting>> {
    let prefix = format!("{key}=");
    let settings: Vec<Setting> =
        all().into_iter().filter(|s| s.set.is_empty() || s.set.len() == 1 && s.name.starts_with(&prefix)).collect();
    (settings.len() > 1).then_some(settings)
}

/// The default alone.
pub fn default() -> Vec<Setting> {
    vec![setting(DEFAULT.into(), vec![])]
}

/// The default and one cheaper setting.
pub fn quick() -> Vec<Setting> {
    vec![setting(DEFAULT.into(), vec![]), assigned("vio.iterations_max", 3.0)]
}

/// Curves through those of `settings` that belong together, the default in its place on each.
pub fn curves(settings: &[Setting]) -> Vec<Curve> {
    let find = |name: &str| settings.iter().position(|s| s.name == name);
    let mut curves = Vec::new();
    for (key, values) in PARAMETERS {
        let default = value_of(&settings[0].board, key);
        let mut visited: Vec<f64> = values.iter().copied().chain([default]).collect();
        visited.sort_by(f64::total_cmp);
        visited.dedup();
        let at = |v: &f64| if *v == default { Some(0) } else { find(&format!("{key}={v}")) };
        let found: Vec<(String, usize)> = visited.iter().filter_map(|v| Some((v.to_string(), at(v)?))).collect();
        curves.push(curve(key, found));
    }
    let shape = |(name, _): &Named| Some((name.to_string(), find(&format!("shape {name}"))?));
    let mut shapes: Vec<(String, usize)> = SHAPES.iter().filter_map(shape).collect();
    shapes.insert(shapes.len().min(DEFAULT_SHAPE), (DEFAULT.into(), 0));
    curves.push(curve("shape", shapes));
    curves.retain(|c| c.settings.len() > 1);
    curves
}

fn curve(name: &'static str, points: Vec<(String, usize)>) -> Curve {
    let (values, settings) = points.into_iter().unzip();
    Curve { name, values, settings }
}

/// The value a board gives a parameter of the sweep.
fn value_of(board: &Board, key: &str) -> f64 {
    let value = board.value(key).expect("the sweep names keys of the board and constants of the method");
    value.as_float().or(value.as_integer().map(|i| i as f64)).expect("swept parameters are numbers")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_is_on_a_curve_and_the_default_on_all() {
        let settings = all();
        let curves = curves(&settings);
        assert!(settings[0].set.is_empty() && curves.iter().all(|c| c.settings.contains(&0)));
        for (i, s) in settings.iter().enumerate().skip(1) {
            assert!(curves.iter().any(|c| c.settings.contains(&i)), "{} is on no curve", s.name);
            assert!(s.board != settings[0].board, "{} is the default", s.name);
        }
    }
}
