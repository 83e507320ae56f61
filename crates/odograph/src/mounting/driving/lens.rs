//! Self-calibration of the lens while driving.
//!
//! Flat ground moves slightly faster or slower towards the edge of the image if the distortion is
//! not exactly known. Over a shift by d heights, an error ε of k₁ looks like a tilt of 2 ε d
//! towards the shift, plus a curvature that no tilt has. Both have the same sign in every pair of
//! views, however the mount moves; half a metre of driving therefore determines ε as well as a
//! calibration board does, even for a swaying camera. The centre of the distortion determines the
//! principal point and the decentering; turns determine the ratio of the focal lengths. The focal
//! length itself is not observable: over level ground it is equivalent to the height.

use super::bundle::{self, LENS_START, LensUnknowns, Solved, TILT};
use super::{DrivenTilt, MAX_SIGMA_RATIO, TiltMeasurement};
use crate::camera::uncertainty::parameter;
use crate::camera::{Camera, Distortion, PosedCamera, Rig};
use crate::error::Result;
use crate::geometry::{GroundPose, Pixel};
use crate::numerics::Combined;
use nalgebra::{DMatrix, DVector, Matrix2, Vector2};

/// The lens as estimated while driving.
#[derive(Debug, Clone, PartialEq)]
pub struct LensMeasurement {
    /// The camera with the estimated lens; everything else is as calibrated.
    pub camera: Camera,
    /// The estimated parameters.
    pub coefficients: Vec<LensCoefficient>,
    /// Largest difference from the calibration at the edge of the image, pixels.
    pub off_px: f64,
    /// Standard deviation there of where a ground point is seen with the estimates of lens and
    /// tilt, pixels. What a tilt makes up for does not matter, and a shift of the whole image
    /// hardly does.
    pub deviation_px: f64,
    /// The tilt that moves ground points as far, radians.
    pub deviation_as_tilt_rad: f64,
    /// Standard deviation between keyframes beyond the noise of the tracks, pixels at the edge of
    /// the image. A large one shows that the cause is not the lens.
    pub scatter_px: f64,
    /// Mahalanobis distance from the calibration, over all parameters.
    pub significance: f64,
}

/// A distortion parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct LensCoefficient {
    /// Its name, such as `k1`.
    pub name: &'static str,
    /// Estimate.
    pub value: f64,
    /// One standard deviation.
    pub deviation: f64,
}

/// Standard deviations by which an estimate must differ from the calibration to replace it.
/// Unmodelled effects are absorbed by the lens as well: a lamp on the vehicle, rolling shutters and
/// relief reached 10 in rendered drives, lenses wrong by a tenth of a pixel or more exceed 20 …
const MIN_SIGMAS: f64 = 12.0;

/// … and the least difference at the edge of the image, pixels: less does not bend a path.
const MIN_OFF_PX: f64 = 0.03;

/// Largest standard deviation of a usable estimate at the edge of the image, pixels: the error of a
/// poor calibration.
const MAX_SIGMA_PX: f64 = 0.5;

/// Largest scatter between keyframes, as a fraction of the difference: above it, the cause is not
/// the lens.
const MAX_SCATTER: f64 = 1.0 / 3.0;

impl LensMeasurement {
    /// Whether the lens differs significantly from the calibration.
    pub fn is_significant(&self) -> bool {
        self.significance >= MIN_SIGMAS
            && self.off_px >= MIN_OFF_PX
            && self.scatter_px < MAX_SCATTER * self.off_px
            && self.deviation_px < MAX_SIGMA_PX.min(MAX_SCATTER * self.off_px)
    }

    /// Whether it is clearly more precise than the estimate in use, or far from it, and different.
    pub(super) fn is_better_than(&self, used: &Self) -> bool {
        let off_px = self.off_from_px(&used.camera);
        let is_far = off_px >= MIN_SIGMAS * self.deviation_px;
        off_px >= MIN_OFF_PX && (is_far || self.deviation_px < MAX_SIGMA_RATIO * used.deviation_px)
    }

    /// The estimate less the parameters of a calibration.
    fn change_from(&self, given: &Camera) -> Vec<f64> {
        let given = self.coefficients_of(given);
        self.coefficients.iter().zip(given).map(|(found, given)| found.value - given).collect()
    }

    /// The same parameters of another camera; zero where its model lacks them.
    pub fn coefficients_of(&self, camera: &Camera) -> Vec<f64> {
        let value = |known: &LensCoefficient| parameter(camera, known.name).unwrap_or(0.0);
        self.coefficients.iter().map(value).collect()
    }

