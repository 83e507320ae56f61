//! This program as a node of ROS 2.

use crate::names::{TopicName, type_from_dds, type_in_dds};
use crate::payload::{Payload, PayloadReader, PayloadWriter};
use odograph::error::{Error, Result};
use odograph_session::ros_messages;
use rustdds::policy::{Durability, History, Reliability};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, Duration, Publisher, QosPolicies, QosPolicyBuilder,
    RTPSEntity, Subscriber, TopicKind,
};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, Mutex, PoisonError};

/// How a topic is delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Each message once, without repetition: what sensors have, and goes with every publisher.
    BestEffort,
    /// Repeated until it has arrived.
    Reliable,
    /// Also for those who come later: the newest message.
    Latched,
}

impl Delivery {
    fn qos(self, depth: i32) -> QosPolicies {
        let (reliability, durability) = match self {
            Self::BestEffort => (Reliability::BestEffort, Durability::Volatile),
            Self::Reliable => {
                (Reliability::Reliable { max_blocking_time: Duration::ZERO }, Durability::Volatile)
            }
            Self::Latched => {
                (Reliability::Reliable { max_blocking_time: Duration::ZERO }, Durability::TransientLocal)
            }
        };
        QosPolicyBuilder::new()
            .reliability(reliability)
            .durability(durability)
            .history(History::KeepLast { depth })
            .build()
    }
}

/// Name of the node.
const NAME: &str = "odograph";

/// Descriptions of the node that are kept for those who come later: one for each endpoint, since a
/// new one is refused while as many are not delivered.
const GRAPHS_KEPT: i32 = 64;

/// Requests that wait for an answer.
const REQUESTS_KEPT: i32 = 10;
/// Replies that wait for clients, among which some may have been killed.
const REPLIES_KEPT: i32 = 100;

/// Largest domain that the port numbers of DDS have room for.
const LARGEST_DOMAIN: u16 = 232;

/// A node of a ROS 2 domain, as long as it or what was made of it is there.
#[derive(Clone)]
pub struct Node(Arc<NodeState>);

struct NodeState {
    domain: u16,
    participant: DomainParticipant,
    subscriber: Subscriber,
    publisher: Publisher,
    graph: Mutex<Graph>,
}

/// Which endpoints are this node's, as `ros2 node info` shows them.
struct Graph {
    writer: PayloadWriter,
    readers: Vec<[u8; 16]>,
    writers: Vec<[u8; 16]>,
}

/// A topic with one of its publishers.
pub(crate) struct Published {
    pub name: TopicName,
    pub type_name: String,
    /// Identifier of the publisher's writer.
    pub writer: [u8; 16],
}

impl std::fmt::Debug for Node {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Node").field("domain", &self.0.domain).finish_non_exhaustive()
    }
}

fn unavailable(error: impl std::fmt::Display) -> Error {
    Error::input(format!("ROS 2 cannot be reached over this machine's network: {error}"))
}

/// The domain of the environment.
fn domain(stated: Option<&str>) -> Result<u16> {
    let Some(stated) = stated.map(str::trim).filter(|stated| !stated.is_empty()) else { return Ok(0) };
    stated.parse().ok().filter(|domain| *domain <= LARGEST_DOMAIN).ok_or_else(|| {
        Error::usage(format!("ROS_DOMAIN_ID is {stated:?}; a domain is a number from 0 to {LARGEST_DOMAIN}"))
    })
}

/// Whether the environment restricts ROS 2 to this machine.
fn is_local(localhost_only: Option<&str>, range: Option<&str>) -> bool {
    localhost_only == Some("1") || matches!(range, Some("LOCALHOST" | "OFF"))
}

