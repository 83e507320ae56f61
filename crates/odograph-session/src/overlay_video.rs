//! The overlay video of a run, written while it is tracked: each frame as a [`FramePainter`] draws
//! it.

use crate::files;
use crate::report::{FramePainter, OverlayFrame};
use odograph::error::{Error, Result};
use odograph_video::{AviFormat, AviWriter, jpeg_from_rgb};
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// JPEG quality (1 to 100): higher keeps more of the texture and shortens what fits into a file.
const QUALITY: u8 = 85;
/// Frames per second where the times of the frames do not give them.
const NOMINAL_FPS: f64 = 30.0;

/// A Motion JPEG video in AVI that is being written under a temporary name. Dropped before
/// [`OverlayVideo::finish`] it leaves no file.
pub struct OverlayVideo {
    path: PathBuf,
    painter: Box<dyn FramePainter>,
    /// `None` once nothing more can be written.
    writer: Option<AviWriter<BufWriter<File>>>,
    failure: Option<Error>,
    /// Number of the first frame that did not fit, and its time, seconds.
    full_at: Option<(u64, f64)>,
    frames: usize,
    /// Times of the first and the last frame, seconds.
    span_s: Option<(f64, f64)>,
}

impl OverlayVideo {
    /// Checks the name of a video, before any work. `results` is the folder of the results.
    pub fn check(path: &Path, results: Option<&Path>, force: bool) -> Result<()> {
        if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("avi")) {
            return Err(Error::usage(format!(
                "{} cannot be the overlay video, which is Motion JPEG in AVI; give it a name that ends with .avi",
                path.display()
            )));
        }
        files::check_output(path, results, force)
    }

    /// Begins the file.
    pub fn new(path: &Path, painter: Box<dyn FramePainter>) -> Result<Self> {
        let format = format(painter.size(), 0, None);
        let writer = File::create(files::beside(path))
            .and_then(|file| AviWriter::new(BufWriter::with_capacity(1 << 20, file), format))
            .map_err(|error| files::cannot_be_written(path, error))?;
        Ok(Self {
            path: path.to_owned(),
            painter,
            writer: Some(writer),
            failure: None,
            full_at: None,
            frames: 0,
            span_s: None,
        })
    }

    /// Adds the next frame. What fails is kept for the end: the path does not depend on the video.
    pub fn add(&mut self, frame: &OverlayFrame<'_>) {
        let Some(writer) = &mut self.writer else { return };
        let (number, time_s) = (frame.camera.frame, frame.camera.time_s);
        let added = jpeg_from_rgb(&self.painter.paint(frame), QUALITY).and_then(|jpeg| {
            if writer.is_full_for(&jpeg) {
                self.full_at = Some((number, time_s));
                return Ok(());
            }
            writer.add(&jpeg).map_err(|error| files::cannot_be_written(&self.path, error))
        });
        match (added, self.full_at) {
            (Err(error), _) => {
                self.failure = Some(error);
                self.writer = None;
            }
            (Ok(()), None) => {
                self.frames += 1;
                let first_s = self.span_s.map_or(time_s, |(first_s, _)| first_s);
                self.span_s = Some((first_s, time_s));
            }
            (Ok(()), Some(_)) => {}
        }
        if self.full_at.is_some() {
            self.end();
        }
    }

    /// Completes the file and gives it its name. Returns a warning where it does not show the whole
    /// run.
    pub fn finish(mut self) -> Result<Option<String>> {
        self.end();
        if let Some(error) = self.failure.take() {
            return Err(error);
        }
        fs::rename(files::beside(&self.path), &self.path)
            .map_err(|error| files::cannot_be_written(&self.path, error))?;
        Ok(self.full_at.map(|(frame, time_s)| {
            format!(
                "{} ends before frame {frame} ({time_s:.1} s), because an AVI file cannot be larger than 2 GB; --start, \
                 --end and --every choose a part of the recording",
                self.path.display()
            )
        }))
    }

    /// Ends writing.
    fn end(&mut self) {
        let Some(writer) = self.writer.take() else { return };
        let format = format(self.painter.size(), self.frames, self.span_s);
        let ended = writer
            .finish(format)
            .and_then(|file| file.into_inner().map_err(|error| error.into_error()))
            .and_then(|file| file.sync_data());
        self.failure = ended.err().map(|error| files::cannot_be_written(&self.path, error));
    }
}

impl Drop for OverlayVideo {
    fn drop(&mut self) {
        let _ = fs::remove_file(files::beside(&self.path));
    }
}

/// The format of a video with this number of frames over a span of time. AVI has one interval for
/// all frames: the mean.
fn format(size: (usize, usize), frames: usize, span_s: Option<(f64, f64)>) -> AviFormat {
    let mean = span_s.map(|(first_s, last_s)| frames.saturating_sub(1) as f64 / (last_s - first_s));
    let fps = mean.filter(|fps| fps.is_finite() && *fps > 0.0).unwrap_or(NOMINAL_FPS);
    AviFormat { size, fps: ((1e3 * fps).round().clamp(1.0, 1e9) as u64, 1000), frames, bits: 24 }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn the_frame_rate_is_the_mean() {
        let fps = |frames, span_s| format((640, 480), frames, span_s).fps;
        assert_eq!(fps(101, Some((5.0, 9.0))), (25_000, 1000));
        assert_eq!(fps(1, Some((5.0, 5.0))), (30_000, 1000));
        assert_eq!(fps(0, None), (30_000, 1000));
    }

    #[test]
    fn another_ending_is_refused() {
        let refused = OverlayVideo::check(Path::new("drive.mp4"), None, false).unwrap_err().to_string();
        assert!(refused.starts_with("drive.mp4 cannot be the overlay video"), "{refused}");
    }
}
