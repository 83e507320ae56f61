//! The whole overlap of two images compared: where there are no corners to hold on to, and where every pixel shall count.
//!
//! A reference image of known pose is cut into tiles of 16x16 samples on several halvings. Under a pose each tile says, by one step of inverse
//! compositional Lucas–Kanade (S. Baker and I. Matthews, 2004) and indifferent to gain, offset and slope of its light, where its ground
//! rather is; the pose is fitted to all of them at once, each counting by its information and robustly ([`super::estimate`]'s own fit), and looked from
//! again: Gauss–Newton over all pixels, with weights a tile at a time. From coarse to fine, as long as finer levels know more: in noise the finest do
//! not.
//!
//! Noise in the reference makes its derivatives look stronger and its contrast larger than what an image can answer to. What noise there is follows from
//! what the two images do not share, and step and weight are set right for it, so that neither pose nor covariance is pulled to where it was looked
//! from.

mod plane;
mod tile;

pub use plane::DenseImage;

use super::GroundFromRay;
use super::{
    Elevation, MotionConfig, MotionEstimate, Observations, RigPrior, Sighting, ViewingPose, planar_pose,
    whitened,
};
use crate::camera::Camera;
use crate::geometry::{GroundPose, Pixel};
use nalgebra::{Matrix2, Matrix3};
use plane::Plane;
use tile::{AREA, Look, NOISE_OF_CONTRAST, NOISE_OF_GRADIENT, NOISE_OF_PLANE, SIDE, Tile};

/// An image whose tiles lie on the ground, to compare others with.
#[derive(Debug, Clone)]
pub struct DenseReference {
    /// The finest first; every one with the number of its halving.
    levels: Vec<(usize, Vec<Tile>)>,
    /// Where it was taken.
    pose: GroundPose,
}

/// A pose from all of the overlap.
#[derive(Debug, Clone)]
pub struct DenseEstimate {
    /// The pose, its covariance and what agrees with it; the inliers are tiles.
    pub estimate: MotionEstimate,
    /// How sure it is that the images show the same ground, in standard deviations of what unrelated ones would show. Below
    /// [`DenseEstimate::LEAST_SCORE`] it is not.
    pub score: f64,
    /// The part of the reference's tiles that lie in the image.
    pub overlap: f64,
    /// The part of the tiles in the image that agree with the pose.
    pub agreement: f64,
    /// How many times the images were halved for the last comparison.
    pub halvings: usize,
}

impl DenseEstimate {
    /// Chance does not reach this score, and a false optimum seldom.
    pub const LEAST_SCORE: f64 = 4.0;
}

impl DenseReference {
    /// The tiles of an image taken at `pose`, on the halvings from `finest` on (0: the full image; a level costs four times the next).
    pub fn new(camera: &Camera, image: &DenseImage, pose: &GroundPose, finest: usize) -> Self {
        let from = GroundFromRay::new(pose);
        let levels = image.planes.iter().enumerate().skip(finest);
        let level = |(number, plane): (usize, &Plane)| {
            let step = if number < OVERLAPPING { SIDE } else { SIDE / 2 };
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

    /// The part of the tiles that a camera at `pose` has in its image, 0 to 1.
    pub fn overlap(&self, camera: &Camera, pose: &GroundPose) -> f64 {
        let Some((_, tiles)) = self.levels.first() else { return 0.0 };
        let viewing = ViewingPose::new(*pose);
        let seen = |tile: &&Tile| {
            tile.patch.pixel(camera, &viewing).is_some_and(|pixel| camera.contains(pixel, SIDE as f64))
        };
        tiles.iter().filter(seen).count() as f64 / tiles.len().max(1) as f64
    }
}

/// On this halving and coarser ones the tiles overlap, for want of tiles.
const OVERLAPPING: usize = 3;

/// The pose of a camera whose image overlaps the reference's, near `guess`, with what `prior` says of height and tilt. `None` where the images do not
/// tell.
///
/// The guess may be off by about four pixels on a texture of any kind, and by twenty where there are large shapes too.
pub fn refine(
    camera: &Camera,
    reference: &DenseReference,
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
        let level = Level { camera, tiles, keyframe_pose, image, plane, halvings: *halvings, prior, config };
        let Some(found) = level.settle(&pose) else { continue };
        if *halvings >= OVERLAPPING {
            // Too few tiles to be sure of; the next level will tell.
            pose = if found.score > TRUSTED_START { found.estimate.pose } else { pose };
            continue;
        }
        let spread = |found: &DenseEstimate| {
            let covariance = &found.estimate.covariance;
            covariance[(0, 0)] + covariance[(1, 1)]
        };
        let worse = best.as_ref().is_some_and(|best| spread(&found) > WORSE * spread(best));
        if worse {
            break;
        }
        pose = found.estimate.pose;
        best = Some(found);
    }
    best
}

/// A finer level is left out where the variance of its pose is so many times the coarser one's: below that, it still has the smaller bias.
const WORSE: f64 = 1.5;

/// A coarse level with overlapping tiles is believed from this score on.
const TRUSTED_START: f64 = 3.0;

/// Whether much of a tile about a pixel is known not to be ground.
fn is_masked(image: &DenseImage, centre: Pixel, plane: &Plane) -> bool {
    // Of 5x5 places; the mask is wider than what it covers, so that a few do not matter.
    const MOST: usize = 2;
    let Some(mask) = &image.mask else { return false };
    let step_px = plane.pixels_per_sample * SIDE as f64 / 5.0;
    let covered = |place: &usize| {
        let (right, down) = ((place % 5) as f64 - 2.0, (place / 5) as f64 - 2.0);
        mask.covers_pixel(Pixel::new(centre.x + right * step_px, centre.y + down * step_px))
    };
    (0..25).filter(covered).count() > MOST
}

/// One halving of the images.
struct Level<'a> {
    camera: &'a Camera,
    tiles: &'a [Tile],
    keyframe_pose: &'a GroundPose,
    image: &'a DenseImage,
    plane: &'a Plane,
    halvings: usize,
    prior: &'a RigPrior,
    config: &'a MotionConfig,
}