    /// Largest difference of another camera at the edge of its image, pixels.
    pub fn off_from_px(&self, camera: &Camera) -> f64 {
        let off =
            |pixel: Pixel| Some(self.camera.pixel_from_ray(camera.ray_from_pixel(pixel)?)?.distance(pixel));
        edge(camera).filter_map(off).fold(0.0, f64::max)
    }

    /// The lens with its leading parameters changed by `change`; `combined` has their covariance
    /// with the tilt, which is that of `mount`.
    fn new<const N: usize>(
        given: &Camera,
        change: &[f64],
        combined: &Combined<N>,
        mount: &GroundPose,
    ) -> Option<Self> {
        let mut lens = LensUnknowns::new(given, N - LENS_START)?;
        lens.add_change(change)?;
        let covariance =
            combined.covariance.view((LENS_START, LENS_START), (change.len(), change.len())).clone_owned();
        let scatter = DMatrix::from_diagonal(&combined.scatter.rows(LENS_START, change.len()).clone_owned());
        let off = DVector::from_column_slice(change);
        let significance = off.dot(&(covariance.clone().try_inverse()? * &off)).sqrt();
        let with_tilt = LENS_START + change.len();
        let together = combined.covariance.view((0, 0), (with_tilt, with_tilt)).clone_owned();
        let posed = PosedCamera::new(lens.camera(), *mount);
        let (mut off_px, mut scatter_px) = (0.0f64, 0.0f64);
        let mut shifts = Vec::new();
        let spread =
            |by: &DMatrix<f64>, variance: &DMatrix<f64>| (by * variance * by.transpose()).trace().sqrt();
        for pixel in edge(given) {
            // A lens model may have no ray for its farthest corner.
            let Some(ray) = given.ray_from_pixel(pixel) else { continue };
            let moved = lens.camera().pixel_from_ray(ray)?;
            let pixel_by_lens = lens.pixel_by_lens(ray)?;
            let pixel_by_lens = DMatrix::from_fn(2, change.len(), |row, k| pixel_by_lens[k][row]);
            off_px = off_px.max(moved.distance(pixel));
            scatter_px = scatter_px.max(spread(&pixel_by_lens, &scatter));
            let Some(seen) = posed.ground(ray).and_then(|met| posed.see(met.point)) else { continue };
            shifts.push(DMatrix::from_fn(2, with_tilt, |row, k| match k.checked_sub(LENS_START) {
                Some(k) => pixel_by_lens[(row, k)],
                None => seen.by_pose[(row, 4 + k)],
            }));
        }
        if shifts.is_empty() {
            return None;
        }
        let mean = shifts.iter().sum::<DMatrix<f64>>() / shifts.len() as f64;
        let most = |variance: &DMatrix<f64>| {
            shifts.iter().map(|by| spread(&(by - &mean), variance)).fold(0.0, f64::max)
        };
        let deviation_px = most(&together);
        let of_tilt = DMatrix::from_fn(with_tilt, with_tilt, |i, k| f64::from(u8::from(i == k && i < TILT)));
        let px_per_rad = most(&of_tilt);
        let deviations = covariance.diagonal().map(f64::sqrt);
        let coefficients = lens.coefficients().zip(&deviations);
        let coefficients = coefficients
            .map(|((name, value), &deviation)| LensCoefficient { name, value, deviation })
            .collect();
        let deviation_as_tilt_rad = if px_per_rad > 0.0 { deviation_px / px_per_rad } else { 0.0 };
        let camera = lens.camera().clone();
        Some(Self {
            camera,
            coefficients,
            off_px,
            deviation_px,
            deviation_as_tilt_rad,
            scatter_px,
            significance,
        })
    }
}

/// The corners of the image and the middles of its sides.
fn edge(camera: &Camera) -> impl Iterator<Item = Pixel> {
    let (right, bottom) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let parts =
        [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.5), (1.0, 0.5), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0)];
    parts.into_iter().map(move |(x, y)| Pixel::new(x * right, y * bottom))
}

/// Tilt and lens estimated while driving.
#[derive(Debug, Clone, PartialEq)]
pub struct SelfCalibration {
    /// The tilt if the lens is as calibrated.
    pub tilt: TiltMeasurement,
    /// The lens and the tilt estimated with it, whose covariance is that given this lens and what
    /// of the lens is not known moves ground points as a tilt would; `None` if the motion does not
    /// determine it.
    pub lens: Option<(LensMeasurement, TiltMeasurement)>,
}

