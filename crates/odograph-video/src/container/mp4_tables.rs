//! The index of an MP4 file: boxes, sample tables, fragments, edit lists, the track's description.

use super::bytes::Bytes;
use super::mp4::{Edit, child};
use super::{Codec, Times, Track};
use crate::frame::{ColorEncoding, Matrix};
use crate::limits::MAX_SAMPLES;
use crate::rotation::Orientation;
use odograph::error::{Error, Result};

/// Where a sample lies in the file and when it is shown, in the track's ticks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sample {
    pub offset: u64,
    pub size: u32,
    pub time: i64,
}

pub(super) struct Movie {
    pub track: Track,
    pub timescale: u32,
    pub samples: Vec<Sample>,
    pub edits: Vec<Edit>,
}

/// A box's kind, the length of its header and its whole size; `None` where this is no box.
/// A size of 0 means "to the end", which is `available` bytes away.
pub(super) fn box_header(bytes: &[u8], available: u64) -> Option<([u8; 4], u64, u64)> {
    let mut bytes = Bytes::new(bytes);
    let short = bytes.u32()?;
    let kind: [u8; 4] = bytes.take(4)?.try_into().ok()?;
    if !kind.iter().all(|c| c.is_ascii_graphic() || *c == b' ' || *c == 0xa9) {
        return None;
    }
    match short {
        0 => Some((kind, 8, available.max(8))),
        1 => bytes.u64().filter(|&size| size >= 16).map(|size| (kind, 16, size)),
        2..=7 => None,
        size => Some((kind, 8, u64::from(size))),
    }
}

/// The boxes inside a box; the last one may be cut off.
pub(super) struct Boxes<'a> {
    rest: &'a [u8],
}

impl<'a> Boxes<'a> {
    pub fn new(rest: &'a [u8]) -> Self {
        Self { rest }
    }
}

impl<'a> Iterator for Boxes<'a> {
    type Item = ([u8; 4], &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let (kind, header, size) = box_header(self.rest, self.rest.len() as u64)?;
        let end = usize::try_from(size).unwrap_or(usize::MAX).min(self.rest.len());
        let payload = self.rest.get(header as usize..end)?;
        self.rest = &self.rest[end..];
        Some((kind, payload))
    }
}

/// The first video track that has samples.
pub(super) fn movie(moov: &[u8], fragments: &Fragments) -> Result<Movie> {
    let (movie_timescale, movie_matrix) = movie_header(moov).unwrap_or((1000, UPRIGHT));
    let mut seen = None;
    for (kind, trak) in Boxes::new(moov) {
        if &kind != b"trak" {
            continue;
        }
        let Some(found) = track(trak, movie_timescale, movie_matrix, moov, fragments)? else { continue };
        if !found.samples.is_empty() {
            return Ok(found);
        }
        seen.get_or_insert(found);
    }
    seen.ok_or_else(|| Error::input("there is no video in this file (only sound or other data)"))
}

type Matrix2 = [[i64; 2]; 2];
const UPRIGHT: Matrix2 = [[1, 0], [0, 1]];

/// The movie's timescale and the turning part of its matrix.
fn movie_header(moov: &[u8]) -> Option<(u32, Matrix2)> {
    let mut bytes = child(moov, b"mvhd")?;
    let version = bytes.u32()? >> 24;
    bytes.skip(if version == 1 { 16 } else { 8 })?;
    let timescale = bytes.u32()?;
    bytes.skip(if version == 1 { 8 } else { 4 })?;
    bytes.skip(16)?;
    Some((timescale.max(1), matrix(&mut bytes).unwrap_or(UPRIGHT)))
}

/// The signs of a transformation matrix `{a b u; c d v; x y w}` (14496-12, 8.3.2).
fn matrix(bytes: &mut Bytes<'_>) -> Option<Matrix2> {
    let a = i64::from(bytes.i32()?.signum());
    let b = i64::from(bytes.i32()?.signum());
    bytes.i32()?;
    let c = i64::from(bytes.i32()?.signum());
    let d = i64::from(bytes.i32()?.signum());
    Some([[a, b], [c, d]])
}

/// The orientation of a matrix of quarter turns and mirrorings; upright for any other.
fn orientation(track: Matrix2, movie: Matrix2) -> Orientation {
    let mut m = [[0; 2]; 2];
    for (row, out) in track.iter().zip(m.iter_mut()) {
        for column in 0..2 {
            out[column] = row[0] * movie[0][column] + row[1] * movie[1][column];
        }
    }
    let (mirrored, quarter_turns) = match m {
        [[0, 1], [-1, 0]] => (false, 1),
        [[-1, 0], [0, -1]] => (false, 2),
        [[0, -1], [1, 0]] => (false, 3),
        [[-1, 0], [0, 1]] => (true, 0),
        [[0, -1], [-1, 0]] => (true, 1),
        [[1, 0], [0, -1]] => (true, 2),
        [[0, 1], [1, 0]] => (true, 3),
        _ => (false, 0),
    };
    Orientation { mirrored, quarter_turns }
}