/// More steps than this do not settle any more.
const STEPS: usize = 15;

/// A step shorter than this part of a sample is the last, as is one shorter than that many standard deviations of the pose.
const SETTLED: f64 = 0.005;
const SETTLED_SIGMAS: f64 = 0.03;

impl Level<'_> {
    /// Looks from pose to pose until nothing moves; `None` where that does not come.
    fn settle(&self, guess: &GroundPose) -> Option<DenseEstimate> {
        let mut pose = *guess;
        let sample_m = self.plane.pixels_per_sample * guess.height_m / self.camera.focal_px().0;
        for _ in 0..STEPS {
            let next = self.step(&pose)?;
            let moved = &next.estimate.pose;
            let turned_m = 0.5 * guess.height_m * (moved.heading_rad - pose.heading_rad).abs();
            let moved_m = (moved.x_m - pose.x_m).hypot(moved.y_m - pose.y_m) + turned_m;
            if moved_m > LONGEST_STEP * sample_m {
                return None;
            }
            pose = next.estimate.pose;
            // What noise moves is not waited for.
            let covariance = &next.estimate.covariance;
            let known_m = (covariance[(0, 0)] + covariance[(1, 1)]).sqrt();
            if moved_m < f64::max(SETTLED * sample_m, SETTLED_SIGMAS * known_m) {
                return Some(next);
            }
        }
        None
    }

    /// The pose that the tiles speak for as they look from `pose`.
    fn step(&self, pose: &GroundPose) -> Option<DenseEstimate> {
        let viewing = ViewingPose::new(*pose);
        let looks: Vec<(&Tile, Look)> = self
            .tiles
            .iter()
            .filter_map(|tile| tile.look(self.camera, &viewing, self.plane).map(|look| (tile, look)))
            .filter(|(_, look)| !is_masked(self.image, look.warp.warp.position, self.plane))
            .collect();
        let light = Light::between(&looks)?;
        let sightings: Vec<Sighting> =
            looks.iter().filter_map(|(tile, look)| self.sighting(tile, look, &light)).collect();
        let (observations, usual_px) = whitened(&sightings, SHARED_PX2)?;
        let reach_px = (REACH * usual_px).max(self.plane.pixels_per_sample);
        let config = MotionConfig { inlier_px: reach_px, ..*self.config };
        let agreeing = vec![true; observations.len()];
        let observations = Observations {
            seen: &observations,
            keyframe_pose: self.keyframe_pose,
            keyframe_covariance: &Matrix3::zeros(),
            shutter: None,
        };
        let estimate =
            planar_pose::refine(self.camera, observations, pose, &agreeing, pose, self.prior, &config)?;
        let agreement = estimate.inlier_count() as f64 / looks.len() as f64;
        let overlap = looks.len() as f64 / self.tiles.len() as f64;
        Some(DenseEstimate { estimate, score: score(&looks), overlap, agreement, halvings: self.halvings })
    }

    /// Where a tile has its ground; `None` where it looks like something else, or holds nothing.
    fn sighting(&self, tile: &Tile, look: &Look, light: &Light) -> Option<Sighting> {
        let area = AREA as f64;
        // A tile's own gain as far as its contrast tells it.
        let steadying = light.noise / GAIN_SPREAD.powi(2);
        let gain = (look.product + light.gain * steadying)
            / ((tile.energy - area * light.noise).max(0.0) + steadying);
        if gain < LEAST_GAIN * light.gain {
            return None;
        }
        let inverse = tile.hessian.try_inverse().filter(|_| tile.hessian.determinant() > 1e-9)?;
        let unexplained =
            (look.energy - look.product * look.product / tile.energy.max(1e-9)) / (area * gain * gain);
        let noise = unexplained.max(light.noise);
        let linear = look.warp.warp.linear * self.plane.pixels_per_sample;
        let step = linear * inverse * look.slope / (gain * light.answer);
        let position = look.warp.warp.position;
        let curvature_offset = look.warp.curvature_offset;
        let covariance_px2: Matrix2<f64> =
            linear * inverse * linear.transpose() * (noise / (light.answer * light.answer));
        Some(Sighting {
            ground: tile.patch.ground,
            elevation: Elevation::FLAT,
            pixel: Pixel::new(
                position.x - curvature_offset.x - step.x,
                position.y - curvature_offset.y - step.y,
            ),
            covariance_px2,
            row_fraction: 0.0,
            keyframe_row_fraction: 0.0,
        })
    }
}

