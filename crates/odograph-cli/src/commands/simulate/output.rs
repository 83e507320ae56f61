//! The folder that a simulation is written to.

use super::{FormatName, SimulateArguments, y4m};
use crate::files::{self, MadeFolders};
use crate::{console, interrupt, numbered_pictures};
use indicatif::ProgressBar;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::image::{GrayImage, RgbImage};
use odograph_video::{AviFormat, AviWriter, jpeg_from_gray, jpeg_from_rgb};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

/// Quality of JPEG pictures; noise and texture survive.
const JPEG_QUALITY: u8 = 93;
/// Videos that some run may write.
const VIDEOS: [&str; 4] = ["sim.y4m", "sim.avi", "board.y4m", "board.avi"];
/// Files that may lie beside the frames.
const TEXTS: [&str; 9] = [
    "truth.tum",
    "camera.yaml",
    "rig.toml",
    "simulation.toml",
    "gyro.csv",
    "heading.csv",
    "wheel.csv",
    "range.csv",
    "markers.csv",
];

/// Every file or folder that some run may write.
fn ours() -> impl Iterator<Item = &'static str> {
    ["frames", "frames.txt"].into_iter().chain(VIDEOS).chain(TEXTS)
}

/// What is rendered.
pub trait Recording: Sync {
    /// Name of a video of it, without the ending.
    fn video_name(&self) -> &'static str;
    /// The true camera.
    fn camera(&self) -> &Camera;
    /// Frames per second.
    fn fps(&self) -> f64;
    /// Whether frames have colour.
    fn colored(&self) -> bool;
    /// Times of all frames, seconds; at least one.
    fn times_s(&self) -> &[f64];
    /// Renders a frame; `None` beyond the last.
    fn frame(&self, number: usize) -> Option<Picture>;
}

/// A frame: its luminance and its colour, if any.
pub struct Picture {
    pub gray: GrayImage,
    pub color: Option<RgbImage>,
}