fn track(
    trak: &[u8],
    movie_timescale: u32,
    movie_matrix: Matrix2,
    moov: &[u8],
    fragments: &Fragments,
) -> Result<Option<Movie>> {
    let Some(mdia) = child(trak, b"mdia").map(|b| b.rest()) else { return Ok(None) };
    let is_video = child(mdia, b"hdlr").and_then(|mut b| {
        b.skip(8)?;
        b.take(4)
    }) == Some(b"vide");
    if !is_video {
        return Ok(None);
    }
    let header = || -> Option<(u32, Matrix2)> {
        let mut bytes = child(trak, b"tkhd")?;
        let version = bytes.u32()? >> 24;
        bytes.skip(if version == 1 { 16 } else { 8 })?;
        let id = bytes.u32()?;
        bytes.skip(if version == 1 { 12 } else { 8 })?;
        bytes.skip(16)?;
        Some((id, matrix(&mut bytes)?))
    };
    let (id, track_matrix) = header().unwrap_or((0, UPRIGHT));
    let timescale = child(mdia, b"mdhd")
        .and_then(|mut b| {
            let version = b.u32()? >> 24;
            b.skip(if version == 1 { 16 } else { 8 })?;
            b.u32()
        })
        .filter(|&t| t > 0);
    let (Some(timescale), Some(stbl)) =
        (timescale, child(mdia, b"minf").and_then(|minf| child(minf.rest(), b"stbl")).map(|b| b.rest()))
    else {
        return Err(Error::input(
            "the index (moov box) is damaged: the video track has no timescale or no sample table",
        ));
    };
    let Some(mut described) = child(stbl, b"stsd").and_then(|b| describe(b.rest())) else {
        return Err(Error::input("the index (moov box) is damaged: the video track is not described"));
    };
    described.orientation = orientation(track_matrix, movie_matrix);

    let (mut samples, reordered) = sample_table(stbl)?;
    let fragmented = fragments.samples(id, moov, &mut samples)?;
    described.times = match (fragmented, reordered) {
        _ if samples.len() > 1 && samples.iter().all(|s| s.time == samples[0].time) => Times::Unknown,
        (true, _) | (_, true) => Times::Presentation,
        _ => Times::Decoding,
    };
    let edits = edit_list(trak, f64::from(movie_timescale), f64::from(timescale));
    Ok(Some(Movie { track: described, timescale, samples, edits }))
}

/// The edit list (14496-12, 8.6.6) as the stretches of the media that are shown.
fn edit_list(trak: &[u8], movie_timescale: f64, timescale: f64) -> Vec<Edit> {
    let mut edits = Vec::new();
    let mut parse = || -> Option<()> {
        let mut bytes = child(child(trak, b"edts")?.rest(), b"elst")?;
        let version = bytes.u32()? >> 24;
        let count = bytes.u32()?;
        let mut now_s = 0.0;
        for _ in 0..count {
            let (duration, media_time) = if version == 1 {
                (bytes.u64()? as f64, bytes.u64()? as i64)
            } else {
                (f64::from(bytes.u32()?), i64::from(bytes.i32()?))
            };
            bytes.u32()?;
            let duration_s = duration / movie_timescale;
            if media_time >= 0 {
                let ticks = (duration_s * timescale).round() as i64;
                // A duration of zero means "to the end", as in files that are written in fragments.
                let media_to = if ticks == 0 { i64::MAX } else { media_time.saturating_add(ticks) };
                edits.push(Edit { starts_at_s: now_s, media_from: media_time, media_to });
            }
            now_s += duration_s;
        }
        Some(())
    };
    // A list that is cut off still says what its first entries say.
    let _ = parse();
    edits
}

