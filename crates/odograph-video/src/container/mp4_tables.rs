//! Index of an MP4 file: sample tables, edit lists.

use super::bytes::Bytes;
use super::mp4_boxes::{Boxes, Sample, child, too_many};
use super::mp4_description::describe;
use super::mp4_fragments::Fragments;
use super::{Times, VideoTrack};
use crate::limits::MAX_SAMPLES;
use crate::rotation::Orientation;
use odograph::error::{Error, Result};

/// One entry of an edit list, with presentation times in seconds and media times in ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Edit {
    pub starts_at_s: f64,
    pub media_from: i64,
    /// Exclusive.
    pub media_to: i64,
}

pub(super) struct Movie {
    pub track: VideoTrack,
    pub timescale: u32,
    pub samples: Vec<Sample>,
    pub edits: Vec<Edit>,
}

/// The first video track that has samples, otherwise the first video track.
pub(super) fn movie(moov: &[u8], fragments: &Fragments) -> Result<Movie> {
    let (movie_timescale, movie_matrix) = movie_header(moov).unwrap_or((1000, UPRIGHT));
    let mut seen = None;
    for (kind, trak) in Boxes(moov) {
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

/// Timescale of the movie and the 2 × 2 part of its matrix.
fn movie_header(moov: &[u8]) -> Option<(u32, Matrix2)> {
    let mut bytes = child(moov, b"mvhd")?;
    let (timescale, wide) = after_dates(&mut bytes)?;
    bytes.skip(if wide { 24 } else { 20 })?;
    Some((timescale.max(1), matrix(&mut bytes).unwrap_or(UPRIGHT)))
}

/// The field after the two dates of a header, and whether its times are of 64 bits.
fn after_dates(bytes: &mut Bytes<'_>) -> Option<(u32, bool)> {
    let wide = bytes.u32()? >> 24 == 1;
    bytes.skip(if wide { 16 } else { 8 })?;
    Some((bytes.u32()?, wide))
}

/// Signs of the 2 × 2 part of a transformation matrix `{a b u; c d v; x y w}` (14496-12, 8.3.2).
fn matrix(bytes: &mut Bytes<'_>) -> Option<Matrix2> {
    let a = i64::from(bytes.i32()?.signum());
    let b = i64::from(bytes.i32()?.signum());
    bytes.i32()?;
    let c = i64::from(bytes.i32()?.signum());
    let d = i64::from(bytes.i32()?.signum());
    Some([[a, b], [c, d]])
}

/// The orientation for a matrix of quarter turns and reflections; upright for any other matrix.
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
        let (id, wide) = after_dates(&mut bytes)?;
        bytes.skip(if wide { 28 } else { 24 })?;
        Some((id, matrix(&mut bytes)?))
    };
    let (id, track_matrix) = header().unwrap_or((0, UPRIGHT));
    let timescale = child(mdia, b"mdhd").and_then(|mut b| Some(after_dates(&mut b)?.0)).filter(|&t| t > 0);
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

/// Parses the edit list (14496-12, 8.6.6): the media intervals that are presented.
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
                // A duration of 0 means up to the end, as in fragmented files.
                let media_to = if ticks == 0 { i64::MAX } else { media_time.saturating_add(ticks) };
                edits.push(Edit { starts_at_s: now_s, media_from: media_time, media_to });
            }
            now_s += duration_s;
        }
        Some(())
    };
    // A truncated list is used as far as it can be read.
    let _ = parse();
    edits
}

/// Offsets, sizes and timestamps of the samples of an unfragmented track, and whether frames are
/// reordered.
fn sample_table(stbl: &[u8]) -> Result<(Vec<Sample>, bool)> {
    let mut samples = placed_samples(stbl, sample_sizes(stbl)?);
    set_decoding_times(stbl, &mut samples);
    let reordered = add_composition_offsets(stbl, &mut samples);
    Ok((samples, reordered))
}

/// Sizes of the samples in bytes (14496-12, 8.7.3).
fn sample_sizes(stbl: &[u8]) -> Result<Vec<u32>> {
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
    } else if let Some(mut bytes) = child(stbl, b"stz2")
        && let (Some(_), Some(field), Some(count)) = (bytes.u32(), bytes.u32(), bytes.u32())
    {
        match field & 0xff {
            16 => sizes.extend((0..count).map_while(|_| bytes.u16().map(u32::from))),
            8 => sizes.extend((0..count).map_while(|_| bytes.u8().map(u32::from))),
            _ => sizes.extend(bytes.rest().iter().flat_map(|b| [u32::from(b >> 4), u32::from(b & 15)])),
        }
        sizes.truncate(count as usize);
    }
    if sizes.len() > MAX_SAMPLES { Err(too_many()) } else { Ok(sizes) }
}