/// Files that belong to the frames, by their names.
pub type Texts = Vec<(&'static str, String)>;

/// Where to and how.
pub struct SimulationOutput {
    folder: PathBuf,
    format: FormatName,
    threads: usize,
    bar: ProgressBar,
    /// Whether files of an earlier run may be replaced.
    force: bool,
    /// Folders that were made for it; dropped last.
    _made: MadeFolders,
}

impl SimulationOutput {
    /// Creates the folder for a number of frames; fails if an earlier run's files would be lost,
    /// unless that is allowed.
    pub fn prepared(arguments: &SimulateArguments, format: FormatName, frames: usize) -> Result<Self> {
        let folder = arguments.output.clone().unwrap_or_else(|| files::free_beside("simulation", ""));
        files::check_output_names(&folder, &ours().collect::<Vec<_>>(), arguments.force)?;
        let made = MadeFolders::new(&folder)?;
        let threads = arguments
            .threads
            .or_else(|| std::thread::available_parallelism().ok())
            .map_or(1, std::num::NonZeroUsize::get);
        let bar = console::bar("{bar:40} {pos}/{len} frames, {eta} left", arguments.quiet);
        bar.set_length(frames as u64);
        Ok(Self { folder, format, threads, bar, force: arguments.force, _made: made })
    }

    /// Where it is.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Renders and writes everything, or leaves nothing of it; `texts` is asked for at the end.
    pub fn write(&self, recording: &impl Recording, texts: impl FnOnce() -> Result<Texts>) -> Result<()> {
        self.write_all(recording, texts).inspect_err(|_| {
            // Without --force nothing of these names was there.
            if !self.force {
                ours().for_each(|name| files::remove(&self.folder.join(name)));
            }
        })
    }

    fn write_all(&self, recording: &impl Recording, texts: impl FnOnce() -> Result<Texts>) -> Result<()> {
        let written = match self.format {
            FormatName::Png => self.write_pictures(recording),
            FormatName::Y4m => self.write_y4m(recording),
            FormatName::Mjpeg => self.write_avi(recording),
        };
        self.bar.finish_and_clear();
        written?;
        let texts = texts()?;
        for (name, text) in &texts {
            files::write(&self.folder.join(name), text.as_bytes())?;
        }
        // Those of an earlier run do not belong to this one.
        for name in TEXTS.iter().filter(|name| texts.iter().all(|(written, _)| written != *name)) {
            let path = self.folder.join(name);
            if path.exists() {
                fs::remove_file(&path).map_err(|error| {
                    Error::output(format!("{} cannot be removed: {error}", path.display()))
                })?;
            }
        }
        Ok(())
    }

    fn write_pictures(&self, recording: &impl Recording) -> Result<()> {
        let frames = self.folder.join("frames");
        let part = files::beside(&frames);
        let failed = |error| Error::not_written(frames.display(), error);
        numbered_pictures::begin(&part).map_err(failed)?;
        let encode = |frame: &Picture| match &frame.color {
            Some(color) => files::png_from_rgb(color),
            None => files::png_from_gray(&frame.gray),
        };
        let rendered = self.render(recording, encode, |number, bytes| {
            fs::write(part.join(numbered_pictures::name(number as u64)), bytes).map_err(failed)
        });
        let place = || {
            self.remove_old_recordings("frames")?;
            numbered_pictures::place(&part, &frames)
        };
        let placed = rendered.and_then(|()| place().map_err(failed));
        if placed.is_err() {
            let _ = fs::remove_dir_all(&part);
        }
        placed?;
        let mut list = String::from("# time_s name\n");
        for (number, time_s) in recording.times_s().iter().enumerate() {
            let _ = writeln!(list, "{time_s:.9} frames/{}", numbered_pictures::name(number as u64));
        }
        files::write(&self.folder.join("frames.txt"), list.as_bytes())
    }

    fn write_y4m(&self, recording: &impl Recording) -> Result<()> {
        let size = (recording.camera().width(), recording.camera().height());
        self.write_stream(recording, |file, failed| {
            let mut file = BufWriter::new(file);
            let header = y4m::header(size, fraction(recording.fps())?, recording.colored());
            file.write_all(&header).map_err(failed)?;
            let encode = |frame: &Picture| Ok(y4m::frame(&frame.gray, frame.color.as_ref()));
            self.render(recording, encode, |_, bytes| file.write_all(&bytes).map_err(failed))?;
            file.into_inner().map_err(|error| failed(error.into_error()))
        })
    }

    fn write_avi(&self, recording: &impl Recording) -> Result<()> {
        let format = AviFormat {
            size: (recording.camera().width(), recording.camera().height()),
            fps: fraction(recording.fps())?,
            frames: recording.times_s().len(),
            bits: if recording.colored() { 24 } else { 8 },
        };
        self.write_stream(recording, |file, failed| {
            let mut writer = AviWriter::new(BufWriter::new(file), format).map_err(failed)?;
            self.render(recording, jpeg, |_, bytes| {
                if writer.is_full_for(&bytes) {
                    return Err(Error::output(
                        "an AVI file cannot hold so many pictures; record shorter or choose --format png",
                    ));
                }
                writer.add(&bytes).map_err(failed)
            })?;
            let file = writer.finish(format).map_err(failed)?;
            file.into_inner().map_err(|error| failed(error.into_error()))
        })
    }

    /// One file, written beside its place and renamed when it is complete.
    fn write_stream(
        &self,
        recording: &impl Recording,
        write: impl FnOnce(fs::File, &dyn Fn(io::Error) -> Error) -> Result<fs::File>,
    ) -> Result<()> {
        let name = self.format.file_name(recording.video_name());
        let path = self.folder.join(&name);
        let beside = files::beside(&path);
        let failed = |error| Error::not_written(path.display(), error);
        let written = fs::File::create(&beside)
            .map_err(failed)
            .and_then(|file| write(file, &failed))
            .and_then(|file| file.sync_data().map_err(failed))
            .and_then(|()| self.remove_old_recordings(&name).map_err(failed))
            .and_then(|()| fs::rename(&beside, &path).map_err(failed));
        if written.is_err() {
            let _ = fs::remove_file(&beside);
        }
        written
    }

    /// Removes an earlier run's recording in other formats: it would not belong to the new truth.
    fn remove_old_recordings(&self, keep: &str) -> io::Result<()> {
        for name in VIDEOS.into_iter().chain(["frames.txt"]) {
            let path = self.folder.join(name);
            if keep != name && path.exists() {
                fs::remove_file(path)?;
            }
        }
        match keep {
            "frames" => Ok(()),
            _ => numbered_pictures::remove(&self.folder.join("frames")),
        }
    }

    /// Renders and encodes all frames on the threads, and hands them to `sink` in order.
    fn render(
        &self,
        recording: &impl Recording,
        encode: impl Fn(&Picture) -> Result<Vec<u8>> + Sync,
        mut sink: impl FnMut(usize, Vec<u8>) -> Result<()>,
    ) -> Result<()> {
        let frames = recording.times_s().len();
        let threads = self.threads.min(frames);
        let next = AtomicUsize::new(0);
        let (sender, receiver) = mpsc::sync_channel::<(usize, Result<Vec<u8>>)>(2 * threads);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                let (sender, next, encode) = (sender.clone(), &next, &encode);
                scope.spawn(move || {
                    loop {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        let Some(frame) = recording.frame(number) else { return };
                        // The receiver is gone when writing has failed.
                        if sender.send((number, encode(&frame))).is_err() {
                            return;
                        }
                    }
                });
            }
            drop(sender);
            // Dropped with this closure however it ends, which releases threads that wait to send.
            let receiver = receiver;
            let mut waiting = BTreeMap::new();
            for number in 0..frames {
                interrupt::check()?;
                while !waiting.contains_key(&number) {
                    let Ok((ready, bytes)) = receiver.recv() else {
                        return Err(Error::output(format!("frame {number} was not rendered")));
                    };
                    waiting.insert(ready, bytes);
                }
                if let Some(bytes) = waiting.remove(&number) {
                    sink(number, bytes?)?;
                }
                self.bar.inc(1);
            }
            Ok(())
        })
    }
}

fn jpeg(frame: &Picture) -> Result<Vec<u8>> {
    match &frame.color {
        Some(color) => jpeg_from_rgb(color, JPEG_QUALITY),
        None => jpeg_from_gray(&frame.gray, JPEG_QUALITY),
    }
}

/// A frame rate as a fraction: over 1001 for television rates, otherwise in millionths, reduced.
fn fraction(fps: f64) -> Result<(u64, u64)> {
    let television = (fps * 1.001).round();
    if (fps - television / 1.001).abs() < 0.0005 && (fps - fps.round()).abs() > 0.005 {
        return Ok((television as u64 * 1000, 1001));
    }
    let (mut a, mut b) = ((fps * 1e6).round() as u64, 1_000_000);
    if a == 0 || a > u64::from(u32::MAX) {
        return Err(Error::usage(format!(
            "{fps} frames per second do not fit a video file; use --format png"
        )));
    }
    let (numerator, denominator) = (a, b);
    while b != 0 {
        (a, b) = (b, a % b);
    }
    Ok((numerator / a, denominator / a))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_rates_become_the_usual_fractions() {
        assert_eq!(fraction(30.0).unwrap(), (30, 1));
        assert_eq!(fraction(29.97).unwrap(), (30000, 1001));
        assert_eq!(fraction(12.5).unwrap(), (25, 2));
        assert!(fraction(1e-9).is_err());
    }
}