/// Offsets, sizes and times of the samples of an unfragmented track; whether frames are reordered.
fn sample_table(stbl: &[u8]) -> Result<(Vec<Sample>, bool)> {
    let mut samples: Vec<Sample> = Vec::new();
    let mut sizes = Vec::new();
    if let Some(mut bytes) = child(stbl, b"stsz") {
        let head = (bytes.u32(), bytes.u32(), bytes.u32());
        if let (Some(_), Some(fixed), Some(count)) = head {
            match fixed {
                0 => sizes.extend((0..count).map_while(|_| bytes.u32())),
                _ if count as usize > MAX_SAMPLES => return Err(too_many()),
                _ => sizes.resize(count as usize, fixed),
            }
        }
    } else if let Some(mut bytes) = child(stbl, b"stz2") {
        if let (Some(_), Some(field), Some(count)) = (bytes.u32(), bytes.u32(), bytes.u32()) {
            match field & 0xff {
                16 => sizes.extend((0..count).map_while(|_| bytes.u16().map(u32::from))),
                8 => sizes.extend((0..count).map_while(|_| bytes.u8().map(u32::from))),
                _ => sizes.extend(bytes.rest().iter().flat_map(|b| [u32::from(b >> 4), u32::from(b & 15)])),
            }
            sizes.truncate(count as usize);
        }
    }
    if sizes.len() > MAX_SAMPLES {
        return Err(too_many());
    }

    let (mut chunks, wide) = match (child(stbl, b"stco"), child(stbl, b"co64")) {
        (Some(bytes), _) => (bytes, false),
        (None, Some(bytes)) => (bytes, true),
        (None, None) => (Bytes::new(&[]), false),
    };
    chunks.skip(8);
    let mut runs = child(stbl, b"stsc").unwrap_or(Bytes::new(&[]));
    runs.skip(8);
    let mut run = || Some((runs.u32()?, runs.u32()?, runs.u32()?));
    let mut now = run();
    let mut following = run();
    let mut chunk = 0u32;
    let mut sizes = sizes.into_iter();
    'chunks: while let Some(mut offset) = if wide { chunks.u64() } else { chunks.u32().map(u64::from) } {
        chunk += 1;
        while following.is_some_and(|(first, ..)| chunk >= first) {
            now = following;
            following = run();
        }
        for _ in 0..now.map_or(0, |(_, per_chunk, _)| per_chunk) {
            let Some(size) = sizes.next() else { break 'chunks };
            samples.push(Sample { offset, size, time: 0 });
            offset = offset.saturating_add(u64::from(size));
        }
    }

    let mut decode_time = 0i64;
    if let Some(mut bytes) = child(stbl, b"stts") {
        bytes.skip(8);
        let mut at = samples.iter_mut();
        let mut delta = 0;
        'runs: while let (Some(count), Some(step)) = (bytes.u32(), bytes.u32()) {
            delta = i64::from(step as i32); // QuickTime writers have put negative steps here
            for _ in 0..count {
                let Some(sample) = at.next() else { break 'runs };
                sample.time = decode_time;
                decode_time = decode_time.saturating_add(delta);
            }
        }
        for sample in at {
            sample.time = decode_time;
            decode_time = decode_time.saturating_add(delta);
        }
    }
    let mut reordered = false;
    if let Some(mut bytes) = child(stbl, b"ctts") {
        bytes.skip(8);
        reordered = true;
        let mut at = samples.iter_mut();
        'offsets: while let (Some(count), Some(offset)) = (bytes.u32(), bytes.i32()) {
            for _ in 0..count {
                let Some(sample) = at.next() else { break 'offsets };
                sample.time = sample.time.saturating_add(i64::from(offset));
            }
        }
    }
    Ok((samples, reordered))
}

fn too_many() -> Error {
    Error::input(format!("the index claims more than {MAX_SAMPLES} frames"))
}

/// The track's codec, size and set-up from its first sample entry.
fn describe(stsd: &[u8]) -> Option<Track> {
    let mut bytes = Bytes::new(stsd);
    bytes.skip(8)?;
    let (kind, entry) = Boxes::new(bytes.rest()).next()?;
    let mut bytes = Bytes::new(entry);
    bytes.skip(24)?;
    let (width, height) = (usize::from(bytes.u16()?), usize::from(bytes.u16()?));
    bytes.skip(50)?;
    let inside = bytes.rest();
    let payload = |kind| child(inside, kind).map(|b| b.rest().to_vec());
    let (codec, configuration) = match &kind {
        b"avc1" | b"avc2" | b"avc3" | b"avc4" | b"dva1" | b"dvav" => (Codec::H264, payload(b"avcC")),
        b"hvc1" | b"hev1" | b"dvh1" | b"dvhe" => (Codec::H265, payload(b"hvcC")),
        b"vp09" => (Codec::Vp9, None),
        b"jpeg" | b"mjpa" | b"mjpg" | b"MJPG" => (Codec::MotionJpeg, None),
        b"mp4v" => match payload(b"esds").as_deref().and_then(object_type) {
            Some(0x6c) => (Codec::MotionJpeg, None),
            Some(0x60..=0x65) => (Codec::Other("MPEG-2 video".into()), None),
            Some(0x6a) => (Codec::Other("MPEG-1 video".into()), None),
            _ => (Codec::Other("MPEG-4 part 2 video".into()), None),
        },
        other => (Codec::Other(name(other)), None),
    };
    Some(Track {
        container: "MP4",
        codec,
        width,
        height,
        configuration: configuration.unwrap_or_default(),
        frame_count: None,
        orientation: Orientation::default(),
        encoding: child(inside, b"colr").and_then(|b| color(b.rest())),
        times: Times::Decoding,
    })
}

