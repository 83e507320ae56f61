//! Lists what a recording holds.

use crate::bag;
use crate::contents::{Contents, Stream, StreamUse};
use crate::limits;
use crate::opened::Opened;
use crate::pipe;
use crate::source::open_kind;
use crate::source_options::SourceOptions;
use odograph::error::{Error, Result};
use std::path::Path;

/// Lists what is in a recording of any kind, without decoding more than is needed.
///
/// # Errors
/// As [`open`](crate::open); a robot recording without images is not an error.
pub fn inspect(path: impl AsRef<Path>) -> Result<Contents> {
    let path = path.as_ref();
    let at_path = |error: Error| error.at(path.display());
    match bag::open(path).map_err(at_path)? {
        Some(recording) => bag::contents(recording).map_err(at_path),
        None => inspect_frames(path).map_err(at_path),
    }
}

fn inspect_frames(path: &Path) -> Result<Contents> {
    let Opened { mut frames, description, times_known, frames_per_second, .. } =
        open_kind(path, &SourceOptions::default())?;
    let Some(first_s) = frames.advance()? else {
        return Err(pipe::interrupted_or(Error::input("there is no frame in it; record or copy it again")));
    };
    let size = frames.picture()?.map(|picture| (picture.gray.width(), picture.gray.height()));
    let mut times_s = frames.times()?;
    if !path.is_file() {
        pipe::check_waiting()?;
    }
    // What was read without decoding begins at the first frame again.
    if times_s.iter().all(|&time_s| time_s > first_s) {
        times_s.insert(0, first_s);
    }
    let stream = Stream {
        topic: None,
        kind: description.clone(),
        encoding: String::new(),
        size,
        count: times_s.len().min(limits::MAX_SAMPLES) as u64,
        span_s: None,
        rate_hz: frames_per_second,
        gaps: Vec::new(),
        usable_as: StreamUse::Frames(None),
    };
    let streams = vec![if times_known { stream.timed(times_s) } else { stream }];
    Ok(Contents { format: description, streams, warnings: frames.take_warnings() })
}
