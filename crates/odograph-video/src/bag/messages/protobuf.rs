//! The fields of a Protocol Buffers message, and the image messages of Foxglove
//! (<https://docs.foxglove.dev/docs/sdk/schemas>).

use super::{RawImage, VideoPacket};
use std::borrow::Cow;

/// Value of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FieldValue<'a> {
    Number(u64),
    Bytes(&'a [u8]),
}

/// The fields of a message, in their order; ends at the first that is damaged.
struct FieldReader<'a>(&'a [u8]);

impl<'a> FieldReader<'a> {
    fn variable(&mut self) -> Option<u64> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let (&byte, rest) = self.0.split_first()?;
            self.0 = rest;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Some(value);
            }
        }
        None
    }

    fn take(&mut self, count: u64) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(usize::try_from(count).ok()?)?;
        self.0 = rest;
        Some(taken)
    }
}

impl<'a> Iterator for FieldReader<'a> {
    type Item = (u64, FieldValue<'a>);

    fn next(&mut self) -> Option<Self::Item> {
        let key = self.variable()?;
        let value = match key & 7 {
            0 => FieldValue::Number(self.variable()?),
            1 => FieldValue::Number(u64::from_le_bytes(self.take(8)?.try_into().ok()?)),
            2 => {
                let length = self.variable()?;
                FieldValue::Bytes(self.take(length)?)
            }
            5 => FieldValue::Number(u32::from_le_bytes(self.take(4)?.try_into().ok()?).into()),
            _ => return None,
        };
        Some((key >> 3, value))
    }
}

/// Field 1 of every message of Foxglove: `google.protobuf.Timestamp`.
pub(super) fn stamp_ns(data: &[u8]) -> Option<i64> {
    let FieldValue::Bytes(stamp) = FieldReader(data).find(|(field, _)| *field == 1)?.1 else { return None };
    let (mut seconds, mut nanoseconds) = (0, 0);
    for (field, value) in FieldReader(stamp) {
        match (field, value) {
            (1, FieldValue::Number(value)) => seconds = value.cast_signed(),
            (2, FieldValue::Number(value)) => nanoseconds = value.cast_signed(),
            _ => {}
        }
    }
    seconds.checked_mul(1_000_000_000)?.checked_add(nanoseconds)
}

fn text(bytes: &[u8]) -> Cow<'_, str> {
    String::from_utf8_lossy(bytes)
}

/// `foxglove.RawImage`
pub(super) fn raw_image(data: &[u8]) -> Option<RawImage<'_>> {
    let mut image =
        RawImage { width: 0, height: 0, encoding: "".into(), big_endian: false, step: 0, data: &[] };
    for (field, value) in FieldReader(data) {
        match (field, value) {
            (2, FieldValue::Number(width)) => image.width = usize::try_from(width).ok()?,
            (3, FieldValue::Number(height)) => image.height = usize::try_from(height).ok()?,
            (4, FieldValue::Bytes(name)) => image.encoding = text(name),
            (5, FieldValue::Number(step)) => image.step = usize::try_from(step).ok()?,
            (6, FieldValue::Bytes(data)) => image.data = data,
            _ => {}
        }
    }
    Some(image)
}

/// `foxglove.CompressedImage`
pub(super) fn compressed_image(data: &[u8]) -> Option<&[u8]> {
    let fields = FieldReader(data).filter_map(|field| match field {
        (2, FieldValue::Bytes(data)) => Some(data),
        _ => None,
    });
    fields.last()
}

/// `foxglove.CompressedVideo`
pub(super) fn compressed_video(data: &[u8]) -> Option<VideoPacket<'_>> {
    let mut packet = VideoPacket { format: "".into(), data: &[] };
    for (field, value) in FieldReader(data) {
        match (field, value) {
            (3, FieldValue::Bytes(data)) => packet.data = data,
            (4, FieldValue::Bytes(format)) => packet.format = text(format),
            _ => {}
        }
    }
    Some(packet)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_raw_image_of_foxglove() {
        let bytes = [
            &[0x0a, 4, 0x08, 2, 0x10, 5][..],
            &[0x15, 2, 0, 0, 0, 0x1d, 1, 0, 0, 0],
            b"\x22\x05mono8\x2d\x02\x00\x00\x00\x32\x02ab\x3a\x03cam",
        ]
        .concat();
        let image = raw_image(&bytes).unwrap();
        assert_eq!((image.width, image.height, image.step, image.data), (2, 1, 2, &b"ab"[..]));
        assert_eq!(image.encoding, "mono8");
        assert_eq!(stamp_ns(&bytes), Some(2_000_000_005));
        // A length beyond the end ends the message.
        assert_eq!(FieldReader(&[0x0a, 0xff, 0xff, 0xff, 0xff, 0x0f, 1]).count(), 0);
        assert_eq!(FieldReader(&[0xff; 12]).count(), 0);
    }
}
