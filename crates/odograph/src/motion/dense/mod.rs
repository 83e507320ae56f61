//! Dense registration: the whole overlap of two images is compared, for ground without corners and
//! for the highest accuracy.
//!
//! A reference image of known pose is cut into tiles of 16×16 samples on several pyramid levels. At
//! a pose each tile estimates its displacement by one step of inverse compositional Lucas–Kanade
//! (S. Baker and I. Matthews, 2004), invariant to gain, offset and gradient of the illumination.
//! The pose is fitted to all displacements, weighted by their information and robustly
//! ([`super::estimate`]'s own fit), and the step is repeated: Gauss–Newton over all pixels, with
//! robust weights per tile. Levels go from coarse to fine as long as finer ones reduce the
//! variance; in noise the finest do not.
//!
//! Noise in the reference inflates the Hessian and the contrast. The noise is estimated from what
//! the two images do not share, and step and weight are corrected for it, so that neither pose nor
//! covariance is biased towards the previous pose. Derivation: `docs/math/interpolation-bias.md`.

mod plane;
mod tile;

pub use plane::DenseImage;

use super::GroundFromRay;
use super::{
    Correspondence, Elevation, MotionConfig, MotionEstimate, Observations, RigPrior, ViewingPose,
    observations, planar_pose,
};
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use nalgebra::{Matrix2, Matrix3, Vector2};
use plane::DensePlane;
use tile::{
    AREA, CONTRAST_NOISE_SAMPLES, GRADIENT_NOISE_SAMPLES, PLANE_NOISE_SAMPLES, SIDE, Tile, TileMatch,
};

/// A reference image as tiles on the ground.
#[derive(Debug, Clone)]
pub struct DenseReference {
    /// Tiles per pyramid level with the number of the level, the finest first.
    levels: Vec<(usize, Vec<Tile>)>,
    /// Pose of its camera.
    pose: GroundPose,
}

/// A pose from dense registration.
#[derive(Debug, Clone)]
pub struct DenseEstimate {
    /// Pose, covariance and inliers, which are tiles.
    pub estimate: MotionEstimate,
    /// The tiles, in step with the inliers.
    pub tracks: Vec<TileTrack>,
    /// Significance of the match, in standard deviations of unrelated images. Below
    /// [`DenseEstimate::LEAST_SCORE`] the images may be unrelated.
    pub score: f64,
    /// Fraction of the reference's tiles that lie in the image.
    pub overlap: f64,
    /// Inlier ratio of the tiles in the image, by information.
    pub agreement: f64,
}

/// A tile found in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TileTrack {
    /// Its centre in the reference image.
    pub reference: Pixel,
    /// Where it was found.
    pub pixel: Pixel,
    /// Covariance of that, pixels².
    pub covariance_px2: Matrix2<f64>,
}

impl DenseEstimate {
    /// Smallest inlier ratio of a match. Not derived; chosen.
    pub const LEAST_AGREEMENT: f64 = 0.35;

    /// Unrelated images do not reach this score, false optima rarely. Not derived; chosen.
    pub const LEAST_SCORE: f64 = 4.0;
}

impl DenseReference {
    /// The tiles of an image taken at `pose`, on the pyramid levels from `finest` on (0: the full
    /// image; a level costs four times the next).
    pub fn new(camera: &Camera, image: &DenseImage, pose: &GroundPose, finest: usize) -> Self {
        let from = GroundFromRay::new(pose);
        let levels = image.planes.iter().enumerate().skip(finest);
        let level = |(number, plane): (usize, &DensePlane)| {
            let step = if number < FIRST_OVERLAPPING_LEVEL { SIDE } else { SIDE / 2 };
            let along = |size: usize| (1..size.saturating_sub(SIDE)).step_by(step);
            let places = along(plane.height).flat_map(|top| along(plane.width).map(move |left| (left, top)));
            let tile = |place| {
                let centre = Tile::centre(plane, place);
                if is_masked(image, centre, plane) { None } else { Tile::new(plane, place, camera, &from) }
            };
            (number, places.filter_map(tile).collect())
        };
        Self { levels: levels.map(level).collect(), pose: *pose }
    }

