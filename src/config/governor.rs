//! The section of the governor.

use super::section::{section, Bound};

section! {
    /// When the mapper works less, so that the board stays cool and odometry keeps up. It reads what Linux tells (hwmon, thermal
    /// zones, cpufreq) and changes nothing there.
    GovernorConfig, "governor.";
    /// Whether the mapper's share of its time is governed.
    enabled: bool = true;
    /// Above this temperature of any sensor of processor or GPU, °C, the mapper slows down; 0: 5 below where Linux itself does.
    temperature_max_c: f64 = 0.0, Bound::Within(0.0, 150.0);
    /// Above this power, W, as `stipple status` tells it, the mapper slows down; 0: at none.
    power_max_w: f64 = 0.0, Bound::Within(0.0, 1000.0);
    /// The mapper slows down where tracking takes more than this share of the time that it has for a frame.
    frame_share_max: f64 = 0.8, Bound::Within(0.05, 1.0);
}
