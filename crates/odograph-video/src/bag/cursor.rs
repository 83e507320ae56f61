//! Bounds-checked reading of serialised messages: ROS 1 serialisation, and CDR (OMG DDSI-RTPS,
//! section 10) as ROS 2 uses it. The records of MCAP files and ROS 1 bags are packed as in ROS 1.

use std::borrow::Cow;

/// How the messages of a topic are serialised.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Serialization {
    /// ROS 2.
    Cdr,
    /// ROS 1: little-endian, packed.
    Ros1,
    /// Protocol Buffers.
    Protobuf,
    /// Another one, by its name in the recording.
    Other(String),
}

impl Serialization {
    /// From the name in an MCAP channel or in the table of topics of rosbag2.
    pub fn named(name: &str) -> Self {
        match name {
            "cdr" => Self::Cdr,
            "ros1" => Self::Ros1,
            "protobuf" => Self::Protobuf,
            other => Self::Other(other.to_owned()),
        }
    }
}

/// Cursor over a message; every read returns `None` past the end.
#[derive(Debug, Clone)]
pub struct MessageCursor<'a> {
    data: &'a [u8],
    at: usize,
    /// Largest alignment of a number, bytes, counted from the start of `data`: 1 packs them.
    alignment: usize,
    big_endian: bool,
}

/// A `std_msgs/Header`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Header<'a> {
    pub stamp_ns: i64,
    pub frame: Cow<'a, str>,
}

macro_rules! number {
    ($name:ident) => {
        /// Reads a number.
        pub fn $name(&mut self) -> Option<$name> {
            const BYTES: usize = size_of::<$name>();
            let alignment = self.alignment.min(BYTES);
            self.at = self.at.checked_next_multiple_of(alignment)?;
            let bytes: [u8; BYTES] = self.take(BYTES)?.try_into().ok()?;
            Some(if self.big_endian { $name::from_be_bytes(bytes) } else { $name::from_le_bytes(bytes) })
        }
    };
}

impl<'a> MessageCursor<'a> {
    /// Cursor over packed little-endian data.
    pub(crate) fn packed(data: &'a [u8]) -> Self {
        Self { data, at: 0, alignment: 1, big_endian: false }
    }

    /// Cursor over a message of ROS 2, in CDR behind its four bytes of representation; `None` if it
    /// has none that ROS 2 uses.
    pub fn cdr(data: &'a [u8]) -> Option<Self> {
        Self::new(data, &Serialization::Cdr)
    }

    /// Cursor over a message; `None` if its serialisation is not one of the two.
    pub(crate) fn new(data: &'a [u8], serialization: &Serialization) -> Option<Self> {
        match serialization {
            Serialization::Ros1 => Some(Self::packed(data)),
            Serialization::Cdr => {
                // Two bytes of representation, two of options; numbers are aligned after them.
                let (&[0, representation, _, _], data) = data.split_first_chunk::<4>()? else { return None };
                let alignment = match representation {
                    0 | 1 => 8,
                    // The second version of XCDR aligns to four bytes at most.
                    6 | 7 => 4,
                    _ => return None,
                };
                Some(Self { data, at: 0, alignment, big_endian: representation & 1 == 0 })
            }
            Serialization::Protobuf | Serialization::Other(_) => None,
        }
    }

    number!(u8);
    number!(u16);
    number!(u32);
    number!(u64);
    number!(f32);
    number!(f64);

    /// Reads a number of bytes.
    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let taken = self.data.get(self.at..)?.get(..count)?;
        self.at += count;
        Some(taken)
    }

    /// Number of bytes read so far.
    pub fn position(&self) -> usize {
        self.at
    }

    /// Bytes with their number (32 bits) before them.
    pub fn bytes(&mut self) -> Option<&'a [u8]> {
        let count = usize::try_from(self.u32()?).ok()?;
        self.take(count)
    }

    /// Reads a text.
    pub fn string(&mut self) -> Option<Cow<'a, str>> {
        let text = self.bytes()?;
        // CDR ends a string with a zero and counts it.
        Some(String::from_utf8_lossy(if self.alignment > 1 {
            text.strip_suffix(b"\0").unwrap_or(text)
        } else {
            text
        }))
    }

    /// Reads as many numbers.
    pub fn doubles<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64()?;
        }
        Some(numbers)
    }

    /// A sequence of numbers with its length before it; at most `most`.
    pub fn double_sequence(&mut self, most: usize) -> Option<Vec<f64>> {
        let count = usize::try_from(self.u32()?).ok().filter(|&count| count <= most)?;
        (0..count).map(|_| self.f64()).collect()
    }

    /// A time: seconds and nanoseconds, as nanoseconds.
    pub fn time_ns(&mut self) -> Option<i64> {
        let (seconds, nanoseconds) = (self.u32()?, self.u32()?);
        // ROS 2 has signed seconds, ROS 1 unsigned ones; alike until 2038.
        let seconds = if self.alignment > 1 { i64::from(seconds.cast_signed()) } else { i64::from(seconds) };
        Some(seconds * 1_000_000_000 + i64::from(nanoseconds))
    }

    pub(crate) fn header(&mut self) -> Option<Header<'a>> {
        if self.alignment == 1 {
            // The sequence number of ROS 1.
            self.u32()?;
        }
        Some(Header { stamp_ns: self.time_ns()?, frame: self.string()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cdr_aligns_from_behind_its_four_bytes() {
        let little = [0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f];
        let mut cursor = MessageCursor::new(&little, &Serialization::Cdr).unwrap();
        assert_eq!((cursor.u8(), cursor.f64(), cursor.u8()), (Some(7), Some(1.0), None));
        let big = [0, 0, 0, 0, 7, 0, 0, 0, 0, 0, 1, 2];
        let mut cursor = MessageCursor::new(&big, &Serialization::Cdr).unwrap();
        assert_eq!((cursor.u8(), cursor.u32()), (Some(7), Some(258)));
        // XCDR version 2 aligns a double to four bytes.
        let second = [0, 7, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f];
        let mut cursor = MessageCursor::new(&second, &Serialization::Cdr).unwrap();
        assert_eq!((cursor.u8(), cursor.f64()), (Some(7), Some(1.0)));
        assert!(MessageCursor::new(&[0, 3, 0, 0], &Serialization::Cdr).is_none());
        assert!(MessageCursor::new(&[0, 1], &Serialization::Cdr).is_none());
    }

    #[test]
    fn strings_and_headers_of_both_kinds() {
        let ros1 = [9, 0, 0, 0, 1, 0, 0, 0, 5, 0, 0, 0, 2, 0, 0, 0, b'a', b'b'];
        let header = MessageCursor::packed(&ros1).header().unwrap();
        assert_eq!(header, Header { stamp_ns: 1_000_000_005, frame: "ab".into() });
        let ros2 = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 5, 0, 0, 0, 3, 0, 0, 0, b'a', b'b', 0];
        let header = MessageCursor::new(&ros2, &Serialization::Cdr).unwrap().header().unwrap();
        assert_eq!(header, Header { stamp_ns: -999_999_995, frame: "ab".into() });
    }

    #[test]
    fn lengths_beyond_the_end_are_refused() {
        let mut cursor = MessageCursor::packed(&[0xff, 0xff, 0xff, 0xff, 1]);
        assert!(cursor.clone().bytes().is_none());
        assert!(cursor.clone().double_sequence(usize::MAX).is_none());
        assert!(cursor.double_sequence(8).is_none());
    }
}
