//! YUV4MPEG2 (`.y4m`): uncompressed video with a one-line header, from a file or a pipe.

use crate::codec::narrow_little_endian;
use crate::file_error::unreadable;
use crate::frame::{Chroma, Color, ColorEncoding, Picture};
use crate::limits;
use crate::opened::{Frames, Opened};
use crate::pipe;
use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use std::io::{BufRead, Read};

/// Magic number at the start of every stream.
pub(crate) const MAGIC: &[u8] = b"YUV4MPEG2";
/// Longest header line, bytes.
const MAX_LINE: u64 = 4096;

/// Layout of a frame, from the `C` tag of the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Y4mLayout {
    /// Chroma subsampling: divisors of the luminance width and height; `None` for monochrome.
    chroma_divisors: Option<(usize, usize)>,
    /// Whether there is a fourth plane (alpha) at the size of the luminance.
    alpha: bool,
    bits: u8,
}

impl Y4mLayout {
    fn read(tag: &str) -> Option<Self> {
        let (name, bits) = match tag.strip_prefix("mono") {
            Some("") => ("mono", 8),
            Some(bits) => ("mono", bits.parse().ok()?),
            None => match tag.split_once('p') {
                Some((name, bits)) if bits.bytes().all(|b| b.is_ascii_digit()) && !bits.is_empty() => {
                    (name, bits.parse().ok()?)
                }
                _ => (tag, 8),
            },
        };
        let (chroma_divisors, alpha) = match name {
            "mono" => (None, false),
            "420" | "420jpeg" | "420mpeg2" | "420paldv" => (Some((2, 2)), false),
            "422" => (Some((2, 1)), false),
            "444" => (Some((1, 1)), false),
            "444alpha" => (Some((1, 1)), true),
            "411" => (Some((4, 1)), false),
            _ => return None,
        };
        (8..=16).contains(&bits).then_some(Self { chroma_divisors, alpha, bits })
    }
}

/// Reads the frames of a Y4M stream.
pub(crate) struct Y4m<R> {
    reader: R,
    width: usize,
    height: usize,
    layout: Y4mLayout,
    full_range: bool,
    keep_color: bool,
    number: u64,
    luminance: Vec<u8>,
    blue: Vec<u8>,
    red: Vec<u8>,
    warnings: Vec<String>,
    ended: bool,
}

/// Reads the header. `byte_length` is the file size, if known, to estimate the number of frames.
pub(crate) fn open<R: BufRead + Send + 'static>(
    mut reader: R,
    byte_length: Option<u64>,
    keep_color: bool,
) -> Result<Opened> {
    let no_stream = |why: &str| {
        Error::input(format!(
            "this is not a Y4M stream ({why}); give the name of the file, or a pipe from ffmpeg -i FILE -f yuv4mpegpipe -"
        ))
    };
    // As a pipe is whose program did not start.
    if reader.fill_buf().map_err(unreadable)?.is_empty() {
        return Err(Error::input(
            "there is nothing in it, not even the header of a Y4M stream; look at what the program that should write it says",
        ));
    }
    let header = line(&mut reader)?.ok_or_else(|| no_stream("its first line does not end"))?;
    let mut tags = header.split(' ');
    if tags.next() != Some("YUV4MPEG2") {
        return Err(no_stream("it does not start with YUV4MPEG2"));
    }
    let (mut width, mut height, mut rate, mut full_range) = (0, 0, None, false);
    let mut tag_of_layout = "420jpeg";
    for tag in tags.filter(|t| !t.is_empty()) {
        let (key, value) = tag.split_at_checked(1).unwrap_or((tag, ""));
        match key {
            "W" => width = value.parse().unwrap_or(0),
            "H" => height = value.parse().unwrap_or(0),
            "F" => {
                rate = value.split_once(':').and_then(|(n, d)| {
                    let (n, d): (u32, u32) = (n.parse().ok()?, d.parse().ok()?);
                    (n > 0 && d > 0).then(|| f64::from(n) / f64::from(d))
                });
            }
            "C" => tag_of_layout = value,
            "X" => full_range |= value == "COLORRANGE=FULL",
            _ => {}
        }
    }
    let layout = Y4mLayout::read(tag_of_layout).ok_or_else(|| {
        Error::input(format!(
            "the Y4M colour space {tag_of_layout} is not known; 420, 422, 444, 411 and mono are"
        ))
    })?;
    limits::check_size(width, height)?;
    let y4m = Y4m {
        reader,
        width,
        height,
        layout,
        full_range,
        keep_color,
        number: 0,
        luminance: Vec::new(),
        blue: Vec::new(),
        red: Vec::new(),
        warnings: Vec::new(),
        ended: false,
    };
    let frame_bytes = y4m.frame_bytes() + 6;
    let bytes_of_frames = byte_length.map(|length| length.saturating_sub(header.len() as u64 + 1));
    Ok(Opened {
        frame_count: bytes_of_frames.map(|bytes| bytes.div_ceil(frame_bytes)),
        frames_within: bytes_of_frames
            .filter(|bytes| bytes.is_multiple_of(frame_bytes))
            .map(|bytes| (bytes / frame_bytes, bytes / frame_bytes)),
        description: format!("Y4M ({tag_of_layout})"),
        times_known: false,
        timestamps_used: false,
        frames_per_second: rate,
        frames: Box::new(y4m),
    })
}

