//! The events of a run: an identifier for each kind of fault or change, the same in the log, in the journal, on the status
//! socket and in the tests.

use serde::{Deserialize, Serialize};

/// How bad an event is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    Notice,
    Warning,
    Critical,
}

impl Severity {
    pub fn name(self) -> &'static str {
        match self {
            Severity::Notice => "notice",
            Severity::Warning => "warning",
            Severity::Critical => "critical",
        }
    }
}

/// First 112 bits of the MESSAGE_ID of every event; the number of the event is the rest.
const MESSAGE_ID: u128 = 0x6b1d_90e7_35c2_4f0a_9d48_e1b3_7c56_0000;

macro_rules! events {
    ($($(#[$doc:meta])* $id:ident = $number:literal, $name:literal, $severity:ident;)*) => {
        /// What an event is about. Numbers are never used anew.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum EventId {
            $($(#[$doc])* $id,)*
            /// An event of another version.
            #[serde(other)]
            Other,
        }

        impl EventId {
            /// All of this version.
            pub const ALL: &'static [EventId] = &[$(EventId::$id),*];

            pub fn name(self) -> &'static str {
                match self { $(EventId::$id => $name,)* EventId::Other => "other" }
            }

            pub fn severity(self) -> Severity {
                match self { $(EventId::$id => Severity::$severity,)* EventId::Other => Severity::Notice }
            }

            /// The MESSAGE_ID in the journal.
            pub fn message_id(self) -> u128 {
                MESSAGE_ID + match self { $(EventId::$id => $number,)* EventId::Other => 0 }
            }
        }
    };
}

events! {
    Start = 1, "start", Notice;
    End = 2, "end", Notice;
    /// A thread panicked: the process ends.
    Panic = 3, "panic", Critical;
    SensorLost = 10, "sensor_lost", Critical;
    SensorSilent = 11, "sensor_silent", Critical;
    SensorBack = 12, "sensor_back", Notice;
    /// What this machine or a recording lacks and the run does without.
    Setup = 13, "setup", Warning;
    CamerasSwapped = 20, "cameras_swapped", Warning;
    CamerasDisagree = 21, "cameras_disagree", Warning;
    CamerasAgree = 22, "cameras_agree", Notice;
    /// What is estimated of the rig and was not found, moves without an end, or is too far from the calibration.
    RigUnknown = 23, "rig_unknown", Warning;
    RigMoving = 24, "rig_moving", Warning;
    RigTooFar = 25, "rig_too_far", Warning;
    RigFound = 26, "rig_found", Notice;
    RigDiscarded = 27, "rig_discarded", Warning;
    /// The estimator was reset, or started again elsewhere than dead reckoning led.
    Epoch = 30, "epoch", Warning;
    OdometryStarting = 31, "odometry_starting", Notice;
    OdometryRunning = 32, "odometry_running", Notice;
    /// No frames come: states are carried by inertial samples.
    OdometryCarried = 33, "odometry_carried", Warning;
    OdometryLost = 34, "odometry_lost", Critical;
    ThreadSilent = 40, "thread_silent", Critical;
    /// The system refuses a priority or resident memory.
    SystemRefused = 41, "system_refused", Warning;
    MapperLost = 50, "mapper_lost", Warning;
    MapperBack = 51, "mapper_back", Notice;
    /// The governor gives the mapper another share of its time.
    MapperShare = 52, "mapper_share", Notice;
    LinkLost = 60, "link_lost", Warning;
    LinkOpen = 61, "link_open", Notice;
    AutopilotHeard = 62, "autopilot_heard", Notice;
    AutopilotSilent = 63, "autopilot_silent", Warning;
    /// Another vehicle's autopilot is on the link.
    AutopilotForeign = 64, "autopilot_foreign", Warning;
    /// The vehicle starts so steep that its inertial unit may be mounted otherwise.
    MountDoubtful = 65, "mount_doubtful", Warning;
    /// Logging ends before the run does.
    LogEnded = 70, "log_ended", Warning;
    Reloaded = 80, "reloaded", Notice;
    ReloadRefused = 81, "reload_refused", Warning;
}

impl EventId {
    /// Whether it is about a sensor's connection.
    pub fn is_of_sensor(self) -> bool {
        matches!(self, EventId::SensorLost | EventId::SensorSilent | EventId::SensorBack)
    }

    /// Whether the report names it among its warnings: it is about the map, the cameras or the rig.
    pub fn is_reported(self) -> bool {
        use EventId::*;
        let of_rig = matches!(self, RigUnknown | RigMoving | RigTooFar | RigFound | RigDiscarded);
        of_rig || matches!(self, CamerasSwapped | CamerasDisagree | CamerasAgree | MapperLost | MapperBack)
    }
}

/// An event and its text.
pub type Notice = (EventId, String);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn events_have_names_and_numbers_of_their_own() {
        let ids: BTreeSet<u128> = EventId::ALL.iter().map(|id| id.message_id()).collect();
        assert_eq!(ids.len(), EventId::ALL.len());
        assert!(ids.iter().all(|id| id >> 16 == MESSAGE_ID >> 16 && *id != MESSAGE_ID), "the prefix stays");
        for id in EventId::ALL {
            assert_eq!(serde_json::to_string(id).unwrap(), format!("{:?}", id.name()), "one name everywhere");
        }
    }

    #[test]
    fn events_of_another_version_are_read() {
        assert_eq!(serde_json::from_str::<EventId>(r#""of_the_future""#).unwrap(), EventId::Other);
    }
}
