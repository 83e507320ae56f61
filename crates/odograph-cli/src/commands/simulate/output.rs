//! The folder that a simulation is written to.

use super::scene::Parameters;
use super::{FormatName, SimulateArguments, avi, y4m};
use crate::files::{self, MadeFolders};
use crate::interrupt;
use indicatif::{ProgressBar, ProgressStyle};
use jpeg_encoder::{ColorType, Encoder};
use odograph::error::{Error, Result};
use odograph::filter::fusion::Sensors;
use odograph::formats::trajectory_file::write_tum;
use odograph::formats::{camera_file, control_file, rig_file, sensor_file};
use odograph::trajectory::{StampedPose, Trajectory};
use odograph_simulation::{RenderedFrame, Simulation};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::io::{BufWriter, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

/// Quality of JPEG pictures; noise and texture survive.
const JPEG_QUALITY: u8 = 93;
/// Every file or folder that some run may write.
const OURS: [&str; 13] = [
    "frames",
    "frames.txt",
    "sim.y4m",
    "sim.avi",
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

/// Where to and how.
pub struct SimulationOutput {
    folder: PathBuf,
    format: FormatName,
    sensors: bool,
    tell_readout: bool,
    threads: usize,
    bar: ProgressBar,
    /// Whether files of an earlier run may be replaced.
    force: bool,
    /// Folders that were made for it; dropped last.
    _made: MadeFolders,
}

impl SimulationOutput {
    /// Creates the folder; fails if an earlier run's files would be lost, unless that is allowed.
    pub fn prepared(arguments: &SimulateArguments, simulation: &Simulation) -> Result<Self> {
        let folder = arguments.output.clone().unwrap_or_else(|| files::free_beside("simulation", ""));
        let timing = simulation.config().effects.timing;
        if arguments.format != FormatName::Png && (timing.dropped > 0.0 || timing.jitter_s > 0.0) {
            return Err(Error::usage(
                "frames that are dropped or late need timestamps, which only --format png keeps (frames.txt)",
            ));
        }
        files::check_output_names(&folder, &OURS, arguments.force)?;
        let made = MadeFolders::new(&folder)?;
        let threads = arguments
            .threads
            .or_else(|| std::thread::available_parallelism().ok())
            .map_or(1, std::num::NonZeroUsize::get);
        let bar = if arguments.quiet || !std::io::stderr().is_terminal() {
            ProgressBar::hidden()
        } else {
            ProgressBar::new(simulation.len() as u64)
        };
        if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {eta} left") {
            bar.set_style(style);
        }
        Ok(Self {
            folder,
            format: arguments.format,
            sensors: arguments.sensors,
            tell_readout: arguments.tell_readout,
            threads,
            bar,
            force: arguments.force,
            _made: made,
        })
    }

    /// Where it is.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Renders and writes everything, or leaves nothing of it.
    pub fn write(&self, simulation: &Simulation, parameters: &Parameters) -> Result<()> {
        self.write_all(simulation, parameters).inspect_err(|_| {
            // Without --force nothing of these names was there.
            if !self.force {
                OURS.iter().for_each(|name| files::remove(&self.folder.join(name)));
            }
        })
    }

    fn write_all(&self, simulation: &Simulation, parameters: &Parameters) -> Result<()> {
        let parameters = toml::to_string(parameters)
            .map_err(|error| Error::output(format!("the parameters cannot be written as TOML: {error}")))?;
        let written = match self.format {
            FormatName::Png => self.write_pictures(simulation),
            FormatName::Y4m => self.write_y4m(simulation),
            FormatName::Mjpeg => self.write_avi(simulation),
        };
        self.bar.finish_and_clear();
        written?;
        let config = simulation.config();
        let poses = simulation.times_s().iter().map(|&time_s| StampedPose {
            time_s,
            world_from_camera: simulation.truth(time_s).world_from_camera(),
        });
        let truth = Trajectory { poses: poses.collect() };
        let mut camera = camera_file::write(&config.camera);
        if self.tell_readout {
            let _ = writeln!(camera, "readout_time_s: {}", config.effects.readout_s);
        }
        for (name, text) in [
            ("truth.tum", write_tum(&truth)),
            ("camera.yaml", camera),
            ("rig.toml", rig_file::write(&config.rig)),
            ("simulation.toml", parameters),
        ] {
            files::write(&self.folder.join(name), text.as_bytes())?;
        }
        self.write_or_remove(
            "markers.csv",
            match simulation.markers() {
                [] => None,
                markers => Some(control_file::write(markers)),
            },
        )?;
        self.write_sensors(simulation)
    }

    /// Writes a file, or removes that of an earlier run.
    fn write_or_remove(&self, name: &str, text: Option<String>) -> Result<()> {
        let path = self.folder.join(name);
        match text {
            Some(text) => files::write(&path, text.as_bytes()),
            None if path.exists() => fs::remove_file(&path)
                .map_err(|error| Error::output(format!("{} cannot be removed: {error}", path.display()))),
            None => Ok(()),
        }
    }

    /// The readings of the other sensors; without sensors, removes those of an earlier run.
    fn write_sensors(&self, simulation: &Simulation) -> Result<()> {
        let records = if self.sensors { simulation.sensors()?.records } else { Sensors::default() };
        for (name, record) in [
            ("gyro.csv", records.gyro),
            ("heading.csv", records.heading),
            ("wheel.csv", records.wheel),
            ("range.csv", records.range),
        ] {
            self.write_or_remove(name, record.as_ref().map(sensor_file::write))?;
        }
        Ok(())
    }

    fn write_pictures(&self, simulation: &Simulation) -> Result<()> {
        let frames = self.folder.join("frames");
        let part = files::beside(&frames);
        let failed = |error| Error::not_written(frames.display(), error);
        // What an interrupted run has left.
        if part.exists() {
            fs::remove_dir_all(&part).map_err(failed)?;
        }
        fs::create_dir(&part).map_err(failed)?;
        let encode = |frame: &RenderedFrame| match &frame.color {
            Some(color) => files::png_from_rgb(color),
            None => files::png_from_gray(&frame.image),
        };
        let rendered = self.render(simulation, encode, |number, bytes| {
            fs::write(part.join(picture_name(number)), bytes).map_err(failed)
        });
        let placed = rendered.and_then(|()| self.place_pictures(&part, &frames).map_err(failed));
        if placed.is_err() {
            let _ = fs::remove_dir_all(&part);
        }
        placed?;
        let mut list = String::from("# time_s name\n");
        for (number, time_s) in simulation.times_s().iter().enumerate() {
            let _ = writeln!(list, "{time_s:.9} frames/{}", picture_name(number));
        }
        files::write(&self.folder.join("frames.txt"), list.as_bytes())
    }

    /// Brings the finished pictures from `part` to `frames`, in place of those of an earlier run.
    fn place_pictures(&self, part: &Path, frames: &Path) -> std::io::Result<()> {
        self.remove_old_recordings(&["frames"])?;
        if !frames.exists() {
            return fs::rename(part, frames);
        }
        // Other files in that folder stay.
        for entry in fs::read_dir(frames)? {
            let entry = entry?;
            if is_picture_name(&entry.file_name().to_string_lossy()) {
                fs::remove_file(entry.path())?;
            }
        }
        for entry in fs::read_dir(part)? {
            let entry = entry?;
            fs::rename(entry.path(), frames.join(entry.file_name()))?;
        }
        fs::remove_dir(part)
    }

    fn write_y4m(&self, simulation: &Simulation) -> Result<()> {
        let config = simulation.config();
        let size = (config.camera.width(), config.camera.height());
        self.write_stream("sim.y4m", |file| {
            let failed = |error| Error::not_written(self.folder.join("sim.y4m").display(), error);
            let mut file = BufWriter::new(file);
            file.write_all(&y4m::header(size, fraction(config.fps)?, config.colored)).map_err(failed)?;
            let encode = |frame: &RenderedFrame| Ok(y4m::frame(&frame.image, frame.color.as_ref()));
            self.render(simulation, encode, |_, bytes| file.write_all(&bytes).map_err(failed))?;
            file.into_inner().map_err(|error| failed(error.into_error()))
        })
    }

    fn write_avi(&self, simulation: &Simulation) -> Result<()> {
        let config = simulation.config();
        let format = avi::StreamFormat {
            size: (config.camera.width(), config.camera.height()),
            fps: fraction(config.fps)?,
            frames: simulation.len(),
            bits: if config.colored { 24 } else { 8 },
        };
        self.write_stream("sim.avi", |file| {
            let failed = |error| Error::not_written(self.folder.join("sim.avi").display(), error);
            let mut writer = avi::Writer::new(BufWriter::new(file), format).map_err(failed)?;
            self.render(simulation, jpeg, |_, bytes| writer.add(&bytes))?;
            let file = writer.finish(format).map_err(failed)?;
            file.into_inner().map_err(|error| failed(error.into_error()))
        })
    }

    /// One file, written beside its place and renamed when it is complete.
    fn write_stream(&self, name: &str, write: impl FnOnce(fs::File) -> Result<fs::File>) -> Result<()> {
        let path = self.folder.join(name);
        let beside = files::beside(&path);
        let failed = |error| Error::not_written(path.display(), error);
        let written = fs::File::create(&beside)
            .map_err(failed)
            .and_then(write)
            .and_then(|file| file.sync_data().map_err(failed))
            .and_then(|()| self.remove_old_recordings(&[name]).map_err(failed))
            .and_then(|()| fs::rename(&beside, &path).map_err(failed));
        if written.is_err() {
            let _ = fs::remove_file(&beside);
        }
        written
    }

    /// Removes an earlier run's recording in other formats: it would not belong to the new truth.
    fn remove_old_recordings(&self, keep: &[&str]) -> std::io::Result<()> {
        for name in ["frames.txt", "sim.y4m", "sim.avi"] {
            let path = self.folder.join(name);
            if !keep.contains(&name) && path.exists() {
                fs::remove_file(path)?;
            }
        }
        let frames = self.folder.join("frames");
        if keep.contains(&"frames") || !frames.is_dir() {
            return Ok(());
        }
        for entry in fs::read_dir(&frames)? {
            let entry = entry?;
            if is_picture_name(&entry.file_name().to_string_lossy()) {
                fs::remove_file(entry.path())?;
            }
        }
        // May fail if other files are in it.
        let _ = fs::remove_dir(&frames);
        Ok(())
    }

    /// Renders and encodes all frames on the threads, and hands them to `sink` in order.
    fn render(
        &self,
        simulation: &Simulation,
        encode: impl Fn(&RenderedFrame) -> Result<Vec<u8>> + Sync,
        mut sink: impl FnMut(usize, Vec<u8>) -> Result<()>,
    ) -> Result<()> {
        let (threads, frames) = (self.threads.min(simulation.len()), simulation.len());
        let next = AtomicUsize::new(0);
        let (sender, receiver) = mpsc::sync_channel::<(usize, Result<Vec<u8>>)>(2 * threads);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                let (sender, next, encode) = (sender.clone(), &next, &encode);
                scope.spawn(move || {
                    loop {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        let Some(frame) = simulation.frame(number) else { return };
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

fn jpeg(frame: &RenderedFrame) -> Result<Vec<u8>> {
    let mut bytes = vec![];
    let encoder = Encoder::new(&mut bytes, JPEG_QUALITY);
    let (width, height) = (frame.image.width() as u16, frame.image.height() as u16);
    let encoded = match &frame.color {
        Some(color) => encoder.encode(color.samples(), width, height, ColorType::Rgb),
        None => encoder.encode(frame.image.samples(), width, height, ColorType::Luma),
    };
    encoded.map_err(|error| Error::output(format!("a {width}x{height} JPEG cannot be encoded: {error}")))?;
    Ok(bytes)
}

fn picture_name(number: usize) -> String {
    format!("{number:06}.png")
}

fn is_picture_name(name: &str) -> bool {
    name.strip_suffix(".png").is_some_and(|stem| stem.len() >= 6 && stem.bytes().all(|b| b.is_ascii_digit()))
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

    #[test]
    fn only_our_own_pictures_are_ours() {
        assert!(is_picture_name("000012.png") && is_picture_name("1000000.png"));
        assert!(
            !is_picture_name("holiday.png") && !is_picture_name("12.png") && !is_picture_name("000012.jpg")
        );
    }
}
