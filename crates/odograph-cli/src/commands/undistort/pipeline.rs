//! Decode | correct and encode | write, side by side. The order of frames is kept, so any number of
//! threads gives the same bytes.

use super::output::{Encoded, UndistortedOutput};
use super::{OutputFormat, UndistortArguments};
use crate::commands::simulate::y4m;
use crate::{console, files, interrupt};
use odograph::correction::ImageCorrection;
use odograph::error::{Error, Result};
use odograph::image::{GrayImage, RgbImage};
use odograph_video::{Frame, Source};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, mpsc};
use std::thread;

/// The result for a recording.
pub struct CorrectionSummary {
    pub frames: u64,
    /// The first frame, original and corrected, side by side.
    pub before_after: Option<RgbImage>,
    pub warnings: Vec<String>,
    /// The error that ended the recording early, if any.
    pub failure: Option<Error>,
}

/// Corrects every frame of the source and hands it to the output. Fails if a frame cannot be
/// corrected or written; a source that ends early is reported in the result.
pub fn correct(
    mut source: Source,
    correction: &ImageCorrection,
    arguments: &UndistortArguments,
    output: &mut UndistortedOutput,
) -> Result<CorrectionSummary> {
    let available = || thread::available_parallelism().map_or(1, usize::from);
    let threads = arguments.threads.map_or_else(available, usize::from);
    let templates = ["{bar:40} {pos}/{len} frames, {eta} left", "{pos} frames"];
    let bar = console::progress_as(templates, source.info().frame_count, arguments.quiet);
    let (format, mut frames, mut before_after) = (arguments.format, 0, None);
    let failure = thread::scope(|scope| -> Result<Option<Error>> {
        let (decoded_in, decoded_out) = mpsc::sync_channel::<(u64, Frame)>(threads);
        let (encoded_in, encoded_out) = mpsc::sync_channel::<(u64, Result<FinishedFrame>)>(threads);
        let source = &mut source;
        let decoder = scope.spawn(move || -> Result<()> {
            for place in 0.. {
                let frame = if interrupt::asked() { None } else { source.next_frame()? };
                let Some(frame) = frame else { break };
                if decoded_in.send((place, frame)).is_err() {
                    break; // writing has failed, and says why itself
                }
            }
            Ok(())
        });
        let decoded_out = Arc::new(Mutex::new(decoded_out));
        for _ in 0..threads {
            let (decoded_out, encoded_in) = (Arc::clone(&decoded_out), encoded_in.clone());
            scope.spawn(move || {
                loop {
                    let next = decoded_out.lock().ok().and_then(|queue| queue.recv().ok());
                    let Some((place, frame)) = next else { return };
                    if encoded_in.send((place, corrected(&frame, place == 0, correction, format))).is_err() {
                        return;
                    }
                }
            });
        }
        // Only the threads hold the queues now: they go when the threads do.
        drop((decoded_out, encoded_in));
        let mut waiting = BTreeMap::new();
        for (place, work) in encoded_out {
            waiting.insert(place, work);
            while let Some(work) = waiting.remove(&frames) {
                let work = work?;
                output.add(&work.encoded)?;
                if work.before_after.is_some() {
                    before_after = work.before_after;
                }
                frames += 1;
                bar.inc(1);
            }
        }
        let died = |_| Error::input("the decoder ended unexpectedly; please report this recording");
        Ok(decoder.join().map_err(died)?.err())
    });
    bar.finish_and_clear();
    let mut warnings = source.take_warnings();
    if interrupt::asked() {
        warnings.push(format!("interrupted: the first {frames} frames have been written"));
    }
    Ok(CorrectionSummary { frames, before_after, warnings, failure: failure? })
}

/// A frame when all work on it is done.
struct FinishedFrame {
    encoded: Encoded,
    before_after: Option<RgbImage>,
}

fn corrected(
    frame: &Frame,
    compare: bool,
    correction: &ImageCorrection,
    format: OutputFormat,
) -> Result<FinishedFrame> {
    let (bytes, before_after);
    if frame.has_color() {
        let before = frame.rgb();
        let after = correction.apply_rgb(&before)?;
        bytes = match format {
            OutputFormat::Png => files::png_from_rgb(&after)?,
            // Not the decoded luminance, whose range the stream decides.
            OutputFormat::Y4m => y4m::frame(&luminance(&after), Some(&after)),
        };
        before_after = compare.then(|| side_by_side(&before, &after));
    } else {
        let after = correction.apply(&frame.gray)?;
        bytes = match format {
            OutputFormat::Png => files::png_from_gray(&after)?,
            OutputFormat::Y4m => y4m::frame(&after, None),
        };
        before_after = compare.then(|| side_by_side(&RgbImage::from(&frame.gray), &RgbImage::from(&after)));
    }
    let camera = correction.camera();
    let encoded = Encoded {
        number: frame.number,
        time_s: frame.time_s,
        size: (camera.width(), camera.height()),
        colored: frame.has_color(),
        bytes,
    };
    Ok(FinishedFrame { encoded, before_after })
}

/// Luminance of BT.601 in full range.
fn luminance(color: &RgbImage) -> GrayImage {
    let mut gray = GrayImage::new(color.width(), color.height());
    for (luma, rgb) in gray.samples_mut().iter_mut().zip(color.samples().chunks_exact(3)) {
        let [red, green, blue] = [rgb[0], rgb[1], rgb[2]].map(f32::from);
        *luma = (0.299 * red + 0.587 * green + 0.114 * blue).round() as u8;
    }
    gray
}

/// Two images of one height, left and right.
fn side_by_side(left: &RgbImage, right: &RgbImage) -> RgbImage {
    let mut both = RgbImage::new(left.width() + right.width(), left.height());
    let row = 3 * both.width();
    let halves = left.samples().chunks_exact(3 * left.width());
    let halves = halves.zip(right.samples().chunks_exact(3 * right.width()));
    for (both, (left, right)) in both.samples_mut().chunks_exact_mut(row).zip(halves) {
        both[..left.len()].copy_from_slice(left);
        both[left.len()..].copy_from_slice(right);
    }
    both
}
