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
    ($(#[doc = $doc:literal] $id:ident = $number:literal, $name:literal, $severity:ident;)*) => {
        /// What an event is about. Numbers are never used anew.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum EventId {
            $(#[doc = $doc] $id,)*
            /// An event of another version.
            #[serde(other)]
            Other,
        }

        impl EventId {
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

        /// All events of this version, and what each means.
        #[cfg(feature = "instruments")]
        pub const EVENTS: &[(EventId, &str)] = &[$((EventId::$id, $doc)),*];
    };
}

events! {
    /// The run begins.
    Start = 1, "start", Notice;
    /// The run ends; the text says why.
    End = 2, "end", Notice;
    /// A thread panicked: the process ends.
    Panic = 3, "panic", Critical;
    /// A sensor is lost; the text says which and why.
    SensorLost = 10, "sensor_lost", Critical;
    /// A sensor gives nothing, and no error.
    SensorSilent = 11, "sensor_silent", Critical;
    /// A sensor gives samples again.
    SensorBack = 12, "sensor_back", Notice;
    /// The machine or the recording lacks something that the run does without.
    Setup = 13, "setup", Warning;
    /// Two cameras are swapped.
    CamerasSwapped = 20, "cameras_swapped", Warning;
    /// A camera never agrees with another.
    CamerasDisagree = 21, "cameras_disagree", Warning;
    /// A camera agrees with another after all.
    CamerasAgree = 22, "cameras_agree", Notice;
    /// A value of the rig was to be estimated, and is not found.
    RigUnknown = 23, "rig_unknown", Warning;
    /// An estimate of the rig goes on moving.
    RigMoving = 24, "rig_moving", Warning;
    /// An estimate of the rig is further from the calibration than the board deems possible.
    RigTooFar = 25, "rig_too_far", Warning;
    /// A value of the rig is found after all.
    RigFound = 26, "rig_found", Notice;
    /// What was estimated of the rig can be no rig: its calibration is used again.
    RigDiscarded = 27, "rig_discarded", Warning;
    /// An epoch begins: the estimator was reset, or started again elsewhere than dead reckoning led.
    Epoch = 30, "epoch", Warning;
    /// Odometry has no pose yet; told to the autopilot.
    OdometryStarting = 31, "odometry_starting", Notice;
    /// Odometry runs; told to the autopilot.
    OdometryRunning = 32, "odometry_running", Notice;
    /// No frames come, states are carried by inertial samples; told to the autopilot.
    OdometryCarried = 33, "odometry_carried", Warning;
    /// Odometry is lost: dead reckoning, or nothing; told to the autopilot.
    OdometryLost = 34, "odometry_lost", Critical;
    /// A place was recognised, and the drift since corrected in the map's frame, or the vehicle found itself in the map of an earlier epoch or flight.
    Loop = 35, "loop", Notice;
    /// A thread gives no sign of life.
    ThreadSilent = 40, "thread_silent", Critical;
    /// The system refuses a priority, resident memory or a socket.
    SystemRefused = 41, "system_refused", Warning;
    /// The mapper's process ended or was ended; it starts again.
    MapperLost = 50, "mapper_lost", Warning;
    /// The mapper maps again.
    MapperBack = 51, "mapper_back", Notice;
    /// The governor gives the mapper another share of its time.
    MapperShare = 52, "mapper_share", Notice;
    /// The link to the autopilot is lost.
    LinkLost = 60, "link_lost", Warning;
    /// The link to the autopilot is open again.
    LinkOpen = 61, "link_open", Notice;
    /// The autopilot is heard.
    AutopilotHeard = 62, "autopilot_heard", Notice;
    /// The autopilot sends no heartbeat any more.
    AutopilotSilent = 63, "autopilot_silent", Warning;
    /// Another vehicle's autopilot is on the link.
    AutopilotForeign = 64, "autopilot_foreign", Warning;
    /// The vehicle starts so steep that its inertial unit may be mounted otherwise.
    MountDoubtful = 65, "mount_doubtful", Warning;
    /// Logging ends before the run does.
    LogEnded = 70, "log_ended", Warning;
    /// The board file was read again, and its changes are in force.
    Reloaded = 80, "reloaded", Notice;
    /// The board file was read again, and nothing of it was taken over.
    ReloadRefused = 81, "reload_refused", Warning;
}

impl EventId {
    /// Whether it is about a sensor's connection.
    pub fn is_of_sensor(self) -> bool {
        matches!(self, EventId::SensorLost | EventId::SensorSilent | EventId::SensorBack)
    }

    /// Whether it is about the link to an autopilot.
    pub fn is_of_link(self) -> bool {
        use EventId::*;
        matches!(self, LinkLost | LinkOpen | AutopilotHeard | AutopilotSilent | AutopilotForeign | MountDoubtful)
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
        let ids: BTreeSet<u128> = EVENTS.iter().map(|(id, _)| id.message_id()).collect();
        assert_eq!(ids.len(), EVENTS.len());
        assert!(ids.iter().all(|id| id >> 16 == MESSAGE_ID >> 16 && *id != MESSAGE_ID), "the prefix stays");
        for (id, _) in EVENTS {
            assert_eq!(serde_json::to_string(id).unwrap(), format!("{:?}", id.name()), "one name everywhere");
        }
    }

    #[test]
    fn events_of_another_version_are_read() {
        assert_eq!(serde_json::from_str::<EventId>(r#""of_the_future""#).unwrap(), EventId::Other);
    }
}