/// Samples of these sizes at their offsets: chunks (14496-12, 8.7.4 and 8.7.5) hold them one after
/// another.
fn placed_samples(stbl: &[u8], sizes: Vec<u32>) -> Vec<Sample> {
    let mut samples = Vec::new();
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
    while let Some(mut offset) = if wide { chunks.u64() } else { chunks.u32().map(u64::from) } {
        chunk += 1;
        while following.is_some_and(|(first, ..)| chunk >= first) {
            now = following;
            following = run();
        }
        for _ in 0..now.map_or(0, |(_, per_chunk, _)| per_chunk) {
            let Some(size) = sizes.next() else { return samples };
            samples.push(Sample { offset, size, time: 0 });
            offset = offset.saturating_add(u64::from(size));
        }
    }
    samples
}

/// Decoding times (14496-12, 8.6.1.2); the last interval holds for samples beyond the table.
fn set_decoding_times(stbl: &[u8], samples: &mut [Sample]) {
    let (mut time, mut delta) = (0i64, 0);
    let mut steps = run_values(stbl, b"stts");
    for sample in samples {
        // Some QuickTime writers write negative intervals.
        delta = steps.next().unwrap_or(delta);
        sample.time = time;
        time = time.saturating_add(delta);
    }
}

/// Moves decoding times to presentation times (14496-12, 8.6.1.3); whether frames are reordered.
fn add_composition_offsets(stbl: &[u8], samples: &mut [Sample]) -> bool {
    for (sample, offset) in samples.iter_mut().zip(run_values(stbl, b"ctts")) {
        sample.time = sample.time.saturating_add(offset);
    }
    child(stbl, b"ctts").is_some()
}

/// The signed values of a run-length coded table, one for each sample.
fn run_values(stbl: &[u8], table: &[u8; 4]) -> impl Iterator<Item = i64> {
    let mut bytes = child(stbl, table).unwrap_or(Bytes::new(&[]));
    bytes.skip(8);
    let runs = std::iter::from_fn(move || Some((bytes.u32()?, bytes.i32()?)));
    runs.flat_map(|(count, value)| std::iter::repeat_n(i64::from(value), count as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn full_box(kind: &[u8; 4], words: &[u32]) -> Vec<u8> {
        let mut bytes = (12 + 4 * words.len() as u32).to_be_bytes().to_vec();
        bytes.extend(kind);
        bytes.extend([0; 4]);
        bytes.extend(words.iter().flat_map(|w| w.to_be_bytes()));
        bytes
    }

    #[test]
    fn chunks_sizes_and_times_of_samples() {
        let table = [
            full_box(b"stsz", &[0, 5, 10, 20, 30, 40, 50]),
            full_box(b"stco", &[3, 1000, 2000, 3000]),
            // Two samples in the first chunk, one in each further chunk.
            full_box(b"stsc", &[2, 1, 2, 1, 2, 1, 1]),
            full_box(b"stts", &[2, 2, 100, 9, 50]),
            full_box(b"ctts", &[2, 1, 7, 1, (-7i32) as u32]),
        ]
        .concat();
        let (samples, reordered) = sample_table(&table).unwrap();
        assert!(reordered);
        let expected = [(1000, 10, 7), (1010, 20, 93), (2000, 30, 200), (3000, 40, 250)];
        let read: Vec<_> = samples.iter().map(|s| (s.offset, s.size, s.time)).collect();
        assert_eq!(read, expected);
    }

    #[test]
    fn excessive_sample_counts_are_rejected() {
        assert!(sample_table(&full_box(b"stsz", &[1, u32::MAX])).is_err());
        let cut = full_box(b"stsz", &[0, u32::MAX, 5]);
        assert!(sample_table(&cut).unwrap().0.is_empty());
    }

    #[test]
    fn empty_edits_delay_and_other_edits_select() {
        let list = full_box(b"elst", &[2, 500, u32::MAX, 0x10000, 1000, 64, 0x10000]);
        let mut edts = (8 + list.len() as u32).to_be_bytes().to_vec();
        edts.extend(b"edts");
        edts.extend(&list);
        let edits = edit_list(&edts, 1000.0, 90.0);
        assert_eq!(edits, [Edit { starts_at_s: 0.5, media_from: 64, media_to: 154 }]);
    }

    #[test]
    fn turned_and_mirrored_matrices() {
        assert_eq!(orientation(UPRIGHT, UPRIGHT), Orientation::default());
        assert_eq!(orientation([[0, 1], [-1, 0]], UPRIGHT), Orientation::turned(1));
        // A quarter turn of the track and one of the movie make a half turn.
        assert_eq!(orientation([[0, 1], [-1, 0]], [[0, 1], [-1, 0]]), Orientation::turned(2));
        let mirrored = Orientation { mirrored: true, quarter_turns: 0 };
        assert_eq!(orientation([[-1, 0], [0, 1]], UPRIGHT), mirrored);
    }
}
