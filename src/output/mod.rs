//! Trajectory, PLY, report.
