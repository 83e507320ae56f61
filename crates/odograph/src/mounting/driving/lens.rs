//! How the lens bends, as a recording of driving tells it.
//!
//! Straight ground that moves through a lens whose bending is not quite known moves a little faster or slower towards the edge of the image. Over a shift by d
//! heights, an error ε of k1 looks like a tilt by 2 ε d towards the shift, with a curvature that no tilt has. Both are there in every pair of views, in
//! the same sense, whatever the mount does; so ε is told from half a metre of driving as well as by a board, even from a camera that shakes and sways.
//! So are the principal point and the decentering, by where the bending is centred, and the ratio of the focal lengths, by turns. The focal length itself is not:
//! over level ground it is the height.

use super::bundle::{self, LENS_START, LensUnknowns, Solved};
use super::{DrivenTilt, TiltMeasurement};
use crate::camera::uncertainty::parameter;
use crate::camera::{Camera, Distortion, Rig};
use crate::error::Result;
use crate::geometry::Pixel;
use crate::numerics::{Combined, combine};
use nalgebra::{DMatrix, DVector};

/// The lens as a recording of driving tells it.
#[derive(Debug, Clone, PartialEq)]
pub struct LensMeasurement {
    /// The camera with that lens; all else is as it was calibrated.
    pub camera: Camera,
    /// The coefficients that were looked for.
    pub coefficients: Vec<LensCoefficient>,
    /// By how much the calibration is off, and one standard deviation of that: at the edge of the image where each is largest, pixels.
    pub off_px: f64,
    /// See [`LensMeasurement::off_px`].
    pub deviation_px: f64,
    /// By how much the lens seems to differ from keyframe to keyframe beyond the noise of the tracks, pixels at the edge: what is no lens does so.
    pub scatter_px: f64,
    /// By how many standard deviations the calibration is off, in all coefficients together.
    pub significance: f64,
}

/// A coefficient of the lens.
#[derive(Debug, Clone, PartialEq)]
pub struct LensCoefficient {
    /// Its name, as `k1`.
    pub name: &'static str,
    /// As it was found.
    pub value: f64,
    /// One standard deviation.
    pub deviation: f64,
}

/// A calibration is off where it is by so many standard deviations, because what the pairs do not model is
/// taken for a lens as well: a lamp on the vehicle, rolling shutters and relief made up to 10 in rendered
/// drives, a lens that is off by a tenth of a pixel and more over 20 …
const MIN_SIGMAS: f64 = 12.0;

/// … and by more than this at the edge of the image, pixels: less than that bends no path.
const MIN_OFF_PX: f64 = 0.03;

/// A lens known worse than this at the edge of the image is not a measurement: that is what a poor calibration has, pixels.
const MAX_SIGMA_PX: f64 = 0.5;

/// What differs from keyframe to keyframe by more than this part of itself is not the lens.
const MAX_SCATTER: f64 = 1.0 / 3.0;

impl LensMeasurement {
    /// Whether the lens surely bends otherwise than it was calibrated to.
    pub fn is_significant(&self) -> bool {
        self.significance >= MIN_SIGMAS
            && self.off_px >= MIN_OFF_PX
            && self.scatter_px < MAX_SCATTER * self.off_px
            && self.deviation_px < MAX_SIGMA_PX.min(MAX_SCATTER * self.off_px)
    }

    /// The same coefficients as another camera has them; zero where it has none.
    pub fn coefficients_of(&self, camera: &Camera) -> Vec<f64> {
        let value = |known: &LensCoefficient| parameter(camera, known.name).unwrap_or(0.0);
        self.coefficients.iter().map(value).collect()
    }

    /// By how much another camera is off, at the edge of its image where that is most, pixels.
    pub fn off_from_px(&self, camera: &Camera) -> f64 {
        let off =
            |pixel: Pixel| Some(self.camera.pixel_from_ray(camera.ray_from_pixel(pixel)?)?.distance(pixel));
        edge(camera).filter_map(off).fold(0.0, f64::max)
    }

    /// The lens whose leading coefficients were changed by `bent`, known as well as `combined` says.
    fn new<const N: usize>(given: &Camera, change: &[f64], combined: &Combined<N>) -> Option<Self> {
        let mut lens = LensUnknowns::new(given, N - LENS_START)?;
        lens.add_change(change)?;
        let covariance =
            combined.covariance.view((LENS_START, LENS_START), (change.len(), change.len())).clone_owned();
        let scatter = DMatrix::from_diagonal(&combined.scatter.rows(LENS_START, change.len()).clone_owned());
        let off = DVector::from_column_slice(change);
        let significance = off.dot(&(covariance.clone().try_inverse()? * &off)).sqrt();
        let mut largest = [0.0f64; 3];
        for pixel in edge(given) {
            // A lens may have no ray for its farthest corner.
            let Some(ray) = given.ray_from_pixel(pixel) else { continue };
            let moved = lens.camera().pixel_from_ray(ray)?;
            let pixel_by_lens = lens.pixel_by_lens(ray)?;
            let pixel_by_lens = DMatrix::from_fn(2, change.len(), |row, k| pixel_by_lens[k][row]);
            let spread = |variance: &DMatrix<f64>| {
                (&pixel_by_lens * variance * pixel_by_lens.transpose()).trace().sqrt()
            };
            let there = [moved.distance(pixel), spread(&covariance), spread(&scatter)];
            largest = std::array::from_fn(|k| largest[k].max(there[k]));
        }
        let deviations = covariance.diagonal().map(f64::sqrt);
        let coefficients = lens.coefficients().zip(&deviations);
        let coefficients = coefficients
            .map(|((name, value), &deviation)| LensCoefficient { name, value, deviation })
            .collect();
        let [off_px, deviation_px, scatter_px] = largest;
        let camera = lens.camera().clone();
        Some(Self { camera, coefficients, off_px, deviation_px, scatter_px, significance })
    }
}

