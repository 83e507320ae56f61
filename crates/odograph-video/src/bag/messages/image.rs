//! Image messages: `sensor_msgs/Image`, `sensor_msgs/CompressedImage`, and packets of videos.

use super::{RawImage, Role, VideoMessage, VideoPacket, protobuf};
use crate::bag::cursor::{MessageCursor, Serialization};
use crate::bag::recording::Topic;
use crate::bayer::BayerPattern;
use crate::container::VideoCodec;
use crate::frame::Picture;
use crate::guard::guarded;
use crate::pictures;
use crate::samples::SampleLayout;
use odograph::error::{Error, Result};

fn cut_off() -> Error {
    Error::input("an image message is cut off or damaged")
}

/// Reads an uncompressed image, without its pixels.
pub(crate) fn raw_image<'a>(topic: &Topic, data: &'a [u8]) -> Result<RawImage<'a>> {
    if topic.serialization == Serialization::Protobuf {
        return protobuf::raw_image(data).ok_or_else(cut_off);
    }
    let read = || {
        let mut message = MessageCursor::new(data, &topic.serialization)?;
        message.header()?;
        let (height, width) = (message.u32()? as usize, message.u32()? as usize);
        let (encoding, big_endian) = (message.string()?, message.u8()? != 0);
        let step = message.u32()? as usize;
        Some(RawImage { width, height, encoding, big_endian, step, data: message.bytes()? })
    };
    read().ok_or_else(cut_off)
}

impl RawImage<'_> {
    /// Layout of an encoding of `sensor_msgs/image_encodings`; `None` if it is not read. Samples of
    /// two bytes have this number of bits in use.
    fn layout(&self, bits: u32) -> Option<SampleLayout> {
        Some(match self.encoding.as_ref() {
            "mono8" | "8UC1" | "8uc1" => SampleLayout::Gray,
            "mono16" => SampleLayout::Gray16 { big_endian: self.big_endian, bits },
            "rgb8" => SampleLayout::Rgb,
            // OpenCV's order.
            "bgr8" | "8UC3" | "8uc3" => SampleLayout::Bgr,
            "rgba8" => SampleLayout::Rgba,
            "bgra8" | "8UC4" | "8uc4" => SampleLayout::Bgra,
            "yuv422" | "uyvy" => SampleLayout::Uyvy,
            "yuv422_yuy2" | "yuyv" => SampleLayout::Yuyv,
            "nv12" => SampleLayout::Nv12,
            "bayer_rggb8" => SampleLayout::Bayer(BayerPattern::Rggb),
            "bayer_bggr8" => SampleLayout::Bayer(BayerPattern::Bggr),
            "bayer_gbrg8" => SampleLayout::Bayer(BayerPattern::Gbrg),
            "bayer_grbg8" => SampleLayout::Bayer(BayerPattern::Grbg),
            _ => return None,
        })
    }

    fn picture(&self, bits: u32, color: bool) -> Result<Picture> {
        let layout = self.layout(bits).ok_or_else(|| {
            Error::input(format!(
                "images with the encoding {:?} are not read; mono8, mono16, rgb8, bgr8, rgba8, bgra8, yuv422, \
                 yuv422_yuy2, nv12 and bayer_*8 are",
                self.encoding
            ))
        })?;
        Picture::from_samples(layout, self.width, self.height, self.step, self.data, color)
    }
}

/// The bytes of a compressed image.
fn compressed_image<'a>(topic: &Topic, data: &'a [u8]) -> Result<&'a [u8]> {
    if topic.serialization == Serialization::Protobuf {
        return protobuf::compressed_image(data).ok_or_else(cut_off);
    }
    let read = || {
        let mut message = MessageCursor::new(data, &topic.serialization)?;
        message.header()?;
        message.string()?;
        message.bytes()
    };
    read().ok_or_else(cut_off)
}

/// Numbers of bits that the samples of cameras have, in two bytes each.
const BITS: [u32; 4] = [10, 12, 14, 16];

