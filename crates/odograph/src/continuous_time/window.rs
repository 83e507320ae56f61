//! The adjustment of a window of frames: a spline of poses by Gauss–Newton on the re-projection
//! errors of all tracks, each seen from the poses of its rows.

use super::adjustment::{Adjusting, Elevations, Reference};
use super::frames::{WindowFrame, WindowTrack, key, unit};
use super::spline::Spline;
use crate::camera::Camera;
use crate::motion::{ImageMotion, MeasuredMotion, PoseRates, Readout};
use crate::numerics::median;
use nalgebra::{Cholesky, DMatrix, Dyn};

/// Intervals of the spline from one frame to the next. One cannot follow a vibration of 8 to 12 Hz
/// at 30 frames a second: all frames of two such drives adjusted together are off by 0.12 and 0.14
/// % of each metre, with 1.5 by 0.017 and 0.018, with 2 by 0.022 and 0.029.
const INTERVALS_PER_FRAME: f64 = 1.5;

/// Standard deviations of the jerk, heights or radians per second³: from a camera that is shaken
/// hard to a cart in a bend. The evidence chooses one of them.
const JERKS: [f64; 4] = [400.0, 80.0, 16.0, 3.2];

/// Rates with a larger standard deviation than this, heights or radians per second, are not used:
/// prediction is as good. Not derived; chosen: it is off by some 0.1 where a camera is shaken.
const MAX_RATE_DEVIATION: f64 = 0.1;

/// Fewer frames, and fewer tracks in all, do not determine a motion.
const LEAST_FRAMES: usize = 4;
const LEAST_TRACKS: usize = 100;

/// Change of all unknowns together, standard deviations, below which an adjustment has converged.
const CONVERGED: f64 = 1.0;

/// The shape of the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ground {
    /// As the odometry takes it.
    AsTracked,
    /// Corners have elevations.
    Uneven,
}

/// An adjusted window.
pub struct Window<'a> {
    frames: &'a [WindowFrame],
    spline: Spline,
    normal: Cholesky<f64, Dyn>,
    height_m: f64,
    /// The readout time, seconds.
    pub readout_s: f64,
    /// Standard deviation of the tracks, pixels.
    pub sigma_px: f64,
}

impl<'a> Window<'a> {
    /// Adjusts the frames in at most this number of iterations, with the readout time as it is
    /// expected. `None` where they determine no motion.
    pub fn adjusted(
        camera: &Camera,
        readout: Readout,
        frames: &'a [WindowFrame],
        measured: &MeasuredMotion,
        ground: Ground,
        iterations: usize,
    ) -> Option<Self> {
        let (first, last) = (frames.first()?, frames.last()?);
        let mut steps: Vec<f64> = frames.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).collect();
        let step_s = median(&mut steps)? / INTERVALS_PER_FRAME;
        if frames.len() < LEAST_FRAMES || last.time_s - first.time_s > 4.0 * step_s * frames.len() as f64 {
            return None;
        }
        let spline = Spline::new(first.time_s, last.time_s, step_s, |time_s| interpolated(frames, time_s));
        let references = references(frames, &spline, measured);
        let tracks: usize = frames
            .iter()
            .zip(&references)
            .filter(|(_, known)| known.is_some())
            .map(|(frame, _)| frame.tracks.len())
            .sum();
        if tracks < LEAST_TRACKS {
            return None;
        }
        let is_uneven = ground == Ground::Uneven || frames.iter().any(|frame| frame.is_uneven);
        let mut adjusting = Adjusting {
            elevations: is_uneven.then(|| elevations(frames, ground)),
            camera,
            readout,
            readout_s: readout.mean_s,
            frames,
            references,
            height_m: first.pose[3],
            spline,
        };
        for _ in 1..iterations {
            if adjusting.step(&JERKS[..1])?.change < CONVERGED {
                break;
            }
        }
        let normal = adjusting.step(&JERKS)?.normal;
        let sigma_px = adjusting.sigma_px();
        let Adjusting { spline, height_m, readout_s, .. } = adjusting;
        Some(Self { frames, spline, normal, height_m, readout_s, sigma_px })
    }

    /// The variance of the readout time, seconds².
    pub fn readout_variance_s2(&self) -> f64 {
        let last = self.normal.l_dirty().nrows() - 1;
        self.normal.l_dirty()[(last, last)].powi(-2)
    }

    /// The motion within a frame; `None` where it is hardly known.
    pub fn motion(&self, index: usize) -> Option<ImageMotion> {
        let frame = &self.frames[index];
        let basis = self.spline.basis(frame.time_s);
        let [_, rates, accelerations] = self.spline.at(&basis);
        let mut selected = DMatrix::zeros(6 * self.spline.control.len() + 1, 6);
        for (k, weight) in basis.weights[1].iter().enumerate() {
            for i in 0..6 {
                selected[(6 * (basis.first + k) + i, i)] = *weight;
            }
        }
        let half = self.normal.l_dirty().solve_lower_triangular(&selected)?;
        let rate_variance =
            PoseRates::from_fn(|i, _| unit(i, self.height_m).powi(2) * half.column(i).norm_squared());
        let is_known = (0..6).all(|i| rate_variance[i].sqrt() < MAX_RATE_DEVIATION * unit(i, self.height_m));
        is_known.then_some(ImageMotion { time_s: frame.time_s, rates, rate_variance, accelerations })
    }
}

