//! Faults injected into the sensors of a replayed recording on purpose, so that the answer to them can be seen: the TOML
//! file of `--inject`.

use serde::{Deserialize, Serialize};
use std::path::Path;
use stipple_drivers::inject::{Kind, Rule};
use stipple_drivers::{input, Fault, FaultKind};

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InjectConfig {
    /// The same seed strikes the same frames and samples.
    pub seed: u64,
    /// `[[camera]]`, a fault each.
    pub camera: Vec<Rule>,
    /// `[[imu]]`, a fault each.
    pub imu: Vec<Rule>,
    /// `[[thread]]`, a panic or a hang each.
    pub thread: Vec<ThreadRule>,
}

/// A panic of a thread of the run, or a hang: one of the two.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThreadRule {
    /// Name of the thread, as debuggers show it.
    pub name: String,
    /// When it panics, after its start, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub panic_s: Option<f64>,
    /// When it does nothing any more, after its start, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hang_s: Option<f64>,
}

impl InjectConfig {
    /// Reads a file of rules; an error names the first one that makes no sense.
    pub fn load(path: &Path) -> Result<InjectConfig, Fault> {
        let place = path.display().to_string();
        let fix =
            "write seed = 1, [[camera]] or [[imu]] with fault, start_s and end_s, or [[thread]] with name and panic_s or hang_s";
        let text = input::read_settings(path).map_err(|e| {
            Fault::new(FaultKind::NoInput, &place, format!("cannot read the rules of faults: {e}"), fix)
        })?;
        let config: InjectConfig = toml::from_str(&text)
            .map_err(|e| Fault::new(FaultKind::Config, &place, e.message().replace('\n', " "), fix))?;
        config.check().map_err(|what| Fault::new(FaultKind::Config, &place, what, fix))?;
        Ok(config)
    }

    /// Refuses rules that make no sense.
    fn check(&self) -> Result<(), String> {
        let one = |rule: &&ThreadRule| {
            let given = [rule.panic_s, rule.hang_s].into_iter().flatten();
            given.clone().count() != 1 || given.clone().any(|s| s < 0.0 || !s.is_finite())
        };
        if let Some(rule) = self.thread.iter().find(one) {
            return Err(format!("thread {}: panic_s or hang_s must be a number of seconds", rule.name));
        }
        for (key, rules) in [("camera", &self.camera), ("imu", &self.imu)] {
            for (i, rule) in rules.iter().enumerate() {
                let blind = key == "imu" && (rule.fault == Kind::Blackout || rule.camera.is_some());
                let checked =
                    if blind { Err("an inertial unit has no light to go out, and no cameras") } else { rule.check() };
                checked.map_err(|what| format!("{key}, rule {}: {what}", i + 1))?;
            }
        }
        Ok(())
    }
}
