//! Raw frames without headers, from a pipe.

use super::{Captured, LiveSource, Watch};
use odograph::error::{Error, Result};
use odograph_video::{Frame, Picture, SampleLayout, SourceInfo};
use std::io::{ErrorKind, Read};
use std::time::Instant;

/// Format of raw frames; the stream itself does not contain it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawFormat {
    /// Sample layout.
    pub layout: SampleLayout,
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// Frame rate, frames per second, > 0.
    pub frames_per_second: f64,
}

impl std::str::FromStr for RawFormat {
    type Err = String;

    /// Parses `gray:640x480@30`, `yuyv:…` or `rgb:…`.
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let parsed = || {
            let (layout, rest) = text.split_once(':')?;
            let (size, rate) = rest.split_once('@')?;
            let (width, height) = size.split_once('x')?;
            let layout = match layout.to_ascii_lowercase().as_str() {
                "gray" | "grey" | "y8" => SampleLayout::Gray,
                "yuyv" => SampleLayout::Yuyv,
                "rgb" => SampleLayout::Rgb,
                _ => return None,
            };
            let frames_per_second: f64 = rate.parse().ok()?;
            let (width, height) = (width.parse().ok()?, height.parse().ok()?);
            let possible = frames_per_second.is_finite() && frames_per_second > 0.0;
            let sized = (1..=16_384).contains(&width) && (1..=16_384).contains(&height);
            (possible && sized).then_some(Self { layout, width, height, frames_per_second })
        };
        parsed().ok_or_else(|| {
            "say what the frames are as gray:640x480@30, yuyv:640x480@30 or rgb:640x480@30".to_owned()
        })
    }
}

/// A source of raw frames from a reader.
pub struct RawFrames<R> {
    reader: R,
    format: RawFormat,
    info: SourceInfo,
    number: u64,
    buffer: Vec<u8>,
    watch: Watch,
    warnings: Vec<String>,
}

impl<R: Read + Send> RawFrames<R> {
    /// Creates a source that reads frames of `format`.
    pub fn new(reader: R, format: RawFormat, watch: Watch) -> Self {
        let RawFormat { layout, width, height, frames_per_second } = format;
        let name = layout.name();
        let info = SourceInfo {
            width,
            height,
            frame_count: None,
            description: format!("raw {name} frames, {width}x{height}, {frames_per_second} frames/s"),
        };
        Self { reader, format, info, number: 0, buffer: Vec::new(), watch, warnings: Vec::new() }
    }
}

impl<R: Read + Send> LiveSource for RawFrames<R> {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        if self.watch.ended() {
            return Ok(None);
        }
        let RawFormat { layout, width, height, frames_per_second } = self.format;
        let line = width * layout.bytes_per_pixel();
        self.buffer.resize(line * height, 0);
        let mut filled = 0;
        while filled < self.buffer.len() {
            match self.reader.read(&mut self.buffer[filled..]) {
                Ok(0) => break,
                Ok(read) => filled += read,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(Error::input(format!("the raw frames cannot be read: {error}"))),
            }
        }
        if filled < self.buffer.len() {
            if filled > 0 {
                self.warnings.push(format!("the stream is cut off inside frame {}", self.number));
            }
            return Ok(None);
        }
        let picture = Picture::from_samples(layout, width, height, line, &self.buffer, true)?;
        let time_s = self.number as f64 / frames_per_second;
        self.number += 1;
        Ok(Some(Captured { frame: Frame::new(self.number - 1, time_s, picture), at: Instant::now() }))
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_frames_have_timestamps_and_truncation_is_reported() {
        let format: RawFormat = "gray:3x2@10".parse().unwrap();
        let mut frames = RawFrames::new(&b"abcdefABCDEFxy"[..], format, Watch::default());
        let first = frames.next_frame().unwrap().unwrap().frame;
        assert_eq!((first.gray.samples(), first.time_s), (&b"abcdef"[..], 0.0));
        let second = frames.next_frame().unwrap().unwrap().frame;
        assert_eq!((second.gray.samples(), second.number, second.time_s), (&b"ABCDEF"[..], 1, 0.1));
        assert!(frames.next_frame().unwrap().is_none());
        assert_eq!(frames.take_warnings(), ["the stream is cut off inside frame 2"]);
    }

    #[test]
    fn invalid_raw_formats_are_refused() {
        for text in [
            "gray",
            "gray:640x480",
            "nv12:640x480@30",
            "gray:0x1@30",
            "gray:1x1@0",
            "gray:99999x1@1",
            "gray:1x1@nan",
        ] {
            assert!(text.parse::<RawFormat>().is_err(), "{text}");
        }
    }
}
