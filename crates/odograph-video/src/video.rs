//! Decodes samples and reorders the pictures to presentation order.

use crate::codec::{self, Decoded, Decoder, MakeDecoder, Refusal, Stamp};
use crate::container::{Packet, PacketReader, Times, VideoTrack};
use crate::ffmpeg;
use crate::frame::Picture;
use crate::opened::{Frames, Opened};
use odograph::error::{Error, Result};
use std::collections::VecDeque;
use std::path::Path;

/// Opens a track with the first decoder that supports it, otherwise with ffmpeg if ffmpeg can read
/// the file at `path`.
pub(crate) fn open(path: Option<&Path>, reader: Box<dyn PacketReader>, color: bool) -> Result<Opened> {
    let track = reader.track().clone();
    let (decoders, name) = codec::decoders(&track, color)?;
    let through_ffmpeg = |codec: &str| {
        let Some(path) = path else {
            return Err(Error::input(format!(
                "a video of {codec} in {} is not decoded; H.264, H.265, VP9 and Motion JPEG are",
                track.container
            )));
        };
        let content =
            ffmpeg::Content::Video { codec, container: track.container, frame_count: track.frame_count };
        ffmpeg::open(path, content, color)
    };
    let mut decoders = VecDeque::from(decoders);
    let Some(make) = decoders.pop_front() else {
        return through_ffmpeg(&name);
    };
    let mut video = Video {
        reader,
        decoder: make()?,
        others: decoders,
        waiting: Vec::new(),
        group: 0,
        ready: VecDeque::new(),
        given: 0,
        to_skip: 0,
        ended: false,
        damaged: 0,
        first_damage: None,
        current: None,
        track: track.clone(),
        packet: Packet::default(),
    };
    // Decoding the first frame determines whether a decoder supports the stream.
    match video.fill() {
        Ok(()) => {}
        Err(DecodeFailure::Unsupported(what)) => {
            return through_ffmpeg(&format!("{name} ({what})"));
        }
        Err(DecodeFailure::Failed(error)) => return Err(error),
    }
    if video.ready.is_empty() {
        // ffmpeg may decode a stream that is too damaged for these decoders; if it fails, the error
        // message of these decoders is the better one.
        if video.first_damage.is_some()
            && let Ok(opened) = through_ffmpeg(&name)
        {
            return Ok(opened);
        }
        let why = video.first_damage.take().unwrap_or_else(|| "the video has no frames".to_string());
        return Err(Error::input(format!(
            "no frame of this {name} video in {} could be decoded: {why}",
            video.track.container
        )));
    }
    let stream = video.decoder.stream();
    Ok(Opened {
        frame_count: video.track.frame_count,
        frames_within: video.track.frames_within,
        description: format!("{} in {}", stream.description, video.track.container),
        timestamps_used: false,
        times_known: video.track.times != Times::Unknown,
        frames_per_second: stream.frames_per_second,
        frames: Box::new(video),
    })
}

struct Video {
    reader: Box<dyn PacketReader>,
    decoder: Box<dyn Decoder>,
    /// Decoders not tried yet.
    others: VecDeque<MakeDecoder>,
    /// Reorder buffer: decoded pictures with their groups.
    waiting: Vec<(u64, Decoded)>,
    group: u64,
    ready: VecDeque<(Stamp, Picture)>,
    given: u64,
    /// Number of frames to skip, because they were output before another decoder restarted at the
    /// beginning.
    to_skip: u64,
    ended: bool,
    damaged: u64,
    first_damage: Option<String>,
    current: Option<Picture>,
    track: VideoTrack,
    packet: Packet,
}

enum DecodeFailure {
    Unsupported(String),
    Failed(Error),
}