    /// Fraction of the tiles in the image of a camera at `pose`, 0 to 1.
    pub fn overlap(&self, camera: &Camera, pose: &GroundPose) -> f64 {
        let Some((_, tiles)) = self.levels.first() else { return 0.0 };
        let viewing = ViewingPose::new(*pose);
        let is_in_image = |tile: &&Tile| {
            tile.patch.pixel(camera, &viewing).is_some_and(|pixel| camera.contains(pixel, SIDE as f64))
        };
        tiles.iter().filter(is_in_image).count() as f64 / tiles.len().max(1) as f64
    }
}

/// First pyramid level on which tiles overlap by half, because there are few of them.
const FIRST_OVERLAPPING_LEVEL: usize = 3;

/// Refines the pose of a camera whose image overlaps the reference's from `guess`, with `prior` on
/// height and tilt, and the covariance of those of the reference (metres and radians). `None` where
/// the registration does not converge.
///
/// It converges from an error of the guess of about four pixels on any texture, and of twenty where
/// there is large structure too.
pub fn refine(
    camera: &Camera,
    (reference, keyframe_covariance): (&DenseReference, &Matrix3<f64>),
    image: &DenseImage,
    guess: &GroundPose,
    prior: &RigPrior,
    config: &MotionConfig,
) -> Option<DenseEstimate> {
    let mut pose = *guess;
    let mut best: Option<DenseEstimate> = None;
    for (halvings, tiles) in reference.levels.iter().rev() {
        let Some(plane) = image.planes.get(*halvings) else { continue };
        let keyframe_pose = &reference.pose;
        let level =
            DenseLevel { camera, tiles, keyframe_pose, keyframe_covariance, image, plane, prior, config };
        let Some(found) = level.converge(&pose) else { continue };
        if *halvings >= FIRST_OVERLAPPING_LEVEL {
            // Too few tiles to be accepted; only the start for the next level.
            pose = if found.score > MIN_COARSE_SCORE { found.estimate.pose } else { pose };
            continue;
        }
        let variance_m2 = |found: &DenseEstimate| {
            let covariance = &found.estimate.covariance;
            covariance[(0, 0)] + covariance[(1, 1)]
        };
        let is_worse =
            best.as_ref().is_some_and(|best| variance_m2(&found) > MAX_VARIANCE_RATIO * variance_m2(best));
        if is_worse {
            break;
        }
        pose = found.estimate.pose;
        best = Some(found);
    }
    best
}

/// Largest variance of a finer level over the coarser one's. Below it the finer level has the
/// smaller bias. Not derived; chosen.
const MAX_VARIANCE_RATIO: f64 = 1.5;

/// Least score of a coarse level with overlapping tiles. Not derived; chosen.
const MIN_COARSE_SCORE: f64 = 3.0;

/// Whether much of a tile around a pixel is masked.
fn is_masked(image: &DenseImage, centre: Pixel, plane: &DensePlane) -> bool {
    // Of 5×5 points. The mask is wider than what it covers, so a few do not matter.
    const MAX_MASKED: usize = 2;
    let Some(mask) = &image.mask else { return false };
    let step_px = plane.pixels_per_sample * SIDE as f64 / 5.0;
    let covered = |place: &usize| {
        let (right, down) = ((place % 5) as f64 - 2.0, (place / 5) as f64 - 2.0);
        mask.covers_pixel(Pixel::new(centre.x + right * step_px, centre.y + down * step_px))
    };
    (0..25).filter(covered).count() > MAX_MASKED
}

/// Registration on one pyramid level.
struct DenseLevel<'a> {
    camera: &'a Camera,
    tiles: &'a [Tile],
    keyframe_pose: &'a GroundPose,
    keyframe_covariance: &'a Matrix3<f64>,
    image: &'a DenseImage,
    plane: &'a DensePlane,
    prior: &'a RigPrior,
    config: &'a MotionConfig,
}

