//! The section of the autopilot.

use super::section::{section, Bound};
use super::sensors::Wrong;
use serde::{Deserialize, Serialize};
use std::net::SocketAddr;
use std::path::PathBuf;

section! {
    /// The autopilot that hears the states of a run, over MAVLink 2 (board-configs/autopilot.md). Off where no link is named.
    MavlinkConfig, "mavlink.";
    /// Where it is: `serial:DEVICE:BAUD`, `udpout:IP:PORT` (it listens there), or `udpin:IP:PORT` (it sends there, and is answered).
    link: String = String::new();
    /// Its system id, which our messages have too: the parts of a vehicle have the same one.
    system: u32 = 1, Bound::Within(1.0, 255.0);
    /// `odometry`: poses and velocities; `vision_position`: poses alone, for what does not know ODOMETRY.
    message: StateMessage = StateMessage::Odometry;
    /// Most states a second; no more are sent than there are frames, and than the link has room for.
    rate_hz: f64 = 50.0, Bound::Within(10.0, 200.0);
    /// Roll, pitch and yaw of the inertial unit in the vehicle, whose axes are forward, right and down: about the vehicle's axes,
    /// roll first. A unit whose x is forward and z up has [180, 0, 0].
    mount_rpy_deg: [f64; 3] = [0.0; 3];
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StateMessage {
    Odometry,
    VisionPosition,
}

/// Where an autopilot is.
#[derive(Clone, Debug, PartialEq)]
pub enum Address {
    /// It listens there.
    UdpTo(SocketAddr),
    /// It sends there; answers go to where its last heartbeat came from.
    UdpAt(SocketAddr),
    /// Device, and bits a second.
    Serial(PathBuf, u32),
}

/// Rates that a UART is set to.
const BAUD: std::ops::RangeInclusive<u32> = 9_600..=4_000_000;

impl Address {
    fn parse(text: &str) -> Option<Address> {
        let (kind, place) = text.split_once(':')?;
        match kind {
            "udpout" => place.parse().ok().map(Address::UdpTo),
            "udpin" => place.parse().ok().map(Address::UdpAt),
            "serial" => {
                let (device, baud) = place.rsplit_once(':')?;
                let baud = baud.parse().ok().filter(|baud| BAUD.contains(baud))?;
                (!device.is_empty()).then(|| Address::Serial(device.into(), baud))
            }
            _ => None,
        }
    }
}

impl MavlinkConfig {
    /// Where the autopilot is; `None` where there is none.
    pub fn address(&self) -> Option<Address> {
        Address::parse(&self.link)
    }

    pub(super) fn wrong(&self) -> Option<Wrong> {
        if !self.link.is_empty() && self.address().is_none() {
            let what = format!(
                "mavlink.link = {:?} must be serial:DEVICE:BAUD, udpout:IP:PORT or udpin:IP:PORT, the baud {} to {}",
                self.link,
                BAUD.start(),
                BAUD.end()
            );
            return Some(("mavlink.link", what));
        }
        let is_turn = self.mount_rpy_deg.iter().all(|angle| angle.abs() <= 360.0);
        (!is_turn).then(|| ("mavlink.mount_rpy_deg", "mavlink.mount_rpy_deg must be angles of -360 to 360".into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_is_of_one_of_three_forms() {
        let address = |text| Address::parse(text);
        assert_eq!(address("udpout:10.0.0.1:14580"), Some(Address::UdpTo(([10, 0, 0, 1], 14580).into())));
        assert_eq!(address("udpin:0.0.0.0:14540"), Some(Address::UdpAt(([0, 0, 0, 0], 14540).into())));
        assert!(matches!(address("udpout:[::1]:14580"), Some(Address::UdpTo(peer)) if peer.is_ipv6()));
        let serial = Address::Serial("/dev/serial/by-id/usb-x:y".into(), 921_600);
        assert_eq!(address("serial:/dev/serial/by-id/usb-x:y:921600"), Some(serial));
        for wrong in
            ["", "udp", "udpout:host:1", "udpout:10.0.0.1", "serial:/dev/x", "serial:/dev/x:9", "serial::57600"]
        {
            assert_eq!(address(wrong), None, "{wrong}");
        }
    }
}