/// Reads one line, without its line feed; `None` if it does not end.
fn line(reader: &mut impl BufRead) -> Result<Option<String>> {
    let mut bytes = Vec::new();
    reader.take(MAX_LINE).read_until(b'\n', &mut bytes).map_err(unreadable)?;
    if bytes.pop_if(|b| *b == b'\n').is_none() && bytes.len() as u64 == MAX_LINE {
        return Ok(None);
    }
    Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
}

impl<R: BufRead> Y4m<R> {
    /// Adds a warning about the stream. Where the wait for the rest was ended, it is not at fault.
    fn warn(&mut self, warning: String) {
        if !pipe::is_ended() {
            self.warnings.push(warning);
        }
    }

    fn sample_bytes(&self) -> u64 {
        if self.layout.bits > 8 { 2 } else { 1 }
    }

    fn chroma_size(&self) -> Option<(usize, usize)> {
        let (across, down) = self.layout.chroma_divisors?;
        Some((self.width.div_ceil(across), self.height.div_ceil(down)))
    }

    fn frame_bytes(&self) -> u64 {
        let luminance = (self.width * self.height) as u64;
        let chroma = self.chroma_size().map_or(0, |(w, h)| (w * h) as u64);
        let alpha = if self.layout.alpha { luminance } else { 0 };
        self.sample_bytes() * (luminance + 2 * chroma + alpha)
    }

    fn narrowed(&self, samples: Vec<u8>) -> Vec<u8> {
        match self.layout.bits - 8 {
            0 => samples,
            shift => narrow_little_endian(&samples, shift),
        }
    }

    /// Reads one plane; false if the stream ends inside it.
    fn plane(&mut self, samples: u64, which: fn(&mut Self) -> &mut Vec<u8>) -> Result<bool> {
        let bytes = samples * self.sample_bytes();
        let mut plane = std::mem::take(which(self));
        plane.clear();
        let read = (&mut self.reader).take(bytes).read_to_end(&mut plane).map_err(unreadable)?;
        *which(self) = plane;
        Ok(read as u64 == bytes)
    }
}