/// Most Gauss–Newton steps. Not derived; chosen.
const MAX_STEPS: usize = 15;

/// Convergence: a step below this fraction of a sample, or below this fraction of the pose's
/// standard deviation. Not derived; chosen.
const CONVERGED_SAMPLES: f64 = 0.005;
const CONVERGED_SIGMAS: f64 = 0.03;

impl DenseLevel<'_> {
    /// Iterates to convergence; `None` where it diverges.
    fn converge(&self, guess: &GroundPose) -> Option<DenseEstimate> {
        let mut pose = *guess;
        let sample_m = self.plane.pixels_per_sample * guess.height_m / self.camera.focal_px().0;
        for _ in 0..MAX_STEPS {
            let next = self.step(&pose)?;
            let next_pose = &next.estimate.pose;
            let rotation_m = 0.5 * guess.height_m * (next_pose.heading_rad - pose.heading_rad).abs();
            let moved_m = next_pose.distance_m(&pose) + rotation_m;
            if moved_m > MAX_STEP_SAMPLES * sample_m {
                return None;
            }
            pose = next.estimate.pose;
            // Steps far below the standard deviation are noise.
            let covariance = &next.estimate.covariance;
            let known_m = (covariance[(0, 0)] + covariance[(1, 1)]).sqrt();
            if moved_m < f64::max(CONVERGED_SAMPLES * sample_m, CONVERGED_SIGMAS * known_m) {
                return Some(next);
            }
        }
        None
    }

    /// One Gauss–Newton step from `pose`.
    fn step(&self, pose: &GroundPose) -> Option<DenseEstimate> {
        let viewing = ViewingPose::new(*pose);
        let matches: Vec<(&Tile, TileMatch)> = self
            .tiles
            .iter()
            .filter_map(|tile| tile.compare(self.camera, &viewing, self.plane).map(|found| (tile, found)))
            .filter(|(_, found)| !is_masked(self.image, found.warp.warp.position, self.plane))
            .collect();
        let gain_and_noise = GainAndNoise::between(&matches)?;
        let found = |(tile, found): &(&Tile, TileMatch)| {
            let seen = self.correspondence(tile, found, &gain_and_noise)?;
            let Correspondence { pixel, covariance_px2, .. } = seen;
            Some((seen, TileTrack { reference: tile.centre, pixel, covariance_px2 }))
        };
        let (correspondences, tracks): (Vec<Correspondence>, Vec<TileTrack>) =
            matches.iter().filter_map(found).unzip();
        let informations: Vec<f64> = correspondences.iter().map(information).collect();
        let all_information: f64 = informations.iter().sum();
        // The unit is what a tile shows on average, not the median: most tiles may show nothing.
        let unit_px2 = correspondences.len() as f64 / all_information;
        let observations = observations(&correspondences, SHARED_PX2, unit_px2);
        let cutoff_px = (CUTOFF_SIGMAS * unit_px2.sqrt()).max(self.plane.pixels_per_sample);
        let config = MotionConfig { inlier_px: cutoff_px, ..*self.config };
        let agreeing = vec![true; observations.len()];
        let observations = Observations {
            seen: &observations,
            // The scatter of tiles that cover the whole image is their own.
            noise_px: f64::INFINITY,
            keyframe_pose: self.keyframe_pose,
            keyframe_covariance: self.keyframe_covariance,
            shutter: None,
            shape: None,
        };
        let estimate =
            planar_pose::refine(self.camera, observations, pose, &agreeing, pose, self.prior, &config)?;
        let agreeing = informations.iter().zip(&*estimate.inliers).filter(|(_, agrees)| **agrees);
        let agreement = agreeing.map(|(information, _)| information).sum::<f64>() / all_information;
        let overlap = matches.len() as f64 / self.tiles.len() as f64;
        Some(DenseEstimate { estimate, tracks, score: score(&matches), overlap, agreement })
    }

    /// Measured position of a tile; `None` where its contrast does not match or its Hessian is
    /// singular.
    fn correspondence(
        &self,
        tile: &Tile,
        found: &TileMatch,
        gain_and_noise: &GainAndNoise,
    ) -> Option<Correspondence> {
        let area = AREA as f64;
        // Gain of the tile, with the gain of the whole image as prior.
        let prior_weight = gain_and_noise.noise / GAIN_SPREAD.powi(2);
        let gain = (found.product + gain_and_noise.gain * prior_weight)
            / ((tile.energy - area * gain_and_noise.noise).max(0.0) + prior_weight);
        if gain < MIN_RELATIVE_GAIN * gain_and_noise.gain {
            return None;
        }
        let gradients = tile.hessian.symmetric_eigen();
        if gradients.eigenvalues.min() < MIN_GRADIENTS {
            return None;
        }
        // Inverses of the Hessian of the signal alone, and of that as its noise inflates it.
        let signal = gradients.eigenvalues.map(|squares| gain_and_noise.signal_of(squares));
        let along = |inverses: Vector2<f64>| {
            let axes = &gradients.eigenvectors;
            axes * Matrix2::from_diagonal(&inverses) * axes.transpose()
        };
        let inverse = along(signal.map(f64::recip));
        let spread =
            along(gradients.eigenvalues.zip_map(&signal, |squares, signal| squares / (signal * signal)));
        let unexplained =
            (found.energy - found.product * found.product / tile.energy.max(1e-9)) / (area * gain * gain);
        let noise = unexplained.max(gain_and_noise.noise);
        let linear = found.warp.warp.linear * self.plane.pixels_per_sample;
        let step = linear * inverse * found.slope / gain;
        let position = found.warp.warp.position;
        let curvature_offset = found.warp.curvature_offset;
        let covariance_px2: Matrix2<f64> = linear * spread * linear.transpose() * noise;
        Some(Correspondence {
            ground: tile.patch.ground,
            elevation: Elevation::FLAT,
            pixel: Pixel::new(
                position.x - curvature_offset.x - step.x,
                position.y - curvature_offset.y - step.y,
            ),
            covariance_px2,
            row_fraction: 0.0,
            keyframe_row_fraction: 0.0,
            centre_of_projection: tile.patch.centre_of_projection,
        })
    }
}

