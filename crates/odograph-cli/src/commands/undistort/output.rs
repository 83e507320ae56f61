//! The folder of corrected frames, which gets its name only when it is complete.

use super::OutputFormat;
use crate::files::{self, MadeFolders};
use crate::numbered_pictures;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::formats::camera_file;
use odograph::image::RgbImage;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};

const PICTURES: &str = "frames";
const STREAM: &str = "undistorted.y4m";
/// Every file or folder that some run may write.
const OURS: [&str; 5] = [PICTURES, STREAM, "frames.txt", "camera.yaml", "before-after.png"];

/// The folder while it is being filled.
pub struct UndistortedOutput {
    folder: PathBuf,
    frames: FrameWriter,
    /// The frames' names and times, for `frames.txt`.
    list: String,
    times_s: Vec<f64>,
    whole: bool,
    /// Whether results of an earlier run may be replaced.
    force: bool,
    /// Folders that were made for it; dropped last.
    _made: MadeFolders,
}

enum FrameWriter {
    Pictures,
    Stream { file: BufWriter<File>, begun: Option<StreamKind> },
}

/// Properties common to all frames of a stream.
#[derive(Debug, Clone, Copy)]
struct StreamKind {
    size: (usize, usize),
    colored: bool,
}

/// Placeholder for the rate at the beginning of a stream.
const UNKNOWN_RATE: f64 = 30.0;

/// A corrected frame, ready to be written.
pub struct Encoded {
    /// The frame's number in the source.
    pub number: u64,
    pub time_s: f64,
    /// Width and height in pixels.
    pub size: (usize, usize),
    pub colored: bool,
    /// A PNG file, or a frame of a Y4M stream.
    pub bytes: Vec<u8>,
}

impl Drop for UndistortedOutput {
    /// Removes incomplete results.
    fn drop(&mut self) {
        if !self.whole {
            files::remove(&self.part());
            // Without --force nothing of these names was there.
            if !self.force {
                OURS.iter().for_each(|name| files::remove(&self.folder.join(name)));
            }
        }
    }
}

impl UndistortedOutput {
    /// Prepares the folder. Fails if results exist and `force` does not allow replacing them, or if
    /// it cannot be written.
    pub fn new(folder: &Path, format: OutputFormat, force: bool) -> Result<Self> {
        files::check_output_names(folder, &OURS, force)?;
        let made = MadeFolders::new(folder)?;
        let begin = || -> io::Result<FrameWriter> {
            Ok(match format {
                OutputFormat::Png => {
                    numbered_pictures::begin(&files::beside(&folder.join(PICTURES)))?;
                    FrameWriter::Pictures
                }
                OutputFormat::Y4m => {
                    let file = File::create(files::beside(&folder.join(STREAM)))?;
                    FrameWriter::Stream { file: BufWriter::new(file), begun: None }
                }
            })
        };
        let frames = begin().map_err(|error| Error::not_written(folder.display(), error))?;
        let list = match format {
            OutputFormat::Png => "# time_s name\n",
            OutputFormat::Y4m => "# time_s\n",
        };
        Ok(Self {
            folder: folder.to_owned(),
            frames,
            list: list.to_owned(),
            times_s: Vec::new(),
            whole: false,
            force,
            _made: made,
        })
    }

    fn place(&self) -> PathBuf {
        self.folder.join(match self.frames {
            FrameWriter::Pictures => PICTURES,
            FrameWriter::Stream { .. } => STREAM,
        })
    }

    fn part(&self) -> PathBuf {
        files::beside(&self.place())
    }

    fn failed(&self) -> impl Fn(io::Error) -> Error + use<> {
        let place = self.place();
        move |error| Error::not_written(place.display(), error)
    }

    /// Writes the next frame.
    pub fn add(&mut self, frame: &Encoded) -> Result<()> {
        let (failed, part) = (self.failed(), self.part());
        let written = match &mut self.frames {
            FrameWriter::Pictures => {
                let name = numbered_pictures::name(frame.number);
                let _ = writeln!(self.list, "{:.9} {PICTURES}/{name}", frame.time_s);
                fs::write(part.join(name), &frame.bytes)
            }
            FrameWriter::Stream { file, begun } => {
                let _ = writeln!(self.list, "{:.9}", frame.time_s);
                let header = match begun {
                    Some(_) => String::new(),
                    None => {
                        let kind = StreamKind { size: frame.size, colored: frame.colored };
                        *begun = Some(kind);
                        stream_header(kind, UNKNOWN_RATE)
                    }
                };
                file.write_all(header.as_bytes()).and_then(|()| file.write_all(&frame.bytes))
            }
        };
        self.times_s.push(frame.time_s);
        written.map_err(failed)
    }

    /// Brings the frames to their place and writes what belongs to them.
    pub fn finish(&mut self, camera: &Camera, before_after: &RgbImage) -> Result<()> {
        let (failed, part, place) = (self.failed(), self.part(), self.place());
        let rate = match self.times_s[..] {
            [first, .., last] => Some((self.times_s.len() as f64 - 1.0) / (last - first)),
            _ => None,
        };
        let placed = match &mut self.frames {
            FrameWriter::Pictures => numbered_pictures::place(&part, &place),
            FrameWriter::Stream { file, begun } => {
                finish_stream(file, *begun, rate).and_then(|()| fs::rename(&part, &place))
            }
        };
        placed.map_err(&failed)?;
        self.remove_other_format().map_err(&failed)?;
        files::write(&self.folder.join("frames.txt"), self.list.as_bytes())?;
        files::write(&self.folder.join("camera.yaml"), camera_file::write(camera).as_bytes())?;
        files::write(&self.folder.join("before-after.png"), &files::png_from_rgb(before_after)?)?;
        self.whole = true;
        Ok(())
    }

    /// Removes an earlier run's frames in the other format: they would not belong to the new times
    /// and camera.
    fn remove_other_format(&self) -> io::Result<()> {
        let (stream, pictures) = (self.folder.join(STREAM), self.folder.join(PICTURES));
        match self.frames {
            FrameWriter::Pictures if stream.is_file() => fs::remove_file(stream),
            FrameWriter::Pictures => Ok(()),
            FrameWriter::Stream { .. } => numbered_pictures::remove(&pictures),
        }
    }
}

/// The line that a stream begins with. Its length does not depend on the frame rate, which is known
/// only at the end.
fn stream_header(kind: StreamKind, frames_per_second: f64) -> String {
    let StreamKind { size: (width, height), colored } = kind;
    let millionths = (frames_per_second * 1e6).round().clamp(1.0, 4e9) as u64;
    let colors = if colored { "C420jpeg" } else { "Cmono" };
    format!("YUV4MPEG2 W{width} H{height} F{millionths:010}:0001000000 Ip A1:1 {colors} XCOLORRANGE=FULL\n")
}

/// Puts the frame rate into the line the stream begins with.
fn finish_stream(file: &mut BufWriter<File>, begun: Option<StreamKind>, rate: Option<f64>) -> io::Result<()> {
    if let (Some(kind), Some(rate)) = (begun, rate.filter(|rate| rate.is_finite())) {
        file.rewind()?;
        file.write_all(stream_header(kind, rate).as_bytes())?;
    }
    file.flush()?;
    file.get_mut().sync_data()
}
