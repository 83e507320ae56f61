use super::*;
use crate::camera::Distortion;
use crate::image::GrayImage;
use crate::motion::{MotionModel, Random, RigPriorEstimator};
use crate::simulation::{Ground, Renderer, shared_ground};
use nalgebra::{Matrix3, Vector2, Vector3};
use std::sync::Arc;

const HEIGHT_M: f64 = 0.75;

/// A camera over ground, and images with a given noise.
struct DenseWorld {
    camera: Camera,
    renderer: Renderer,
    ground: Arc<Ground>,
}

impl DenseWorld {
    fn new(texture: &str, seed: u64) -> Self {
        let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap();
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.7, 119.2), distortion).unwrap();
        let renderer = Renderer::new(&camera);
        let ground = shared_ground(texture, renderer.footprint_m(HEIGHT_M), seed);
        Self { camera, renderer, ground }
    }

    /// Gray levels that a pose sees, exactly.
    fn view(&self, pose: &GroundPose) -> Vec<f32> {
        let mut view = vec![0.0; 320 * 240];
        self.renderer.add_view(&self.ground, pose, 1.0, &mut view);
        view
    }

    /// A view with sensor noise of this standard deviation, gray levels.
    fn image(&self, pose: &GroundPose, noise: f64, random: &mut Random) -> GrayImage {
        let mut uniform = || ((random.bits() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
        let mut gaussian = || (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
        let rounded = |gray: f32| (f64::from(gray) + noise * gaussian()).round().clamp(0.0, 255.0) as u8;
        GrayImage::from_samples(320, 240, self.view(pose).into_iter().map(rounded).collect()).unwrap()
    }

    /// The pose of `image` relative to `reference`, which was taken at `from`.
    fn refined(
        &self,
        from: &GroundPose,
        reference: &GrayImage,
        image: &GrayImage,
        guess: &GroundPose,
    ) -> Option<DenseEstimate> {
        let config = MotionConfig { model: MotionModel::Rigid, ..Default::default() };
        let reference = DenseReference::new(&self.camera, &DenseImage::new(reference), from, 0);
        let prior = RigPriorEstimator::new(from).prior(from, &config);
        refine(&self.camera, (&reference, &Matrix3::zeros()), &DenseImage::new(image), guess, &prior, &config)
    }

    /// Cramér–Rao bound of (x, y, heading) from two images with this noise, over their overlap.
    fn bound(&self, from: &GroundPose, pose: &GroundPose, noise: f64) -> Matrix3<f64> {
        let step = 1e-4;
        let next_pose = |i: usize, by: f64| {
            let mut next_pose = *pose;
            *[&mut next_pose.x_m, &mut next_pose.y_m, &mut next_pose.heading_rad][i] += by;
            self.view(&next_pose)
        };
        let slopes = [0, 1, 2].map(|i| (next_pose(i, step), next_pose(i, -step)));
        let mut information = Matrix3::zeros();
        for at in 0..320 * 240 {
            let pixel = Pixel::new((at % 320) as f64, (at / 320) as f64);
            let ground = self.camera.ray_from_pixel(pixel).and_then(|ray| pose.ground_from_ray(ray));
            let before = ground.and_then(|ground| ViewingPose::new(*from).pixel(&self.camera, ground, 0.0));
            if before.is_some_and(|before| self.camera.contains(before, 0.0)) {
                let slope =
                    Vector3::from_fn(|i, _| f64::from(slopes[i].0[at] - slopes[i].1[at]) / (2.0 * step));
                information += slope * slope.transpose() / (2.0 * noise * noise);
            }
        }
        information.try_inverse().unwrap()
    }
}

fn error(found: &DenseEstimate, truth: &GroundPose) -> Vector3<f64> {
    let pose = &found.estimate.pose;
    Vector3::new(pose.x_m - truth.x_m, pose.y_m - truth.y_m, pose.heading_rad - truth.heading_rad)
}

/// Ground sampling distance, metres.
const PIXEL_M: f64 = HEIGHT_M / 250.0;

#[test]
fn subpixel_shifts_have_no_interpolation_bias() {
    for texture in ["asphalt", "carpet"] {
        let world = DenseWorld::new(texture, 7);
        let from = GroundPose::level(HEIGHT_M);
        let reference = world.image(&from, 0.0, &mut Random::new(0));
        for fraction in [0.15, 0.3, 0.5, 0.75] {
            let truth = GroundPose { x_m: 3.0 * PIXEL_M, y_m: (5.0 + fraction) * PIXEL_M, ..from };
            let image = world.image(&truth, 0.0, &mut Random::new(0));
            let guess = GroundPose { x_m: 2.0 * PIXEL_M, y_m: 4.5 * PIXEL_M, ..from };
            let found = world.refined(&from, &reference, &image, &guess).unwrap();
            let off = error(&found, &truth) / PIXEL_M;
            println!("{texture} {fraction}: {:.4} {:.4} px", off.x, off.y);
            assert!(off.xy().amax() < 0.005, "{texture} {fraction}: {off:?}");
        }
    }
}

#[test]
fn the_error_is_near_the_cramer_rao_bound_and_the_covariance() {
    let from = GroundPose::level(HEIGHT_M);
    let truth = GroundPose { x_m: 0.081, y_m: -0.043, heading_rad: 0.07, ..from };
    let guess = GroundPose { x_m: 0.078, y_m: -0.040, heading_rad: 0.074, ..from };
    let (noise, pairs) = (3.0, 12);
    // Grass has most of its texture at periods of one or two pixels, which smoothing removes with
    // the noise.
    for (texture, within) in [("asphalt", 1.5), ("grass", 2.0)] {
        let world = DenseWorld::new(texture, 3);
        let bound = world.bound(&from, &truth, noise);
        let (mut squares, mut normalised) = (Vector3::zeros(), 0.0);
        for seed in 0..pairs {
            let mut random = Random::new(seed);
            let reference = world.image(&from, noise, &mut random);
            let image = world.image(&truth, noise, &mut random);
            let found = world.refined(&from, &reference, &image, &guess).unwrap();
            let off = error(&found, &truth);
            squares += off.component_mul(&off) / pairs as f64;
            let covariance = found.estimate.covariance.fixed_view::<3, 3>(0, 0).into_owned();
            normalised += off.dot(&(covariance.try_inverse().unwrap() * off)) / pairs as f64;
        }
        let ratios = [0, 1, 2].map(|i| (squares[i] / bound[(i, i)]).sqrt());
        println!("{texture}: {ratios:.2?} of the bound, NEES {normalised:.2}");
        assert!(ratios.iter().all(|&ratio| ratio < within), "{texture}: {ratios:?}");
        // NEES is 3 where the covariance is right. Its mean over twelve pairs stays below the upper
        // 95 % bound; the floor for shared errors makes it smaller on the richest ground.
        assert!((0.3..4.55).contains(&normalised), "{texture}: {normalised}");
    }
}

#[test]
fn unrelated_ground_has_a_low_score() {
    let world = DenseWorld::new("asphalt", 5);
    let from = GroundPose::level(HEIGHT_M);
    let reference = world.image(&from, 2.0, &mut Random::new(1));
    let elsewhere = GroundPose { x_m: 7.0, y_m: 3.0, ..from };
    let image = world.image(&elsewhere, 2.0, &mut Random::new(2));
    let found = world.refined(&from, &reference, &image, &from);
    assert!(found.is_none_or(|found| found.score < DenseEstimate::LEAST_SCORE));
}

#[test]
fn noise_does_not_shorten_the_steps() {
    // Noise makes most of the squared gradients. If it counted as signal, each step would be too
    // short and the covariance too small.
    let from = GroundPose::level(HEIGHT_M);
    let truth = GroundPose { x_m: 0.081, y_m: -0.043, heading_rad: 0.07, ..from };
    let config = MotionConfig { model: MotionModel::Rigid, ..Default::default() };
    let prior = RigPriorEstimator::new(&from).prior(&from, &config);
    for (texture, noise) in [("asphalt", 12.0), ("concrete", 4.0)] {
        let (mut recovered, mut normalised, pairs) = (0.0, 0.0, 24);
        for seed in 0..pairs {
            let world = DenseWorld::new(texture, 3 + seed);
            let mut random = Random::new(seed);
            let mut dense = |pose: &GroundPose| DenseImage::new(&world.image(pose, noise, &mut random));
            let (reference, image) = (dense(&from), dense(&truth));
            let reference = DenseReference::new(&world.camera, &reference, &from, 0);
            let (tiles, plane) = (&reference.levels[0].1, &image.planes[0]);
            let (camera, keyframe_pose) = (&world.camera, &from);
            let (image, prior, config) = (&image, &prior, &config);
            let keyframe_covariance = &Matrix3::zeros();
            let level =
                DenseLevel { camera, tiles, keyframe_pose, keyframe_covariance, image, plane, prior, config };
            let nuisance = |by: f64| GroundPose { x_m: truth.x_m + 0.3 * by * PIXEL_M, ..truth };
            let from_beside = |by: f64| level.step(&nuisance(by)).unwrap().estimate.pose.x_m;
            recovered += 1.0 - (from_beside(1.0) - from_beside(-1.0)) / (0.6 * PIXEL_M);
            let found = level.converge(&truth).unwrap();
            let off = error(&found, &truth);
            let covariance = found.estimate.covariance.fixed_view::<3, 3>(0, 0).into_owned();
            normalised += off.dot(&(covariance.try_inverse().unwrap() * off));
        }
        let (signal_fraction, nees) = (recovered / pairs as f64, normalised / pairs as f64);
        println!("{texture}: {signal_fraction:.3} of a step is recovered, NEES {nees:.2}");
        assert!((0.9..1.1).contains(&signal_fraction), "{texture}: {signal_fraction}");
        // 95 % of the means over 24 pairs lie within 0.7 of 3; the error of the estimated signal
        // fraction adds some.
        assert!((2.2..4.2).contains(&nees), "{texture}: {nees}");
    }
}

#[test]
fn tiles_that_show_a_joint_step_by_their_own_gradients() {
    // On a bare floor most tiles show nothing. If all had the same share of noise, those that do
    // show something would step twice as far as they should, and the others confirm the guess.
    let from = GroundPose::level(HEIGHT_M);
    let truth = GroundPose { x_m: 0.02, y_m: -0.01, ..from };
    let config = MotionConfig { model: MotionModel::Rigid, ..Default::default() };
    let prior = RigPriorEstimator::new(&from).prior(&from, &config);
    let world = DenseWorld::new("tiles", 3);
    let mut random = Random::new(1);
    let mut dense = |pose: &GroundPose| DenseImage::new(&world.image(pose, 8.0, &mut random));
    let (reference, image) = (dense(&from), dense(&truth));
    let reference = DenseReference::new(&world.camera, &reference, &from, 0);
    let level = DenseLevel {
        camera: &world.camera,
        tiles: &reference.levels[0].1,
        keyframe_pose: &from,
        keyframe_covariance: &Matrix3::zeros(),
        image: &image,
        plane: &image.planes[0],
        prior: &prior,
        config: &config,
    };
    let beside = |by: f64| GroundPose { x_m: truth.x_m + by * PIXEL_M, ..truth };
    let [found, other] = [0.3, -0.3].map(|by| level.step(&beside(by)).unwrap().tracks);
    let (mut moved, mut shifted) = (0.0, 0.0);
    for track in &found {
        let Some(again) = other.iter().find(|other| other.reference == track.reference) else { continue };
        let information = track.covariance_px2.try_inverse().unwrap();
        if information.trace() < 1.0 / 0.05f64.powi(2) {
            continue;
        }
        let tile = level.tiles.iter().find(|tile| tile.centre == track.reference).unwrap();
        let expected = |by: f64| tile.patch.pixel(level.camera, &ViewingPose::new(beside(by))).unwrap();
        let between = |a: Pixel, b: Pixel| Vector2::new(a.x - b.x, a.y - b.y);
        let weighted = information * between(expected(0.3), expected(-0.3));
        moved += between(track.pixel, again.pixel).dot(&weighted);
        shifted += between(expected(0.3), expected(-0.3)).dot(&weighted);
    }
    println!("{:.3} of a step is recovered", 1.0 - moved / shifted);
    assert!(shifted > 100.0 && (moved / shifted).abs() < 0.2, "{moved} of {shifted}");
}
