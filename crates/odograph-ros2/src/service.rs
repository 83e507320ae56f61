//! A service of ROS 2: requests on one topic of DDS, replies on another.
//!
//! A reply says which request it is for in one of two ways. Clients over Cyclone DDS have sixteen
//! bytes before each message, an identifier of the client and the number of the request
//! (rmw_cyclonedds, `serdata.hpp`); replies have the same. Those over Fast DDS say it beside the
//! message, as an inline quality of service, the related sample identity (DDS-RPC 1.0, section 7.8;
//! rmw_fastrtps, `rmw_request.cpp`).

use crate::names::TopicName;
use crate::node::Node;
use crate::payload::{Payload, PayloadReader, PayloadWriter};
use odograph::error::{Error, Result};
use rustdds::mio1::{Interest, Registry, Token};
use rustdds::{DataWriterStatus, GUID, SampleIdentity, StatusEvented, WriteOptionsBuilder};
use std::time::{Duration, Instant};

/// Longest wait until the client that has called can be reached: it discovers this node, and this
/// node it, independently.
const REACHED_WITHIN: Duration = Duration::from_secs(2);
/// First bytes of the identifier of a participant of Cyclone DDS.
const CYCLONE: [u8; 2] = [1, 16];
/// Bytes of the representation of a message.
const REPRESENTATION: usize = 4;
/// Bytes that Cyclone DDS has before a message.
const HEADER: usize = 16;

/// How a reply says which request it is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Correlation {
    /// By what is before the message.
    Header([u8; HEADER]),
    /// By what is beside it.
    Related(SampleIdentity),
}

/// The identifier of a participant: the first bytes of those of its readers and writers.
type Participant = [u8; 12];

fn participant(endpoint: &GUID) -> Participant {
    let bytes = endpoint.to_bytes();
    std::array::from_fn(|index| bytes[index])
}

/// A client that has called, and which call it was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    participant: Participant,
    correlation: Correlation,
}

/// Where a request comes from, and the message in it with its representation. `None` if it is
/// damaged.
fn received(
    message: &[u8],
    identity: SampleIdentity,
    related: Option<SampleIdentity>,
) -> Option<(Caller, Vec<u8>)> {
    let participant = participant(&identity.writer_guid);
    if related.is_none() && participant.starts_with(&CYCLONE) {
        let (representation, rest) = message.split_first_chunk::<REPRESENTATION>()?;
        let (header, body) = rest.split_first_chunk::<HEADER>()?;
        let mut header = *header;
        if representation[1] & 1 == 0 {
            // Replies are little-endian.
            header.chunks_exact_mut(HEADER / 2).for_each(<[u8]>::reverse);
        }
        let correlation = Correlation::Header(header);
        return Some((Caller { participant, correlation }, [&representation[..], body].concat()));
    }
    // A client that names the reader of its replies is answered there.
    let reader = related.map(|related| related.writer_guid).filter(|reader| reader.to_bytes() != [0; 16]);
    let writer_guid = reader.unwrap_or(identity.writer_guid);
    let correlation = Correlation::Related(SampleIdentity { writer_guid, ..identity });
    Some((Caller { participant, correlation }, message.to_vec()))
}

/// A reply on its way.
struct Reply {
    to: Caller,
    message: Vec<u8>,
    since: Instant,
}

/// A service that this node offers.
pub struct Service {
    reader: PayloadReader,
    writer: PayloadWriter,
    /// Clients that replies reach.
    reached: Vec<GUID>,
    waiting: Vec<Reply>,
}

impl Service {
    /// Offers a service, whose requests wake whoever waits with the token.
    pub fn new(
        node: &Node,
        name: &TopicName,
        type_name: &str,
        registry: &Registry,
        token: Token,
    ) -> Result<Self> {
        let (mut reader, writer) = node.service(name, type_name)?;
        registry.register(&mut reader, token, Interest::READABLE).map_err(|error| {
            Error::input(format!("calls of {name} cannot be waited for: {error}")).caused_by(error)
        })?;
        Ok(Self { reader, writer, reached: Vec::new(), waiting: Vec::new() })
    }