impl Node {
    /// Joins the domain that the environment names: `ROS_DOMAIN_ID`; on this machine alone with
    /// `ROS_LOCALHOST_ONLY=1` or `ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`.
    ///
    /// # Errors
    /// If `ROS_DOMAIN_ID` is not a domain, or there is no network.
    pub fn join() -> Result<Self> {
        let variable = |name| std::env::var(name).ok();
        let is_local = is_local(
            variable("ROS_LOCALHOST_ONLY").as_deref(),
            variable("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref(),
        );
        Self::joined(domain(variable("ROS_DOMAIN_ID").as_deref())?, is_local)
    }

    /// Joins a domain, on this machine alone if `is_local`.
    pub(crate) fn joined(domain: u16, is_local: bool) -> Result<Self> {
        let mut builder = DomainParticipantBuilder::new(domain);
        if is_local {
            builder = builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        let participant = builder.build().map_err(unavailable)?;
        let qos = QosPolicyBuilder::new().build();
        let subscriber = participant.create_subscriber(&qos).map_err(unavailable)?;
        let publisher = participant.create_publisher(&qos).map_err(unavailable)?;
        let (name, type_name) = ("ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo");
        let writer =
            writer(&participant, &publisher, name.to_owned(), type_name, Delivery::Latched, GRAPHS_KEPT)?;
        let graph = Mutex::new(Graph { writer, readers: Vec::new(), writers: Vec::new() });
        let node = Self(Arc::new(NodeState { domain, participant, subscriber, publisher, graph }));
        node.announce(|_| ());
        Ok(node)
    }

    /// The domain.
    pub fn domain(&self) -> u16 {
        self.0.domain
    }

    /// Changes the graph, and tells the others.
    fn announce(&self, change: impl FnOnce(&mut Graph)) {
        let mut graph = self.0.graph.lock().unwrap_or_else(PoisonError::into_inner);
        change(&mut graph);
        let participant = self.0.participant.guid().to_bytes();
        let distribution = std::env::var("ROS_DISTRO").unwrap_or_default();
        let message =
            ros_messages::participant(participant, NAME, &graph.readers, &graph.writers, &distribution);
        // Only `ros2 node` needs it.
        let _ = graph.writer.write(Payload(message), None);
    }

    /// A reader of a topic that keeps a few messages.
    pub(crate) fn reader(
        &self,
        topic: &TopicName,
        type_name: &str,
        delivery: Delivery,
        depth: i32,
    ) -> Result<PayloadReader> {
        let reader = self.reader_of(topic.in_dds(), type_name, delivery, depth)?;
        self.announce(|graph| graph.readers.push(RTPSEntity::guid(&reader).to_bytes()));
        Ok(reader)
    }

    fn reader_of(
        &self,
        topic: String,
        type_name: &str,
        delivery: Delivery,
        depth: i32,
    ) -> Result<PayloadReader> {
        let qos = delivery.qos(depth);
        let topic = self.0.participant.create_topic(topic, type_in_dds(type_name), &qos, TopicKind::NoKey);
        topic
            .and_then(|topic| self.0.subscriber.create_datareader_no_key(&topic, Some(qos)))
            .map_err(unavailable)
    }

    /// A reader of the requests of a service, and a writer of its replies.
    pub(crate) fn service(
        &self,
        name: &TopicName,
        type_name: &str,
    ) -> Result<(PayloadReader, PayloadWriter)> {
        let [requests, replies] = name.service_in_dds();
        let (request, response) = (format!("{type_name}_Request"), format!("{type_name}_Response"));
        let reader = self.reader_of(requests, &request, Delivery::Reliable, REQUESTS_KEPT)?;
        let NodeState { participant, publisher, .. } = &*self.0;
        let writer = writer(participant, publisher, replies, &response, Delivery::Reliable, REPLIES_KEPT)?;
        self.announce(|graph| {
            graph.readers.push(RTPSEntity::guid(&reader).to_bytes());
            graph.writers.push(RTPSEntity::guid(&writer).to_bytes());
        });
        Ok((reader, writer))
    }

    /// A reader of the replies of a service, and a writer of its requests.
    #[cfg(test)]
    pub(crate) fn client(&self, name: &TopicName, type_name: &str) -> Result<(PayloadReader, PayloadWriter)> {
        let [requests, replies] = name.service_in_dds();
        let (request, response) = (format!("{type_name}_Request"), format!("{type_name}_Response"));
        let reader = self.reader_of(replies, &response, Delivery::Reliable, REQUESTS_KEPT)?;
        let NodeState { participant, publisher, .. } = &*self.0;
        Ok((reader, writer(participant, publisher, requests, &request, Delivery::Reliable, REQUESTS_KEPT)?))
    }

    /// A writer of a topic that keeps a few messages.
    pub(crate) fn writer(
        &self,
        topic: &TopicName,
        type_name: &str,
        delivery: Delivery,
        depth: i32,
    ) -> Result<PayloadWriter> {
        let writer =
            writer(&self.0.participant, &self.0.publisher, topic.in_dds(), type_name, delivery, depth)?;
        self.announce(|graph| graph.writers.push(RTPSEntity::guid(&writer).to_bytes()));
        Ok(writer)
    }

    /// The topics that others publish at the moment, once for each publisher.
    pub(crate) fn published(&self) -> Vec<Published> {
        let writers = self.0.participant.discovered_writers();
        let own = self.0.participant.guid().prefix;
        let others = writers.iter().map(|writer| &writer.publication_topic_data);
        let others = others.filter(|topic| topic.key.prefix != own);
        let named = |topic: &str| TopicName::from_dds(topic);
        let published = others.filter_map(|topic| {
            let (name, type_name) = (named(&topic.topic_name)?, type_from_dds(&topic.type_name));
            Some(Published { name, type_name, writer: topic.key.to_bytes() })
        });
        published.collect()
    }
}

fn writer(
    participant: &DomainParticipant,
    publisher: &Publisher,
    topic: String,
    type_name: &str,
    delivery: Delivery,
    depth: i32,
) -> Result<PayloadWriter> {
    let qos = delivery.qos(depth);
    participant
        .create_topic(topic, type_in_dds(type_name), &qos, TopicKind::NoKey)
        .and_then(|topic| publisher.create_datawriter_no_key(&topic, Some(qos)))
        .map_err(unavailable)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn the_domain_is_that_of_the_environment() {
        assert_eq!(domain(None).unwrap(), 0);
        assert_eq!(domain(Some(" 42 ")).unwrap(), 42);
        assert_eq!(domain(Some("")).unwrap(), 0);
        for wrong in ["233", "-1", "four"] {
            assert!(domain(Some(wrong)).unwrap_err().to_string().contains(wrong));
        }
        assert!(is_local(Some("1"), None) && is_local(None, Some("LOCALHOST")));
        assert!(!is_local(Some("0"), Some("SUBNET")));
    }
}
