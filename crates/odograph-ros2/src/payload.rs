//! Messages as bytes: what is in them is for others to read and write.

use rustdds::bytes::Bytes;
use rustdds::no_key::{Decode, DefaultDecoder, DeserializerAdapter, SerializerAdapter};
use rustdds::{RepresentationIdentifier, no_key};
use std::convert::Infallible;

/// A message in CDR behind the four bytes of its representation.
#[derive(Debug, Clone)]
pub struct Payload(pub Vec<u8>);

/// Passes payloads through RustDDS.
#[derive(Debug)]
pub struct Unchanged;

/// A reader of payloads.
pub type PayloadReader = no_key::DataReader<Payload, Unchanged>;
/// A writer of payloads.
pub type PayloadWriter = no_key::DataWriter<Payload, Unchanged>;

/// Bytes of the representation, which RustDDS reads and writes by itself.
const REPRESENTATION: usize = 4;

impl DeserializerAdapter<Payload> for Unchanged {
    type Error = Infallible;
    type Decoded = Payload;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        const READ: [RepresentationIdentifier; 4] = [
            RepresentationIdentifier::CDR_LE,
            RepresentationIdentifier::CDR_BE,
            RepresentationIdentifier::CDR2_LE,
            RepresentationIdentifier::CDR2_BE,
        ];
        &READ
    }

    fn transform_decoded(decoded: Payload) -> Payload {
        decoded
    }
}

impl DefaultDecoder<Payload> for Unchanged {
    type Decoder = Copied;
    const DECODER: Copied = Copied;
}

/// Copies the bytes of a message.
#[derive(Debug, Clone)]
pub struct Copied;

impl Decode<'_, Payload> for Copied {
    type Error = Infallible;

    fn decode_bytes(self, bytes: &[u8], encoding: RepresentationIdentifier) -> Result<Payload, Infallible> {
        let [high, low] = encoding.to_bytes();
        let mut message = Vec::with_capacity(REPRESENTATION + bytes.len());
        message.extend([high, low, 0, 0]);
        message.extend_from_slice(bytes);
        Ok(Payload(message))
    }
}

impl SerializerAdapter<Payload> for Unchanged {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(Payload(message): &Payload) -> Result<Bytes, Infallible> {
        Ok(Bytes::copy_from_slice(message.get(REPRESENTATION..).unwrap_or_default()))
    }
}
