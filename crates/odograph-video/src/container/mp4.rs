//! MP4 and QuickTime (ISO/IEC 14496-12, QuickTime File Format), including fragmented and truncated
//! files.
//!
//! Only the index is held in memory; samples are read from the file by their offsets.

use super::bytes::read_up_to;
use super::mp4_boxes::{Sample, box_header};
use super::mp4_fragments::Fragments;
use super::mp4_tables::{self, Edit};
use super::{Packet, PacketReader, VideoCodec, VideoTrack};
use crate::file_error::unreadable;
use crate::limits;
use odograph::error::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};

/// Most parts of an edit list: each is compared with each frame. Cameras write two.
const MAX_EDITS: usize = 256;

/// Pictures of H.265 that may be skipped because they refer to pictures before the start (H.265,
/// A.4: at most 16 are held back for reordering).
const MAX_LEADING_PICTURES: u64 = 16;

/// Reads the samples of the first video track of an MP4 or QuickTime file.
pub(crate) struct Mp4Reader {
    file: BufReader<File>,
    track: VideoTrack,
    samples: Vec<Sample>,
    /// Ticks per second of the sample timestamps.
    timescale: f64,
    edits: Vec<Edit>,
    next: usize,
    warnings: Vec<String>,
}

impl Mp4Reader {
    pub fn open(file: File) -> Result<Self> {
        let length = file.metadata().map(|m| m.len()).unwrap_or(0);
        let mut file = BufReader::with_capacity(1 << 16, file);
        let mut warnings = Vec::new();
        let index = read_index(&mut file, length, &mut warnings)?;
        let movie = mp4_tables::movie(&index.moov, &index.fragments)?;

        let mut samples = movie.samples;
        let promised = samples.len();
        if promised == 0 {
            return Err(Error::input(if index.cut {
                "the file is cut off inside its index (the moov box), before the places of its frames; copy or record it again"
            } else {
                "the video in this file has no frames; record it again"
            }));
        }
        let complete = samples.iter().position(|s| s.offset.saturating_add(u64::from(s.size)) > length);
        if let Some(complete) = complete {
            samples.truncate(complete);
            warnings.push(format!(
                "the file is cut off: {complete} of the {promised} frames it should have are there"
            ));
        } else if index.cut {
            warnings.push("the file is cut off inside its last fragment".to_string());
        }
        if let Some(too_large) = samples.iter().position(|s| u64::from(s.size) > limits::MAX_SAMPLE_BYTES) {
            return Err(Error::input(format!("frame {too_large} claims to take more than 256 MB")));
        }
        let mut edits = movie.edits;
        if edits.len() > MAX_EDITS {
            warnings.push(format!(
                "the edit list has {} parts, more than {MAX_EDITS}, and was ignored",
                edits.len()
            ));
            edits.clear();
        }
        if samples.is_empty() {
            return Err(Error::input(format!(
                "the file is cut off: none of its {promised} frames is there; copy or record it again"
            )));
        }
        if !edits.is_empty() && samples.iter().all(|s| time_of(&edits, 1.0, s.time).is_none()) {
            warnings.push("the edit list shows no frame at all and was ignored".to_string());
            edits.clear();
        }
        let timescale = f64::from(movie.timescale);
        begin_with_a_frame(&mut edits, &samples, timescale);
        let mut track = movie.track;
        let count = samples.iter().filter(|s| shown(&edits, s.time)).count() as u64;
        track.frame_count = Some(count);
        let skipped = if track.codec == VideoCodec::H265 { MAX_LEADING_PICTURES } else { 0 };
        let is_whole = complete.is_none() && !index.cut;
        track.frames_within = is_whole.then_some((count.saturating_sub(skipped), count));
        Ok(Self { file, track, samples, timescale, edits, next: 0, warnings })
    }
}

impl PacketReader for Mp4Reader {
    fn track(&self) -> &VideoTrack {
        &self.track
    }

    fn next_packet(&mut self, packet: &mut Packet) -> Result<bool> {
        let Some(sample) = self.samples.get(self.next) else { return Ok(false) };
        let here = self.file.stream_position().map_err(unreadable)?;
        // A relative seek keeps the buffer if the next sample follows the last one.
        self.file.seek_relative(sample.offset as i64 - here as i64).map_err(unreadable)?;
        read_up_to(&mut self.file, u64::from(sample.size), &mut packet.data)?;
        let time = time_of(&self.edits, self.timescale, sample.time);
        packet.shown = time.is_some();
        packet.time_s = time.unwrap_or_else(|| hidden_time_of(&self.edits, self.timescale, sample.time));
        if self.track.times == super::Times::Unknown {
            packet.time_s = self.next as f64;
        }
        self.next += 1;
        Ok(true)
    }