/// Information of a tile, per pixel² of one coordinate.
fn information(seen: &Correspondence) -> f64 {
    let covariance = seen.covariance_px2 + SHARED_PX2 * Matrix2::identity();
    0.5 * covariance.try_inverse().map_or(0.0, |information| information.trace())
}

/// Longest step, samples: beyond it the linearisation is invalid. Not derived; chosen.
const MAX_STEP_SAMPLES: f64 = 6.0;

/// Inlier distance in standard deviations of an average tile. Not derived; chosen.
const CUTOFF_SIGMAS: f64 = 6.0;

/// Variance floor of a tile, pixels²: (0.005 px)². See `docs/math/correlated-noise.md`.
const SHARED_PX2: f64 = 2.5e-5;

/// Prior standard deviation of a tile's gain relative to the image's. Not derived; chosen.
const GAIN_SPREAD: f64 = 0.1;

/// Least gain of a tile relative to the image's: below it the tile shows something else. Not
/// derived; chosen.
const MIN_RELATIVE_GAIN: f64 = 0.3;

/// Gain and noise between two images.
struct GainAndNoise {
    /// Contrast of the image over that of the reference.
    gain: f64,
    /// Variance of the noise of a reference sample after smoothing.
    noise: f64,
    /// Squared gradients of the noise in a tile, along one axis, and mean of those of the signal.
    noise_gradients: f64,
    signal_gradients: f64,
    /// How much of a tile's deviation from that mean is signal: 0 on ground whose texture is the
    /// same everywhere, 1 where it is not.
    own_share: f64,
}