/// A codec's name from its four letters.
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

/// The fragments of a file (`moof` boxes), in the order of the file.
#[derive(Debug, Default)]
pub(super) struct Fragments {
    fragments: Vec<(u64, Vec<u8>)>,
    bytes: u64,
}

impl Fragments {
    /// Adds the `moof` box that starts at the given place in the file.
    pub fn add(&mut self, at: u64, payload: &[u8]) -> Result<()> {
        self.bytes += payload.len() as u64;
        if self.bytes > crate::limits::MAX_INDEX_BYTES {
            return Err(too_many());
        }
        self.fragments.push((at, payload.to_vec()));
        Ok(())
    }

    /// Appends the samples of a track; true where there are fragments of it (14496-12, 8.8).
    fn samples(&self, track: u32, moov: &[u8], samples: &mut Vec<Sample>) -> Result<bool> {
        let defaults = child(moov, b"mvex").and_then(|mvex| {
            Boxes::new(mvex.rest()).filter(|(kind, _)| kind == b"trex").find_map(|(_, payload)| {
                let mut bytes = Bytes::new(payload);
                bytes.skip(4)?;
                let id = bytes.u32()?;
                bytes.skip(4)?;
                (id == track).then_some((bytes.u32()?, bytes.u32()?))
            })
        });
        let mut decode_time = 0i64;
        let mut any = false;
        for (at, moof) in &self.fragments {
            let mut end_of_previous = *at;
            for (kind, traf) in Boxes::new(moof) {
                if &kind != b"traf" {
                    continue;
                }
                let Some(head) = FragmentHead::read(traf, *at, end_of_previous, defaults) else { continue };
                if head.track != track {
                    continue;
                }
                any = true;
                if let Some(mut bytes) = child(traf, b"tfdt") {
                    let version = bytes.u32().unwrap_or(0) >> 24;
                    let start = if version == 1 { bytes.u64() } else { bytes.u32().map(u64::from) };
                    decode_time = start.map_or(decode_time, |t| t as i64);
                }
                let mut offset = head.base;
                for (kind, trun) in Boxes::new(traf) {
                    if &kind == b"trun" {
                        head.run(trun, &mut offset, &mut decode_time, samples);
                    }
                    if samples.len() > MAX_SAMPLES {
                        return Err(too_many());
                    }
                }
                end_of_previous = offset;
            }
        }
        Ok(any)
    }
}

/// The `tfhd` box: where a track's data begin and what holds for all of its samples.
struct FragmentHead {
    track: u32,
    base: u64,
    duration: u32,
    size: u32,
}

impl FragmentHead {
    fn read(traf: &[u8], moof_at: u64, end_of_previous: u64, defaults: Option<(u32, u32)>) -> Option<Self> {
        let mut bytes = child(traf, b"tfhd")?;
        let flags = bytes.u32()? & 0xff_ffff;
        let track = bytes.u32()?;
        let base = match flags {
            f if f & 1 != 0 => bytes.u64()?,
            f if f & 0x2_0000 != 0 => moof_at,
            _ => end_of_previous,
        };
        if flags & 2 != 0 {
            bytes.u32()?;
        }
        let (duration, size) = defaults.unwrap_or((0, 0));
        let duration = if flags & 8 != 0 { bytes.u32()? } else { duration };
        let size = if flags & 16 != 0 { bytes.u32()? } else { size };
        Some(Self { track, base, duration, size })
    }

    /// One `trun` box; what it does not say comes from the head.
    fn run(&self, trun: &[u8], offset: &mut u64, decode_time: &mut i64, samples: &mut Vec<Sample>) {
        let mut bytes = Bytes::new(trun);
        let mut parse = || -> Option<()> {
            let flags = bytes.u32()? & 0xff_ffff;
            let count = bytes.u32()?;
            if flags & 1 != 0 {
                *offset = self.base.saturating_add_signed(i64::from(bytes.i32()?));
            }
            if flags & 4 != 0 {
                bytes.u32()?;
            }
            for _ in 0..count {
                let duration = if flags & 0x100 != 0 { bytes.u32()? } else { self.duration };
                let size = if flags & 0x200 != 0 { bytes.u32()? } else { self.size };
                if flags & 0x400 != 0 {
                    bytes.u32()?;
                }
                let shift = if flags & 0x800 != 0 { bytes.i32()? } else { 0 };
                if samples.len() > MAX_SAMPLES || (size == 0 && flags & 0xf00 == 0) {
                    return None;
                }
                let time = decode_time.saturating_add(i64::from(shift));
                samples.push(Sample { offset: *offset, size, time });
                *offset = offset.saturating_add(u64::from(size));
                *decode_time = decode_time.saturating_add(i64::from(duration));
            }
            Some(())
        };
        // A run that is cut off has the samples it has.
        let _ = parse();
    }
}