impl From<Error> for DecodeFailure {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

impl Video {
    /// Decodes until a frame is ready or the stream ends.
    fn fill(&mut self) -> std::result::Result<(), DecodeFailure> {
        let mut decoded = Vec::new();
        while self.ready.is_empty() && !self.ended {
            let more = match self.reader.next_packet(&mut self.packet) {
                // Frames read before the error are still output.
                Err(error) if self.given > 0 || !self.waiting.is_empty() => {
                    self.damage(error.to_string());
                    false
                }
                more => more?,
            };
            let outcome = if more {
                let stamp = Stamp { time_s: self.packet.time_s, shown: self.packet.shown };
                self.decoder.decode(&self.packet.data, stamp, &mut decoded)
            } else {
                self.ended = true;
                self.decoder.finish(&mut decoded)
            };
            match outcome {
                Ok(()) => {}
                Err(Refusal::Damaged(what)) => self.damage(what),
                Err(Refusal::Unsupported(what)) => {
                    if self.start_another()? {
                        decoded.clear();
                        continue;
                    }
                    if self.given == 0 && self.waiting.is_empty() && decoded.is_empty() {
                        return Err(DecodeFailure::Unsupported(what));
                    }
                    self.damage(what);
                }
                Err(Refusal::Broken(error)) => {
                    if self.start_another()? {
                        decoded.clear();
                        continue;
                    }
                    self.damage(error.to_string());
                    self.ended = true;
                }
            }
            for picture in decoded.drain(..) {
                if picture.starts_group {
                    self.group += 1;
                    self.release(0);
                }
                self.waiting.push((self.group, picture));
            }
            self.release(if self.ended { 0 } else { self.decoder.stream().reorder_depth });
        }
        Ok(())
    }

    /// Restarts at the beginning with the next decoder; false if there is none.
    fn start_another(&mut self) -> Result<bool> {
        let Some(make) = self.others.pop_front() else { return Ok(false) };
        self.decoder = make()?;
        self.reader.rewind()?;
        self.waiting.clear();
        self.ready.clear();
        self.ended = false;
        self.to_skip = self.given;
        self.damaged = 0;
        self.first_damage = None;
        Ok(true)
    }

    fn damage(&mut self, what: String) {
        self.damaged += 1;
        self.first_damage.get_or_insert(what);
    }

    /// Moves pictures from the reorder buffer to `ready` until at most `depth` remain.
    fn release(&mut self, depth: usize) {
        while self.waiting.len() > depth {
            let order = |(_, (group, decoded)): &(usize, &(u64, Decoded))| (*group, decoded.order);
            let Some((picture, _)) = self.waiting.iter().enumerate().min_by_key(order) else { return };
            // The earliest timestamp belongs to the picture presented first. In a valid file that
            // is the same picture; with decoding timestamps only, it converts them to presentation
            // timestamps.
            let earliest = self
                .waiting
                .iter()
                .enumerate()
                .min_by(|(_, a), (_, b)| a.1.stamp.time_s.total_cmp(&b.1.stamp.time_s))
                .map_or(picture, |(i, _)| i);
            let stamp = self.waiting[earliest].1.stamp;
            self.waiting[earliest].1.stamp = self.waiting[picture].1.stamp;
            let (_, decoded) = self.waiting.remove(picture);
            if !stamp.shown {
                continue;
            }
            if self.to_skip > 0 {
                self.to_skip -= 1;
                continue;
            }
            self.ready.push_back((stamp, decoded.picture));
        }
    }
}

impl Frames for Video {
    fn advance(&mut self) -> Result<Option<f64>> {
        self.fill().map_err(|refused| match refused {
            DecodeFailure::Failed(error) => error,
            DecodeFailure::Unsupported(what) => Error::input(format!("the video cannot be decoded: {what}")),
        })?;
        let Some((stamp, picture)) = self.ready.pop_front() else { return Ok(None) };
        self.given += 1;
        self.current = Some(picture);
        Ok(Some(stamp.time_s))
    }

    fn picture(&mut self) -> Result<Option<Picture>> {
        let picture = self.current.take().ok_or_else(|| Error::input("the frame was already taken"))?;
        Ok(Some(self.track.orientation.upright(picture)))
    }

    fn times(&mut self) -> Result<Vec<f64>> {
        self.reader.rewind()?;
        let mut times = Vec::new();
        while self.reader.next_packet(&mut self.packet)? {
            if self.packet.shown {
                times.push(self.packet.time_s);
            }
        }
        Ok(times)
    }

    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = self.reader.take_warnings();
        if let Some(what) = self.first_damage.take() {
            let damaged = std::mem::take(&mut self.damaged);
            warnings.push(format!(
                "{damaged} damaged pieces of the video were skipped or shown with faults ({what})"
            ));
        }
        warnings
    }
}
