//! Continuous-time estimation of the motion within rolling-shutter images: the tracks of some
//! dozens of frames at once determine a spline of poses. Derivation:
//! `docs/math/rolling-shutter.md`.
//!
//! While a camera is shaken, its rates in an image follow neither from the poses before it nor from
//! its own rows: height rate and pitch, pitch rate and speed move the rows alike. The poses *after*
//! the image tell them apart (P. Furgale, T. Barfoot and G. Sibley, *Continuous-time batch
//! estimation using temporal basis functions*, 2012).

mod adjustment;
mod frames;
mod readout;
mod spline;
mod track;
mod window;

pub use readout::ReadoutEstimation;

use crate::camera::Camera;
use crate::motion::{MeasuredMotion, Readout};
use crate::odometry::Odometry;
use crate::trajectory::FrameEstimate;
use frames::{FrameReader, Read, WindowFrame};
use readout::weighted_mean;
use window::{Ground, Window};

/// Frames that are adjusted together. Two dozens of frames between the overlaps share their cost.
const FRAMES: usize = 40;

/// Frames after an image that determine its motion, and frames before it. Measured on cameras in
/// the hand, with all frames before the image and 0, 2, 5 or 10 after it: rates are within 50, 2, 1
/// and 0.3 mm/s of those by all frames of the drive.
const FRAMES_AFTER: usize = 8;
const FRAMES_BEFORE: usize = 4;

/// Frames before a gap, or the end, whose motion is predicted as in the first pass: what follows
/// them is missing.
const LAST_FRAMES: usize = 2;

/// Tracks of a frame that are used: more determine the motion no better than it needs to be known.
const TRACKS: usize = 80;

/// Iterations of Gauss–Newton. Six change the error of fifteen shaken drives by 4 % at most.
const ITERATIONS: usize = 3;

/// Tracks show a readout time that leave this part of the variance that it had. Not derived;
/// chosen: a fifth of the standard deviation.
const SEEN: f64 = 0.04;

/// A readout time is known no better than this, seconds.
const LEAST_READOUT_S: f64 = 2e-5;

/// What was measured of a recording.
#[derive(Debug)]
pub struct MotionWithinImages {
    /// The motion within its images.
    pub motion: MeasuredMotion,
    /// The readout time; `None` where it is known as well already.
    pub readout: Option<Readout>,
}

/// Measures the motion within the images of a recording while [`Odometry`] tracks it.
#[derive(Debug, Clone)]
pub struct MotionMeasurement {
    camera: Camera,
    /// The readout time as it is expected: without a variance where it is known.
    readout: Readout,
    /// The readout times of the windows, with their variances.
    readouts: Vec<(f64, f64)>,
    frames: Vec<WindowFrame>,
    /// How many of the frames have been measured already.
    done: usize,
    reader: FrameReader,
    measured: MeasuredMotion,
}

impl MotionMeasurement {
    /// Of a camera whose readout time is known, or to this standard deviation, seconds; `None`
    /// where it is not, or where its shutter is global.
    pub fn new(camera: &Camera, deviation_s: f64) -> Option<Self> {
        let mean_s = camera.readout_s().filter(|readout_s| *readout_s != 0.0)?;
        Some(Self {
            camera: camera.clone(),
            readout: Readout { mean_s, variance_s2: deviation_s * deviation_s },
            readouts: Vec::new(),
            frames: Vec::new(),
            done: 0,
            reader: FrameReader::new(TRACKS),
            measured: MeasuredMotion::default(),
        })
    }

    /// Takes the next frame, the result of [`Odometry::process`], and its tracks.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) {
        match self.reader.read(frame, odometry) {
            Read::Frame(frame) => self.add(frame),
            Read::Untracked => {}
            Read::Gap => self.end_window(),
        }
    }

    fn add(&mut self, frame: WindowFrame) {
        if self.frames.last().is_some_and(|last| frame.time_s <= last.time_s) {
            self.end_window();
        }
        self.frames.push(frame);
        if self.frames.len() == FRAMES {
            self.measure(FRAMES - FRAMES_AFTER);
            self.frames.drain(..FRAMES - FRAMES_AFTER - FRAMES_BEFORE);
            self.done = FRAMES_BEFORE;
        }
    }

    /// What was measured, up to the last frame; `None` where that is nothing.
    pub fn finish(mut self) -> Option<MotionWithinImages> {
        self.end_window();
        (!self.measured.is_empty())
            .then(|| MotionWithinImages { readout: self.readout(), motion: self.measured })
    }

    /// The mean of the readout times of the windows; `None` where it is known as well already.
    fn readout(&self) -> Option<Readout> {
        let own = |&(readout_s, variance_s2): &(f64, f64)| {
            (readout_s, 1.0 / (1.0 / variance_s2 - 1.0 / self.readout.variance_s2))
        };
        let readouts: Vec<(f64, f64)> = self.readouts.iter().map(own).collect();
        let Readout { mean_s, variance_s2 } = weighted_mean(&readouts, 1.0)?;
        let variance_s2 = variance_s2.max(LEAST_READOUT_S * LEAST_READOUT_S);
        let is_seen = variance_s2 < SEEN * self.readout.variance_s2;
        (is_seen && mean_s != 0.0).then_some(Readout { mean_s, variance_s2 })
    }

    /// A frame without a pose: what comes is not tied to what was.
    fn end_window(&mut self) {
        self.measure(self.frames.len().saturating_sub(LAST_FRAMES));
        self.frames.clear();
        self.done = 0;
    }

    /// Measures the frames up to `end`.
    fn measure(&mut self, end: usize) {
        let Self { camera, readout, readouts, frames, done, measured, .. } = self;
        if *done < end
            && let Some(window) =
                Window::adjusted(camera, *readout, frames, measured, Ground::AsTracked, ITERATIONS)
        {
            if readout.variance_s2 > 0.0 {
                readouts.push((window.readout_s, window.readout_variance_s2()));
            }
            let images = (*done..end).filter_map(|index| window.motion(index));
            images.for_each(|image| measured.push(image));
        }
    }
}

#[cfg(test)]
mod tests;
