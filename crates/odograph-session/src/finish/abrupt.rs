//! Frames that no motion of the camera explains: their deviations are stated larger, and reported.

use crate::kept_frames::KeptFrames;
use odograph::drawing::scale::{duration_text, length_text};
use odograph::error::Result;
use odograph::filter::{AbruptFrame, AbruptMotion};
use std::path::Path;

/// Widens the covariances of frames that deviate from what the motion of their neighbours allows,
/// and returns a warning about them; `None` if there are none. Fails if the frames cannot be read
/// back.
pub fn widen_abrupt(frames: &mut KeptFrames, folder: &Path) -> Result<Option<String>> {
    let mut motion = AbruptMotion::default();
    frames.each(|frame, _| {
        motion.push(frame);
        Ok(())
    })?;
    let found = motion.frames();
    let Some(first) = found.first() else { return Ok(None) };
    let (mut widened, mut first_s) = (KeptFrames::new(folder), 0.0);
    let mut deviating = found.iter().peekable();
    frames.each(|frame, reference| {
        let mut frame = frame.clone();
        if let Some(abrupt) = deviating.next_if(|abrupt| abrupt.index == widened.count()) {
            abrupt.widen(&mut frame);
            if abrupt.index == first.index {
                first_s = frame.time_s - widened.first_time_s().unwrap_or(frame.time_s);
            }
        }
        widened.push(frame, reference.copied());
        Ok(())
    })?;
    *frames = widened;
    Ok(Some(warning(&found, frames.count(), first_s)))
}

fn warning(found: &[AbruptFrame], count: usize, first_s: f64) -> String {
    let largest = |size: fn(&AbruptFrame) -> f64| found.iter().map(size).fold(0.0, f64::max);
    let metres = largest(|abrupt| abrupt.deviation.xy().norm());
    let degrees = largest(|abrupt| abrupt.deviation.z.abs()).to_degrees();
    format!(
        "{} of {count} frames, the first at {}, are up to {} and {degrees:.2}° from where the motion before and after \
         them allows (an acceleration of more than 2 g): images are out of order, frozen or badly timed, or were \
         measured wrongly; their stated deviations include it",
        found.len(),
        duration_text(first_s),
        length_text(metres)
    )
}