impl<R: BufRead + Send> Frames for Y4m<R> {
    fn advance(&mut self) -> Result<Option<f64>> {
        if self.ended {
            return Ok(None);
        }
        self.ended = true;
        let head = line(&mut self.reader)?;
        if head.as_ref().is_some_and(String::is_empty) {
            return Ok(None);
        }
        if head.is_none_or(|head| head.split(' ').next() != Some("FRAME")) {
            self.warn(format!("what follows frame {} is not Y4M and was ignored", self.number));
            return Ok(None);
        }
        let luminance = (self.width * self.height) as u64;
        let chroma = self.chroma_size().map_or(0, |(w, h)| (w * h) as u64);
        let whole = self.plane(luminance, |s| &mut s.luminance)?
            && self.plane(chroma, |s| &mut s.blue)?
            && self.plane(chroma, |s| &mut s.red)?;
        let alpha = if self.layout.alpha { luminance * self.sample_bytes() } else { 0 };
        let skipped = std::io::copy(&mut (&mut self.reader).take(alpha), &mut std::io::sink()).unwrap_or(0);
        if !whole || skipped != alpha {
            self.warn(format!("the stream is cut off inside frame {}", self.number));
            return Ok(None);
        }
        self.ended = false;
        self.number += 1;
        Ok(Some((self.number - 1) as f64))
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        let luminance = std::mem::take(&mut self.luminance);
        let gray = GrayImage::from_samples(self.width, self.height, self.narrowed(luminance))
            .ok_or_else(|| Error::input("the frame was already taken"))?;
        let color = self.chroma_size().filter(|_| self.keep_color).map(|(width, height)| {
            let (blue, red) = (std::mem::take(&mut self.blue), std::mem::take(&mut self.red));
            Color::Chroma(Chroma {
                width,
                height,
                blue: self.narrowed(blue),
                red: self.narrowed(red),
                encoding: ColorEncoding { full_range: self.full_range, ..ColorEncoding::default() },
            })
        });
        Ok(Some(Picture { gray, color }))
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    fn frames(bytes: &[u8], color: bool) -> (Vec<Picture>, Vec<String>) {
        let mut opened = open(Cursor::new(bytes.to_vec()), None, color).unwrap();
        let mut pictures = Vec::new();
        while opened.frames.advance().unwrap().is_some() {
            pictures.push(opened.frames.picture().unwrap().unwrap());
        }
        (pictures, opened.frames.take_warnings())
    }

    #[test]
    fn luminance_is_unconverted_and_420_has_three_planes() {
        let bytes = b"YUV4MPEG2 W3 H2 F25:1 Ip C420jpeg\nFRAME\nabcdef1234FRAME Xy\nABCDEF1234";
        let (pictures, warnings) = frames(bytes, true);
        assert!(warnings.is_empty());
        assert_eq!(pictures[0].gray.samples(), b"abcdef");
        assert_eq!(pictures[1].gray.samples(), b"ABCDEF");
        let Some(Color::Chroma(chroma)) = &pictures[0].color else { panic!("no colour") };
        assert_eq!((chroma.width, chroma.height, &chroma.red[..]), (2, 1, &b"34"[..]));
        assert!(frames(bytes, false).0[0].color.is_none());
    }

    #[test]
    fn deep_samples_are_rounded_to_eight_bits() {
        let mut bytes = b"YUV4MPEG2 W2 H1 Cmono10\nFRAME\n".to_vec();
        bytes.extend([0xfe, 3, 5, 1]); // 1022 and 261 of 1023
        assert_eq!(frames(&bytes, true).0[0].gray.samples(), &[255, 65]);
    }

    #[test]
    fn a_truncated_stream_yields_its_complete_frames_and_a_warning() {
        let (pictures, warnings) = frames(b"YUV4MPEG2 W2 H1 Cmono\nFRAME\nabFRAME\nc", false);
        assert_eq!(pictures.len(), 1);
        assert_eq!(warnings, ["the stream is cut off inside frame 1"]);
    }

    #[test]
    fn what_follows_the_last_frame_is_ignored_with_a_warning() {
        for rest in [b"FRAMX\nab".to_vec(), vec![0x80; 10_000]] {
            let bytes = [b"YUV4MPEG2 W2 H1 Cmono\nFRAME\nab".to_vec(), rest].concat();
            let (pictures, warnings) = frames(&bytes, false);
            assert_eq!(pictures.len(), 1);
            assert_eq!(warnings, ["what follows frame 1 is not Y4M and was ignored"]);
        }
    }

    #[test]
    fn invalid_headers_are_rejected() {
        for header in
            ["YUV4MPEG2 W0 H2\n", "YUV4MPEG2 W2 H2 C999\n", "RIFF\n", "", "YUV4MPEG2 W99999999 H2\n"]
        {
            assert!(open(Cursor::new(header.as_bytes().to_vec()), None, false).is_err(), "{header}");
        }
    }
}
