//! Effect of the method of depth on the map: the same recording mapped with each, at equal time of mapping.
//!
//! Depth is only asked for at anchors, so a method is paid once an anchor and shows in the first seconds of a map;
//! its time counts as mapping.

use crate::run::{Job, Source};
use stipple::output::report::Report;
use stipple::output::OutputDir;
use stipple::run::Steps;
use stipple_drivers::{Fault, FaultKind};

/// Methods, and how a board asks for each.
const METHODS: [(&str, &[&str]); 3] = [
    ("bm", &["stereo.method=bm"]),
    ("sgbm", &["stereo.method=sgbm"]),
    ("sgm_wls", &["stereo.method=sgm", "stereo.wls=true"]),
];
/// Mapping times at which PSNR is reported besides the end, s.
pub const AT_S: [f64; 2] = [10.0, 30.0];

/// A map made with a method.
pub struct Effect {
    pub method: &'static str,
    pub report: Report,
}

/// Maps with every method that is to be had, for `seconds` each.
pub fn map(seconds: f64, out: &OutputDir, source: &Source) -> Result<Vec<Effect>, Fault> {
    let mut maps = vec![];
    for (method, set) in METHODS {
        let set: Vec<String> = set.iter().map(|s| s.to_string()).collect();
        let dir = OutputDir::create(&out.file(&format!("map-{method}")))?;
        match source.play(&Job { set: &set, steps: Steps::EqualTime(seconds), quick: false }, &dir) {
            Ok(report) => {
                let effect = Effect { method, report };
                eprintln!("{}", effect.line());
                maps.push(effect);
            }
            Err(fault) if fault.kind == FaultKind::Config => {
                eprintln!("{method} makes no map: {fault}");
                continue;
            }
            Err(fault) => return Err(fault),
        }
    }
    Ok(maps)
}

impl Effect {
    /// PSNR of training views once `t_s` of mapping have passed, dB.
    pub fn psnr_at(&self, t_s: f64) -> Option<f64> {
        self.report.curve.iter().find(|c| c.t_s >= t_s)?.psnr_db
    }

    fn line(&self) -> String {
        let db = |v: Option<f64>| v.map_or("-".to_string(), |v| format!("{v:.2} dB"));
        let [a, b] = AT_S.map(|t| db(self.psnr_at(t)));
        let r = &self.report;
        let (end, held_out, anchors) = (db(r.quality.psnr_db), db(r.quality.psnr_heldout_db), r.anchors.unwrap_or(0));
        format!(
            "map with {:<9} {a} at 10 s, {b} at 30 s, {end} at the end, held out {held_out}, {anchors} anchors",
            self.method
        )
    }
}