    fn rewind(&mut self) -> Result<()> {
        self.next = 0;
        Ok(())
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

/// Shifts the edit list so that its first frame is presented without delay: an edit may start
/// between two frames. (ffmpeg does the same.)
fn begin_with_a_frame(edits: &mut [Edit], samples: &[Sample], timescale: f64) {
    let Some(delay_s) = edits.first().map(|e| e.starts_at_s) else { return };
    let first_s =
        samples.iter().filter_map(|s| time_of(edits, timescale, s.time)).fold(f64::INFINITY, f64::min);
    if first_s.is_finite() && first_s > delay_s {
        for edit in edits {
            edit.starts_at_s -= first_s - delay_s;
        }
    }
}

fn shown(edits: &[Edit], time: i64) -> bool {
    edits.is_empty() || edits.iter().any(|e| (e.media_from..e.media_to).contains(&time))
}

/// Presentation time of a sample, seconds; `None` if it is outside the edit list.
fn time_of(edits: &[Edit], timescale: f64, time: i64) -> Option<f64> {
    if edits.is_empty() {
        return Some(time as f64 / timescale);
    }
    let edit = edits.iter().find(|e| (e.media_from..e.media_to).contains(&time))?;
    Some(edit.starts_at_s + (time - edit.media_from) as f64 / timescale)
}

/// Time of a sample outside the edit list, extrapolated from the edit before it (or from the first
/// one). Reordering needs a consistent timestamp for it.
fn hidden_time_of(edits: &[Edit], timescale: f64, time: i64) -> f64 {
    let edit = edits.iter().rfind(|e| e.media_from <= time).or(edits.first());
    edit.map_or(0.0, |e| e.starts_at_s)
        + time.saturating_sub(edit.map_or(0, |e| e.media_from)) as f64 / timescale
}

struct Index {
    moov: Vec<u8>,
    fragments: Fragments,
    /// The file ends inside a box.
    cut: bool,
}

/// Reads the top-level boxes of the index.
fn read_index(file: &mut BufReader<File>, length: u64, warnings: &mut Vec<String>) -> Result<Index> {
    let mut moov: Option<Vec<u8>> = None;
    let mut fragments = Fragments::default();
    let (mut at, mut cut, mut data_seen) = (0u64, false, false);
    while length.saturating_sub(at) >= 8 {
        file.seek(SeekFrom::Start(at)).map_err(unreadable)?;
        let mut header = [0u8; 16];
        let available = (length - at).min(16) as usize;
        file.read_exact(&mut header[..available]).map_err(unreadable)?;
        let Some((kind, header_length, size)) = box_header(&header[..available], length - at) else {
            warnings.push(format!("what follows byte {at} is not MP4 and was ignored"));
            break;
        };
        let payload = size.min(length - at).saturating_sub(header_length);
        cut = size > length - at;
        match &kind {
            b"moov" if moov.is_none() => {
                file.seek(SeekFrom::Start(at + header_length)).map_err(unreadable)?;
                let mut bytes = Vec::new();
                read_up_to(file, payload, &mut bytes)?;
                if cut {
                    warnings.push("the file is cut off inside its index (the moov box)".to_string());
                }
                moov = Some(bytes);
            }
            b"moof" => {
                file.seek(SeekFrom::Start(at + header_length)).map_err(unreadable)?;
                let mut bytes = Vec::new();
                read_up_to(file, payload, &mut bytes)?;
                if !cut {
                    fragments.add(at, &bytes)?;
                }
            }
            b"mdat" => data_seen = true,
            _ => {}
        }
        at = at.saturating_add(size);
    }
    match moov {
        Some(moov) => Ok(Index { moov, fragments, cut }),
        None if data_seen => Err(Error::input(
            "the index (the moov box) is missing: the recording was cut off or never finished, and without its index no frame can be found; a repair tool such as untrunc can rebuild it from another recording of the same camera",
        )),
        None => Err(Error::input(
            "there is no index (moov box) and no video in this MP4 file; copy or record it again",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hidden_sample_may_be_far_from_every_edit() {
        let edit = Edit { starts_at_s: 0.0, media_from: i64::MAX, media_to: i64::MAX };
        assert!(hidden_time_of(&[edit], 90.0, -10_000_000_000).is_finite());
    }
}