/// The bits that the samples of an image of two bytes each have in use; `None` if it is another.
pub(crate) fn gray_bits(topic: &Topic, data: &[u8]) -> Option<u32> {
    if Role::of(topic) != Role::Image {
        return None;
    }
    let image = raw_image(topic, data).ok().filter(|image| image.encoding == "mono16" && image.step > 0)?;
    let read = if image.big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
    let rows = image.data.chunks(image.step).take(image.height);
    let samples = rows.flat_map(|row| row.chunks_exact(2).take(image.width));
    let most = samples.map(|sample| u32::from(read([sample[0], sample[1]]))).max()?;
    BITS.into_iter().find(|bits| most < 1 << bits)
}

/// Decodes the image of a message; samples of two bytes have `bits` in use.
///
/// Fails if it is damaged, or in an encoding that is not read.
pub(crate) fn picture(topic: &Topic, data: &[u8], bits: u32, color: bool) -> Result<Picture> {
    match Role::of(topic) {
        Role::CompressedImage => {
            let bytes = compressed_image(topic, data)?;
            guarded("image", || pictures::decode(bytes, color))?
        }
        _ => raw_image(topic, data)?.picture(bits, color),
    }
}

/// Whether the image of a message shows light: a depth image does not, nor is an encoding read that
/// is unknown. Damaged images and videos are taken for pictures.
pub(crate) fn is_picture(topic: &Topic, data: &[u8]) -> bool {
    match Role::of(topic) {
        Role::Image => raw_image(topic, data).map_or(true, |image| image.layout(16).is_some()),
        Role::CompressedImage => !is_compressed_depth(topic, data),
        _ => true,
    }
}

/// Whether the format of a compressed image, such as `16UC1; compressedDepth png`, is one of depth.
fn is_compressed_depth(topic: &Topic, data: &[u8]) -> bool {
    let format = || {
        let mut message = MessageCursor::new(data, &topic.serialization)?;
        message.header()?;
        message.string()
    };
    format().is_some_and(|format| {
        ["16UC1", "32FC1"].iter().any(|depth| format.starts_with(depth)) || format.contains("compressedDepth")
    })
}

/// Encoding of an image for people, e.g. `bgr8` or `jpeg`.
pub(crate) fn encoding(topic: &Topic, data: &[u8]) -> String {
    match Role::of(topic) {
        Role::Image => raw_image(topic, data).map(|image| image.encoding.into_owned()).unwrap_or_default(),
        Role::CompressedImage => match compressed_image(topic, data).unwrap_or_default() {
            [0xff, 0xd8, ..] => "jpeg".to_owned(),
            [0x89, b'P', b'N', b'G', ..] => "png".to_owned(),
            _ => "unknown".to_owned(),
        },
        Role::Video(kind) => {
            video_packet(topic, kind, data).map(|packet| packet.format.into_owned()).unwrap_or_default()
        }
        _ => String::new(),
    }
}

/// Reads a packet of a video.
pub(crate) fn video_packet<'a>(topic: &Topic, kind: VideoMessage, data: &'a [u8]) -> Result<VideoPacket<'a>> {
    let read = || {
        if topic.serialization == Serialization::Protobuf {
            return protobuf::compressed_video(data);
        }
        let mut message = MessageCursor::new(data, &topic.serialization)?;
        match kind {
            VideoMessage::Foxglove => {
                message.time_ns()?;
                message.string()?;
                let data = message.bytes()?;
                Some(VideoPacket { format: message.string()?, data })
            }
            VideoMessage::FfmpegPacket => {
                message.header()?;
                // Width and height.
                message.u32()?;
                message.u32()?;
                let format = message.string()?;
                // Time in the stream, flags, byte order.
                message.u64()?;
                message.u8()?;
                message.u8()?;
                Some(VideoPacket { format, data: message.bytes()? })
            }
        }
    };
    read().ok_or_else(|| Error::input("a video packet is cut off or damaged"))
}

/// The codec by its name: `h264`, `libx264`, `hevc_nvenc`, …
pub(crate) fn codec(format: &str) -> VideoCodec {
    // What follows a semicolon tells about the pixels before encoding.
    let name = format.split(';').next().unwrap_or("").to_ascii_lowercase();
    match name {
        name if name.contains("264") || name.contains("avc") => VideoCodec::H264,
        name if name.contains("265") || name.contains("hevc") => VideoCodec::H265,
        name if name.contains("vp9") => VideoCodec::Vp9,
        name if name.contains("jpeg") => VideoCodec::MotionJpeg,
        name => VideoCodec::Other(name),
    }
}