/// The pose between two frames, or beyond the first or the last one.
fn interpolated(frames: &[WindowFrame], time_s: f64) -> PoseRates {
    let next = frames.partition_point(|frame| frame.time_s < time_s).clamp(1, frames.len() - 1);
    let (a, b) = (&frames[next - 1], &frames[next]);
    a.pose.lerp(&b.pose, (time_s - a.time_s) / (b.time_s - a.time_s))
}

/// The corners of a window, each with an elevation; as the first frame knows it that sees it.
fn elevations(frames: &[WindowFrame], ground: Ground) -> Elevations {
    let corner = |frame: &WindowFrame, track: &WindowTrack| {
        (frame.keyframe.map_or(0, |(time_s, _)| time_s.to_bits()), key(track.corner))
    };
    let of_frame =
        |frame: &WindowFrame| -> Vec<_> { frame.tracks.iter().map(|track| corner(frame, track)).collect() };
    let of_frames: Vec<Vec<_>> = frames.iter().map(of_frame).collect();
    let mut corners: Vec<_> = of_frames.iter().flatten().copied().collect();
    corners.sort_unstable();
    corners.dedup();
    let number = |corner| corners.binary_search(corner).unwrap_or_default();
    let numbers: Vec<Vec<usize>> = of_frames.iter().map(|frame| frame.iter().map(number).collect()).collect();
    let mut expected = vec![0.0; corners.len()];
    if ground == Ground::AsTracked {
        for (frame, numbers) in frames.iter().zip(&numbers).rev() {
            for (track, &number) in frame.tracks.iter().zip(numbers) {
                expected[number] = track.elevation_m / frame.pose[3];
            }
        }
    }
    Elevations::new(numbers, expected)
}

/// How the keyframe of each frame is known: of those before the window only the first, because the
/// odometry may put two of them at places that do not fit.
fn references(frames: &[WindowFrame], spline: &Spline, measured: &MeasuredMotion) -> Vec<Option<Reference>> {
    let begin_s = frames[0].time_s;
    let before_s = frames
        .iter()
        .filter_map(|frame| frame.keyframe)
        .map(|(time_s, _)| time_s)
        .find(|time_s| *time_s < begin_s);
    let reference = |frame: &WindowFrame| {
        let (time_s, pose) = frame.keyframe?;
        if time_s >= begin_s {
            return Some(Reference::Inside(spline.basis(time_s)));
        }
        let motion = measured.at(time_s).filter(|_| before_s == Some(time_s))?;
        Some(Reference::Before([pose, motion.rates, motion.accelerations]))
    };
    frames.iter().map(reference).collect()
}