impl GainAndNoise {
    /// Total least squares for images of equal noise, of which interpolation leaves less between
    /// samples; the noise is what the images do not share. `None` where they share nothing.
    fn between(matches: &[(&Tile, TileMatch)]) -> Option<Self> {
        let sum = |of: fn(&Tile, &TileMatch) -> f64| {
            matches.iter().map(|(tile, found)| of(tile, found)).sum::<f64>()
        };
        let sum_of = |of: &dyn Fn(&Tile) -> f64| matches.iter().map(|(tile, _)| of(tile)).sum::<f64>();
        let product = sum(|_, found| found.product);
        let energy = sum(|tile, _| tile.energy);
        let image_energy = sum(|_, found| found.energy);
        let squares = sum(|tile, _| tile.hessian.trace());
        if matches.len() < MIN_TILES || product < 1e-3 * (energy * image_energy).sqrt() {
            return None;
        }
        let tiles = matches.len() as f64;
        let noise_ratio = sum(|_, found| AREA as f64 * found.noise - PLANE_NOISE_SAMPLES)
            / (tiles * CONTRAST_NOISE_SAMPLES);
        let ratio = (image_energy - noise_ratio * energy) / product;
        let gain = 0.5 * (ratio + (ratio * ratio + 4.0 * noise_ratio).sqrt());
        let noise = ((energy - product / gain) / (tiles * CONTRAST_NOISE_SAMPLES)).max(MIN_NOISE);
        // Smoothed samples and gradients have the same noise.
        let noise_gradients = GRADIENT_NOISE_SAMPLES * noise;
        let mean = squares / (2.0 * tiles);
        let signal_gradients = mean - noise_gradients;
        if signal_gradients < MIN_SIGNAL_FRACTION * mean {
            return None;
        }
        let spread = sum_of(&|tile| (0.5 * tile.hessian.trace() - mean).powi(2)) / tiles;
        let by_noise =
            (noise_gradients.powi(2) + 2.0 * noise_gradients * signal_gradients) / NOISE_DEGREES_OF_FREEDOM;
        let own_share = (1.0 - by_noise / spread.max(by_noise)).max(0.0);
        Some(Self { gain, noise, noise_gradients, signal_gradients, own_share })
    }

    /// The part by signal of the squared gradients of a tile along an axis: what their noise
    /// leaves, shrunk towards the mean of all tiles (empirical Bayes). A tile without texture has
    /// only noise there, and a step by its own gradients would confirm whatever pose it was sampled
    /// at.
    fn signal_of(&self, squares: f64) -> f64 {
        let own = squares - self.noise_gradients;
        let signal = self.signal_gradients + self.own_share * (own - self.signal_gradients);
        signal.clamp(MIN_SIGNAL_FRACTION * squares, squares)
    }
}

/// Minimum number of tiles. Not derived; chosen.
const MIN_TILES: usize = 12;

/// Noise floor, gray levels²: the 1/12 of rounding after smoothing.
const MIN_NOISE: f64 = 0.02;

/// Least signal fraction of all tiles, below which a coarser level has more information, and of a
/// tile along an axis. Not derived; chosen.
const MIN_SIGNAL_FRACTION: f64 = 0.05;

/// Degrees of freedom of the squared gradients of white noise in a tile along both axes: twice its
/// 256 samples over 2.1, the sum of their squared correlations, over two for their mean square.
const NOISE_DEGREES_OF_FREEDOM: f64 = 122.0;

/// Least squared gradients of a tile along an axis, gray levels².
const MIN_GRADIENTS: f64 = 1e-4;

/// Sum of the tiles' correlations over the root of the sum of their squares: about standard normal
/// for unrelated images of any texture; the root of the number of tiles where all match.
fn score(matches: &[(&Tile, TileMatch)]) -> f64 {
    let correlations =
        matches.iter().map(|(tile, found)| found.product / (tile.energy * found.energy).max(1e-9).sqrt());
    let (sum, squares) = correlations.fold((0.0, 0.0), |(sum, squares), c| (sum + c, squares + c * c));
    sum / f64::max(squares, 1e-12).sqrt()
}

#[cfg(test)]
mod tests;
