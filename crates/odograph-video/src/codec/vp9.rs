//! VP9 with `rusty_vp9`: all profiles, 8 to 12 bits.

use super::{DecodeResult, Decoded, Decoder, Refusal, Stamp, StreamFacts, narrow_little_endian};
use crate::container::VideoTrack;
use crate::frame::{Chroma, ColorEncoding, Matrix, Picture};
use crate::guard::guarded;
use crate::limits;
use odograph::error::Error;
use rusty_vp9::{BitReader, Vp9Decoder, parse_uncompressed_header};

/// Decodes a packet to at most one picture; in VP9 the presentation order is the order of the
/// packets.
pub(crate) struct Vp9 {
    decoder: Vp9Decoder,
    encoding: Option<ColorEncoding>,
    stream_encoding: ColorEncoding,
    color: bool,
    number: i64,
}

impl Vp9 {
    pub fn new(track: &VideoTrack, color: bool) -> Self {
        Self {
            decoder: Vp9Decoder::new(),
            encoding: track.encoding,
            stream_encoding: ColorEncoding::default(),
            color,
            number: 0,
        }
    }
}

impl Decoder for Vp9 {
    fn decode(&mut self, data: &[u8], stamp: Stamp, out: &mut Vec<Decoded>) -> DecodeResult {
        let head = guarded("VP9", || parse_uncompressed_header(&mut BitReader::new(data), &[(0, 0); 8]))?;
        if let Ok(head) = head {
            if head.sized && head.width > 0 && head.height > 0 {
                limits::check_video_size(head.width as usize, head.height as usize)?;
            }
            if head.key_frame {
                // VP9 bitstream specification, 7.2.2: color_space.
                self.stream_encoding.matrix = match head.color_space {
                    1 | 3 | 4 => Matrix::Bt601,
                    2 => Matrix::Bt709,
                    5 => Matrix::Bt2020,
                    _ => Matrix::Unspecified,
                };
                if head.color_space == 7 {
                    return Err(Refusal::Unsupported("RGB".into()));
                }
            }
        }
        let damaged = |error: rusty_vp9::Error| Refusal::Damaged(error.to_string());
        guarded("VP9", || self.decoder.push(data, None))?.map_err(damaged)?;
        // A packet has at most eight frames; each call decodes one.
        for _ in 0..9 {
            let frame = match guarded("VP9", || self.decoder.next_frame())? {
                Ok(frame) => frame,
                Err(rusty_vp9::Error::Again) => continue,
                Err(rusty_vp9::Error::Eof) => break,
                Err(error @ (rusty_vp9::Error::Unsupported(_) | rusty_vp9::Error::Unimplemented(_))) => {
                    return Err(Refusal::Unsupported(error.to_string()));
                }
                Err(error) => return Err(damaged(error)),
            };
            let shift = frame.bit_depth.saturating_sub(8) as u8;
            let mut planes = frame.planes.into_iter().map(|p| match shift {
                0 => p,
                shift => narrow_little_endian(&p, shift),
            });
            let (width, height) = (frame.width as usize, frame.height as usize);
            let luminance = planes.next().unwrap_or_default();
            let chroma = match (planes.next(), planes.next()) {
                (Some(blue), Some(red)) if self.color => Some(Chroma {
                    width: (width + frame.subsampling_x as usize) >> frame.subsampling_x,
                    height: (height + frame.subsampling_y as usize) >> frame.subsampling_y,
                    blue,
                    red,
                    encoding: self.encoding.unwrap_or(self.stream_encoding),
                }),
                _ => None,
            };
            let picture = Picture::from_planes((width, height), luminance, chroma).ok_or_else(|| {
                Refusal::Broken(Error::input("the VP9 decoder gave a picture of the wrong size"))
            })?;
            self.number += 1;
            out.push(Decoded { picture, stamp, order: self.number, starts_group: false });
        }
        Ok(())
    }

    fn stream(&self) -> StreamFacts {
        StreamFacts::named("VP9")
    }
}
