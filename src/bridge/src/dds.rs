//! Writers of DDS by the names that ROS 2 has for topics and types.

use crate::messages::Message;
use rustdds::policy::{Durability, History, ResourceLimits};
use rustdds::{
    no_key::DataWriterCdr, DomainParticipant, DomainParticipantBuilder, QosPolicyBuilder, Timestamp, TopicKind,
};
use std::net::Ipv4Addr;

/// The bridge in the network of DDS.
pub struct Participant(DomainParticipant);

/// Writes one topic. No write waits.
pub struct Writer<M: Message>(DataWriterCdr<M>);

impl Participant {
    /// Joins a domain; over the loopback interface alone where `is_local`. Fails where no socket can be opened.
    pub fn join(domain: u16, is_local: bool) -> Result<Participant, String> {
        let mut builder = DomainParticipantBuilder::new(domain);
        if is_local {
            builder = builder.with_only_networks([Ipv4Addr::LOCALHOST]);
        }
        builder.build().map(Participant).map_err(|e| format!("cannot join DDS domain {domain}: {e}"))
    }

    /// A reliable writer of the topic `name`, which keeps the last `depth` samples for what a reader missed. One that
    /// `keeps` gives its last sample to who comes late. Fails where the DDS refuses.
    pub fn writer<M: Message>(&self, name: &str, depth: i32, keeps: bool) -> Result<Writer<M>, String> {
        let durability = if keeps { Durability::TransientLocal } else { Durability::Volatile };
        let qos = QosPolicyBuilder::new()
            .reliable(rustdds::Duration::ZERO)
            .durability(durability)
            .history(History::KeepLast { depth });
        // Samples that are kept are large: few of them wait for a reader.
        let limits = ResourceLimits { max_samples: 4, max_instances: 1, max_samples_per_instance: 4 };
        let qos = if keeps { qos.resource_limits(limits).build() } else { qos.build() };
        let refused = |e: rustdds::dds::CreateError| format!("cannot write topic {name}: {e}");
        let topic =
            self.0.create_topic(format!("rt/{name}"), M::TYPE.into(), &qos, TopicKind::NoKey).map_err(refused)?;
        let publisher = self.0.create_publisher(&qos).map_err(refused)?;
        publisher.create_datawriter_no_key_cdr(&topic, Some(qos)).map(Writer).map_err(refused)
    }
}

impl<M: Message> Writer<M> {
    /// Hands a message over; `false` where readers have not taken those before it yet.
    pub fn write(&self, message: M) -> bool {
        self.0.write(message, Some(Timestamp::now())).is_ok()
    }
}
