//! Sample description of an MP4 video track (ISO/IEC 14496-12, 8.5.2 and 12.1).

use super::bytes::Bytes;
use super::mp4_boxes::{Boxes, child};
use super::{Times, VideoCodec, VideoTrack};
use crate::frame::{ColorEncoding, Matrix};

/// Codec, size and codec configuration of the first sample entry.
pub(super) fn describe(stsd: &[u8]) -> Option<VideoTrack> {
    let mut bytes = Bytes::new(stsd);
    bytes.skip(8)?;
    let (kind, entry) = Boxes(bytes.rest()).next()?;
    let mut bytes = Bytes::new(entry);
    bytes.skip(24)?;
    let (width, height) = (usize::from(bytes.u16()?), usize::from(bytes.u16()?));
    bytes.skip(50)?;
    let inside = bytes.rest();
    let payload = |kind| child(inside, kind).map(|b| b.rest().to_vec());
    let (codec, configuration) = match &kind {
        b"avc1" | b"avc2" | b"avc3" | b"avc4" | b"dva1" | b"dvav" => (VideoCodec::H264, payload(b"avcC")),
        b"hvc1" | b"hev1" | b"dvh1" | b"dvhe" => (VideoCodec::H265, payload(b"hvcC")),
        b"vp09" => (VideoCodec::Vp9, None),
        b"jpeg" | b"mjpa" | b"mjpg" | b"MJPG" => (VideoCodec::MotionJpeg, None),
        b"mp4v" => match payload(b"esds").as_deref().and_then(object_type) {
            Some(0x6c) => (VideoCodec::MotionJpeg, None),
            Some(0x60..=0x65) => (VideoCodec::Other("MPEG-2 video".into()), None),
            Some(0x6a) => (VideoCodec::Other("MPEG-1 video".into()), None),
            _ => (VideoCodec::Other("MPEG-4 part 2 video".into()), None),
        },
        other => (VideoCodec::Other(name(other)), None),
    };
    Some(VideoTrack {
        width,
        height,
        configuration: configuration.unwrap_or_default(),
        encoding: child(inside, b"colr").and_then(|b| color(b.rest())),
        ..VideoTrack::new("MP4", codec, Times::Decoding)
    })
}

/// Common name of a codec from its FourCC.
fn name(kind: &[u8; 4]) -> String {
    match kind {
        b"av01" => "AV1".into(),
        b"vp08" => "VP8".into(),
        b"encv" => "encrypted video".into(),
        b"s263" | b"h263" => "H.263".into(),
        b"apch" | b"apcn" | b"apcs" | b"apco" | b"ap4h" | b"ap4x" => "ProRes".into(),
        b"SVQ3" => "Sorenson Video 3".into(),
        b"rle " => "QuickTime Animation".into(),
        b"raw " | b"2vuy" | b"yuv2" | b"v210" => "uncompressed video".into(),
        b"mjpb" => "Motion JPEG B".into(),
        b"AVdn" => "DNxHD".into(),
        b"vvc1" | b"vvi1" => "VVC".into(),
        other => format!("'{}' video", String::from_utf8_lossy(other).trim()),
    }
}

/// `objectTypeIndication` of an `esds` box (14496-1, 7.2.6).
fn object_type(esds: &[u8]) -> Option<u8> {
    let mut bytes = Bytes::new(esds);
    bytes.skip(4)?;
    let descriptor = |bytes: &mut Bytes<'_>| -> Option<u8> {
        let tag = bytes.u8()?;
        for _ in 0..4 {
            if bytes.u8()? & 0x80 == 0 {
                break;
            }
        }
        Some(tag)
    };
    if descriptor(&mut bytes)? == 3 {
        bytes.skip(2)?;
        let flags = bytes.u8()?;
        if flags & 0x80 != 0 {
            bytes.skip(2)?;
        }
        if flags & 0x40 != 0 {
            let length = bytes.u8()?;
            bytes.skip(usize::from(length))?;
        }
        if flags & 0x20 != 0 {
            bytes.skip(2)?;
        }
        descriptor(&mut bytes).filter(|&tag| tag == 4)?;
    }
    bytes.u8()
}

/// The `colr` box of kind `nclx` (14496-12, 12.1.5) or QuickTime's `nclc`.
fn color(colr: &[u8]) -> Option<ColorEncoding> {
    let mut bytes = Bytes::new(colr);
    let kind = bytes.take(4)?;
    bytes.skip(4)?;
    let matrix = Matrix::from_h273(u64::from(bytes.u16()?));
    match kind {
        b"nclx" => Some(ColorEncoding { matrix, full_range: bytes.u8()? & 0x80 != 0 }),
        b"nclc" => Some(ColorEncoding { matrix, full_range: false }),
        _ => None,
    }
}