    /// The requests since the last call.
    pub fn take(&mut self) -> Vec<(Caller, Vec<u8>)> {
        let mut requests = Vec::new();
        while let Ok(Some(sample)) = self.reader.take_next_sample() {
            let info = sample.sample_info();
            let (identity, related) = (info.sample_identity(), info.related_sample_identity());
            let Payload(message) = sample.into_value();
            requests.extend(received(&message, identity, related));
        }
        requests
    }

    /// Replies to a request as soon as its client can be reached.
    pub fn reply(&mut self, to: Caller, message: Vec<u8>) {
        self.waiting.push(Reply { to, message, since: Instant::now() });
        self.deliver();
    }

    /// Sends what waits for clients that can be reached by now. A client that still cannot may be
    /// known here by another participant: its reply is sent to all.
    pub fn deliver(&mut self) {
        while let Some(status) = self.writer.try_recv_status() {
            if let DataWriterStatus::PublicationMatched { reader, current, .. } = status {
                self.reached.retain(|known| *known != reader);
                if current.count_change() > 0 {
                    self.reached.push(reader);
                }
            }
        }
        for reply in std::mem::take(&mut self.waiting) {
            let is_reached = self.reached.iter().any(|reader| participant(reader) == reply.to.participant);
            if is_reached || reply.since.elapsed() >= REACHED_WITHIN {
                self.send(reply);
            } else {
                self.waiting.push(reply);
            }
        }
    }

    fn send(&self, Reply { to, message, .. }: Reply) {
        let (message, options) = match to.correlation {
            Correlation::Header(header) => {
                let (representation, body) = message.split_at(REPRESENTATION.min(message.len()));
                ([representation, &header, body].concat(), WriteOptionsBuilder::new())
            }
            Correlation::Related(identity) => {
                (message, WriteOptionsBuilder::new().related_sample_identity(identity))
            }
        };
        // Whoever does not hear of it calls again.
        let _ = self.writer.write_with_options(Payload(message), options.build());
    }

    /// Waits until the replies have arrived, for a moment at most.
    pub fn wait(&self, patience: Duration) {
        let _ = self.writer.wait_for_acknowledgments(patience);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use rustdds::SequenceNumber;

    fn identity(vendor: [u8; 2]) -> SampleIdentity {
        let mut bytes = [9; 16];
        bytes[..2].copy_from_slice(&vendor);
        SampleIdentity { writer_guid: GUID::from_bytes(bytes), sequence_number: SequenceNumber::from(7) }
    }

    #[test]
    fn a_request_over_cyclone_has_its_number_before_the_message() {
        let header: Vec<u8> = (1..=16).collect();
        let little = [&[0, 1, 0, 0][..], &header, &[5]].concat();
        let (caller, body) = received(&little, identity(CYCLONE), None).unwrap();
        assert_eq!(body, [0, 1, 0, 0, 5]);
        assert_eq!(caller.correlation, Correlation::Header(header.clone().try_into().unwrap()));
        let big = [&[0, 0, 0, 0][..], &header, &[5]].concat();
        let (caller, _) = received(&big, identity(CYCLONE), None).unwrap();
        let swapped = [8, 7, 6, 5, 4, 3, 2, 1, 16, 15, 14, 13, 12, 11, 10, 9];
        assert_eq!(caller.correlation, Correlation::Header(swapped));
        assert!((0..20).all(|end| received(&little[..end], identity(CYCLONE), None).is_none()));
    }

    #[test]
    fn a_request_over_fast_dds_has_its_reader_beside_the_message() {
        let (message, from) = ([0, 1, 0, 0, 5], identity([1, 15]));
        let (caller, body) = received(&message, from, None).unwrap();
        assert_eq!((body, caller.correlation), (message.to_vec(), Correlation::Related(from)));
        let mut reader = from;
        reader.writer_guid = GUID::from_bytes([3; 16]);
        let unnumbered = SampleIdentity { sequence_number: SequenceNumber::from(-1), ..reader };
        let (caller, _) = received(&message, from, Some(unnumbered)).unwrap();
        assert_eq!(caller.correlation, Correlation::Related(reader));
    }
}