/// The corners of the image and the middles of its sides.
fn edge(camera: &Camera) -> impl Iterator<Item = Pixel> {
    let (right, bottom) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let parts =
        [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.5), (1.0, 0.5), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0)];
    parts.into_iter().map(move |(x, y)| Pixel::new(x * right, y * bottom))
}

/// A calibration of the camera on the ground over which it drives.
#[derive(Debug, Clone, PartialEq)]
pub struct SelfCalibration {
    /// How the camera sits if its lens is as it was calibrated.
    pub tilt: TiltMeasurement,
    /// How the lens bends, and how the camera sits then. `None` where the movement does not tell.
    pub lens: Option<(LensMeasurement, TiltMeasurement)>,
}

impl DrivenTilt {
    /// Tilt and lens together: as [`DrivenTilt::solve`], with parameters of the lens as further unknowns that all pairs have in common. The first radial coefficient
    /// always; the second where it is surely another than it was calibrated to be; with it the principal point, the second focal length and the decentering
    /// where those surely are. At least so many `parameters` as are given, for a lens that was found with so many before.
    ///
    /// Fails where there are too few pairs to solve at all.
    pub fn self_calibration(&self, start: &Rig, parameters: usize) -> Result<SelfCalibration> {
        let groups = self.groups.iter().step_by(self.pairs.div_ceil(MAX_PAIRS).max(1));
        let solved = bundle::solve::<ALL_UNKNOWNS>(&self.camera, groups, start);
        match solved.and_then(|solved| self.select_model(&solved, parameters)) {
            Some(found) => Ok(found),
            None => Ok(SelfCalibration { tilt: self.solve(start, None)?, lens: None }),
        }
    }

    /// What pairs that were solved for everything say about the tilt alone, and about a lens with no more parameters than are surely others, or were taken for that
    /// before.
    fn select_model(&self, solved: &Solved<ALL_UNKNOWNS>, parameters: usize) -> Option<SelfCalibration> {
        // A principal point that is off looks much like decentering: where one is another, so may be the other, if the lens has any.
        let whole = match self.camera.distortion() {
            Distortion::KannalaBrandt { .. } => {
                self.with_parameters(&solved.restricted::<8>(), 5, parameters)
            }
            _ => self.with_parameters(solved, 5, parameters),
        };
        let lens = whole
            .or_else(|| self.with_parameters(&solved.restricted::<5>(), 4, parameters))
            .or_else(|| self.with_lens(&solved.restricted::<4>()));
        Some(SelfCalibration { tilt: self.tilt_only(solved)?, lens })
    }

    /// A lens whose parameters from `first` on are surely others than told, or were taken for that before.
    fn with_parameters<const N: usize>(
        &self,
        solved: &Solved<N>,
        first: usize,
        parameters: usize,
    ) -> Option<(LensMeasurement, TiltMeasurement)> {
        let as_before = parameters > first - LENS_START;
        let found = self.with_lens(solved).filter(|_| as_before || last_are_significant(solved, first))?;
        (as_before || found.0.is_significant()).then_some(found)
    }

    /// The tilt with the lens as it was told.
    fn tilt_only<const N: usize>(&self, solved: &Solved<N>) -> Option<TiltMeasurement> {
        let tilt_only = solved.restricted::<LENS_START>();
        self.tilt(&tilt_only, &combine(&tilt_only.parts)?).ok()
    }

    fn with_lens<const N: usize>(&self, solved: &Solved<N>) -> Option<(LensMeasurement, TiltMeasurement)> {
        let combined = combine(&solved.parts)?;
        let change: Vec<f64> = solved
            .lens_change
            .iter()
            .zip(combined.offset.iter().skip(LENS_START))
            .map(|(a, b)| a + b)
            .collect();
        let lens = LensMeasurement::new(&self.camera, &change, &combined)?;
        Some((lens, self.tilt(solved, &combined).ok()?))
    }
}

/// Further parameters are others where they are by so many standard deviations.
const PARAMETER_SIGMAS: f64 = 5.0;

/// Whether the parameters from `first` on are together surely others than was told.
fn last_are_significant<const N: usize>(solved: &Solved<N>, first: usize) -> bool {
    let Some(combined) = combine(&solved.parts) else { return false };
    let off = DVector::from_fn(N - first, |k, _| {
        solved.lens_change[first + k - LENS_START] + combined.offset[first + k]
    });
    let covariance = combined.covariance.view((first, first), (N - first, N - first)).clone_owned();
    covariance
        .try_inverse()
        .is_some_and(|inverse| off.dot(&(inverse * &off)) > PARAMETER_SIGMAS * PARAMETER_SIGMAS)
}

/// So many pairs of views are enough for the lens; of more, keyframes are left out evenly.
const MAX_PAIRS: usize = 256;

/// Roll, pitch, readout time, two radial coefficients, the principal point, the second focal length and the decentering.
const ALL_UNKNOWNS: usize = LENS_START + 7;
