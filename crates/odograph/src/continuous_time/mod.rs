//! Continuous-time estimation of the motion within rolling-shutter images: the tracks of some
//! dozens of frames at once determine a spline of poses. Derivation:
//! `docs/math/rolling-shutter.md`.
//!
//! While a camera is shaken, its rates in an image follow neither from the poses before it nor from
//! its own rows: height rate and pitch, pitch rate and speed move the rows alike. The poses *after*
//! the image tell them apart (P. Furgale, T. Barfoot and G. Sibley, *Continuous-time batch
//! estimation using temporal basis functions*, 2012).

mod spline;
mod window;

use crate::camera::Camera;
use crate::geometry::GroundPose;
use crate::keyframe::KeyframeId;
use crate::motion::{MeasuredMotion, PoseRates, Readout};
use crate::odometry::{FrameReference, Odometry, TrackView};
use crate::trajectory::FrameEstimate;
use std::collections::HashMap;
use window::{Window, WindowFrame};

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

/// Standard deviation of a readout time that was found on the way, seconds: whatever was found, the
/// tracks decide.
pub const UNKNOWN_READOUT_S: f64 = 5e-3;

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
    /// Time and pose of every keyframe.
    keyframes: HashMap<KeyframeId, (f64, PoseRates)>,
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
            keyframes: HashMap::new(),
            measured: MeasuredMotion::default(),
        })
    }

    /// Takes the next frame, the result of [`Odometry::process`], and its tracks.
    pub fn watch(&mut self, frame: &FrameEstimate, odometry: &Odometry) {
        let (Some(estimate), Some(reference)) = (&frame.estimate, odometry.reference()) else {
            return self.end_window();
        };
        // An image that repeats the one before it has no tracks of its own.
        if !odometry.tracks().is_empty() {
            let GroundPose { height_m, roll_rad, pitch_rad, .. } = estimate.pose;
            let plane = &estimate.measured;
            let pose = PoseRates::new(plane.x_m, plane.y_m, plane.heading_rad, height_m, roll_rad, pitch_rad);
            self.add_frame((frame.time_s, pose), reference, odometry.tracks());
        }
    }

    /// Adds a frame: its time and its pose, what it was measured against, and its tracks.
    fn add_frame(&mut self, now: (f64, PoseRates), reference: FrameReference, tracks: &[TrackView]) {
        if self.frames.last().is_some_and(|last| now.0 <= last.time_s) {
            self.end_window();
        }
        let is_first = self.keyframes.is_empty();
        if is_first {
            self.keyframes.insert(reference.keyframe, now);
        }
        let keyframe = self.keyframes.get(&reference.keyframe).filter(|_| !is_first).copied();
        if let Some((next, _)) = reference.next {
            self.keyframes.entry(next).or_insert(now);
        }
        self.frames.push(WindowFrame::new(now, keyframe, tracks, TRACKS));
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
        let information = |variance_s2: f64| 1.0 / variance_s2 - 1.0 / self.readout.variance_s2;
        let all =
            || self.readouts.iter().map(|&(readout_s, variance_s2)| (readout_s, information(variance_s2)));
        let total: f64 = all().map(|(_, weight)| weight).sum();
        let mean_s = all().map(|(readout_s, weight)| weight * readout_s).sum::<f64>() / total;
        let squares: f64 = all().map(|(readout_s, weight)| weight * (readout_s - mean_s).powi(2)).sum();
        // Where windows differ by more than they state, so does their mean.
        let scatter = (squares / self.readouts.len().saturating_sub(1).max(1) as f64).max(1.0);
        let variance_s2 = (scatter / total).max(LEAST_READOUT_S * LEAST_READOUT_S);
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
        if self.done < end
            && let Some(window) = Window::adjusted(&self.camera, self.readout, &self.frames, &self.measured)
        {
            if self.readout.variance_s2 > 0.0 {
                self.readouts.push((window.readout_s, window.readout_variance_s2()));
            }
            (self.done..end)
                .filter_map(|index| window.motion(index))
                .for_each(|image| self.measured.push(image));
        }
    }
}

#[cfg(test)]
mod tests;