/// A step beyond this many samples leads where the tiles have never looked.
const LONGEST_STEP: f64 = 6.0;

/// Usual tiles are rarely further off than this many of their standard deviations.
const REACH: f64 = 6.0;

/// What a tile is off even without noise, pixels²: 0.005 px.
const SHARED_PX2: f64 = 2.5e-5;

/// The gains of tiles scatter about that of the image by so much, one standard deviation.
const GAIN_SPREAD: f64 = 0.1;

/// A tile that slopes_sum with less than this part of the image's gain shows something else.
const LEAST_GAIN: f64 = 0.3;

/// How the light and the noise of two images are related.
struct Light {
    /// Contrast of the image over that of the reference.
    gain: f64,
    /// Variance of the noise of a reference's sample, as it is after smoothing.
    noise: f64,
    /// The part of the reference's squared derivatives that is ground and not noise: so much of a step is answered.
    answer: f64,
}

impl Light {
    /// Both images have the same noise, of which less is left where samples lie between those of the image: the gain is that of total least squares, and
    /// what they do not share is noise. `None` where they share nothing.
    fn between(looks: &[(&Tile, Look)]) -> Option<Self> {
        let sum = |of: fn(&Tile, &Look) -> f64| looks.iter().map(|(tile, look)| of(tile, look)).sum::<f64>();
        let product = sum(|_, look| look.product);
        let energy = sum(|tile, _| tile.energy);
        let seen = sum(|_, look| look.energy);
        let squares = sum(|tile, _| tile.hessian.trace());
        if looks.len() < FEWEST_TILES || product < 1e-3 * (energy * seen).sqrt() {
            return None;
        }
        let tiles = looks.len() as f64;
        let left = sum(|_, look| AREA as f64 * look.noise - NOISE_OF_PLANE) / (tiles * NOISE_OF_CONTRAST);
        let ratio = (seen - left * energy) / product;
        let gain = 0.5 * (ratio + (ratio * ratio + 4.0 * left).sqrt());
        let noise = ((energy - product / gain) / (tiles * NOISE_OF_CONTRAST)).max(LEAST_NOISE);
        // Smoothed samples and smoothed derivatives have the same noise.
        let answer = ((squares - 2.0 * tiles * NOISE_OF_GRADIENT * noise) / squares).min(1.0);
        (answer > MIN_SIGNAL_FRACTION).then_some(Self { gain, noise, answer })
    }
}

/// Fewer tiles tell nothing.
const FEWEST_TILES: usize = 12;

/// Rounding to whole gray levels leaves this of its twelfth after smoothing.
const LEAST_NOISE: f64 = 0.02;

/// Where less of the derivatives than this is ground, a coarser level knows more.
const MIN_SIGNAL_FRACTION: f64 = 0.05;

/// The sum of the tiles' correlations over the root of the sum of their squares: about one standard deviation where the images are unrelated, whatever
/// their textures; the root of the number of tiles where all of them agree.
fn score(looks: &[(&Tile, Look)]) -> f64 {
    let correlations =
        looks.iter().map(|(tile, look)| look.product / (tile.energy * look.energy).max(1e-9).sqrt());
    let (sum, squares) = correlations.fold((0.0, 0.0), |(sum, squares), c| (sum + c, squares + c * c));
    sum / f64::max(squares, 1e-12).sqrt()
}

#[cfg(test)]
mod tests;
