//! `[inject]`: what goes wrong with the sensors on purpose, so that a board's answer to it can be seen.

use serde::{Deserialize, Serialize};
use stipple_drivers::inject::{Kind, Rule};

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InjectConfig {
    /// The same seed strikes the same frames and samples.
    pub seed: u64,
    /// `[[inject.camera]]` and `[[inject.imu]]`, a fault each.
    pub camera: Vec<Rule>,
    pub imu: Vec<Rule>,
}

impl InjectConfig {
    /// The first rule that makes no sense.
    pub(super) fn check(&self) -> Result<(), (&'static str, String)> {
        for (key, rules) in [("inject.camera", &self.camera), ("inject.imu", &self.imu)] {
            for (i, rule) in rules.iter().enumerate() {
                let blind = key == "inject.imu" && (rule.fault == Kind::Blackout || rule.camera.is_some());
                let checked =
                    if blind { Err("an inertial unit has no light to go out, and no cameras") } else { rule.check() };
                checked.map_err(|what| (key, format!("{key}, rule {}: {what}", i + 1)))?;
            }
        }
        Ok(())
    }
}