impl DrivenTilt {
    /// Estimates tilt and lens together: as [`DrivenTilt::solve`], with distortion parameters as
    /// further common unknowns. The first radial parameter is always estimated; the second only if
    /// it differs significantly from the calibration; principal point, second focal length and
    /// decentering only if those differ significantly as well. The estimate begins with the lens of
    /// an earlier one, and has at least as many parameters.
    ///
    /// # Errors
    ///
    /// If there are too few pairs to solve at all.
    pub fn self_calibration(&self, start: &Rig, before: Option<&LensMeasurement>) -> Result<SelfCalibration> {
        let parameters = before.map_or(0, |lens| lens.coefficients.len());
        let change: Vec<f64> = before.map_or_else(Vec::new, |lens| lens.change_from(&self.camera));
        let groups = || self.groups.iter().step_by(self.pairs.div_ceil(MAX_PAIRS).max(1));
        let with_lens = bundle::solve::<ALL_UNKNOWNS>((&self.camera, &change), groups(), start)
            .and_then(|solved| self.select_model(&solved, parameters));
        if let Some(found) = with_lens {
            return Ok(found);
        }
        Ok(SelfCalibration { tilt: self.solve(start, None)?, lens: None })
    }

    /// Reduces pairs solved for all unknowns to the tilt alone, and to the lens with as few
    /// parameters as are significant or were used before.
    fn select_model(&self, solved: &Solved<ALL_UNKNOWNS>, parameters: usize) -> Option<SelfCalibration> {
        // An error of the principal point looks much like decentering, so both are freed together
        // if the model has decentering.
        let whole = match self.camera.distortion() {
            Distortion::KannalaBrandt { .. } => {
                let solved = solved.restricted::<WITH_CENTRE>();
                self.with_parameters(&solved, WITH_BOTH_RADIAL, parameters)
            }
            _ => self.with_parameters(solved, WITH_BOTH_RADIAL, parameters),
        };
        let lens = whole
            .or_else(|| {
                let solved = solved.restricted::<WITH_BOTH_RADIAL>();
                self.with_parameters(&solved, WITH_FIRST_RADIAL, parameters)
            })
            .or_else(|| self.with_lens(&solved.restricted::<WITH_FIRST_RADIAL>()));
        Some(SelfCalibration { tilt: self.tilt_only(solved)?, lens })
    }

    /// The lens if its parameters from `first` on are significant or were used before.
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

    /// The tilt with the given lens.
    fn tilt_only<const N: usize>(&self, solved: &Solved<N>) -> Option<TiltMeasurement> {
        let tilt_only = solved.restricted::<LENS_START>();
        self.tilt(&tilt_only, &tilt_only.combined()?).ok()
    }

    fn with_lens<const N: usize>(&self, solved: &Solved<N>) -> Option<(LensMeasurement, TiltMeasurement)> {
        let combined = solved.combined()?;
        let change: Vec<f64> = solved
            .lens_change
            .iter()
            .zip(combined.offset.iter().skip(LENS_START))
            .map(|(a, b)| a + b)
            .collect();
        let mut tilt = self.tilt(solved, &combined.given_the_last::<TILT>()?).ok()?;
        let mount = bundle::first_pose(&Vector2::new(tilt.roll_rad, tilt.pitch_rad));
        let lens = LensMeasurement::new(&self.camera, &change, &combined, &mount)?;
        tilt.covariance += Matrix2::from_diagonal_element(lens.deviation_as_tilt_rad.powi(2));
        Some((lens, tilt))
    }
}

/// Standard deviations by which further parameters must differ to be significant.
const PARAMETER_SIGMAS: f64 = 5.0;

/// Whether the parameters from `first` on differ significantly, taken together.
fn last_are_significant<const N: usize>(solved: &Solved<N>, first: usize) -> bool {
    let Some(combined) = solved.combined() else { return false };
    let off = DVector::from_fn(N - first, |k, _| {
        solved.lens_change[first + k - LENS_START] + combined.offset[first + k]
    });
    let covariance = combined.covariance.view((first, first), (N - first, N - first)).clone_owned();
    covariance
        .try_inverse()
        .is_some_and(|inverse| off.dot(&(inverse * &off)) > PARAMETER_SIGMAS * PARAMETER_SIGMAS)
}

/// Largest number of pairs for the lens; of more, keyframes are left out evenly.
const MAX_PAIRS: usize = 256;

/// Number of common unknowns with the first radial parameter of the lens, after roll and pitch.
/// The counts follow from the order of the parameters in [`LensUnknowns`]; whether a
/// further group is freed is decided by its significance, [`PARAMETER_SIGMAS`].
const WITH_FIRST_RADIAL: usize = LENS_START + 1;

/// The same with the second radial parameter.
const WITH_BOTH_RADIAL: usize = WITH_FIRST_RADIAL + 1;

/// The same with the two coordinates of the principal point and the second focal length: all that
/// the Kannala–Brandt model has here.
const WITH_CENTRE: usize = WITH_BOTH_RADIAL + 3;

/// The same with the two parameters of decentering.
const ALL_UNKNOWNS: usize = WITH_CENTRE + 2;
