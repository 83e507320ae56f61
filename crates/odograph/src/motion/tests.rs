use super::*;
use crate::camera::{Distortion, Rig};
use proptest::prelude::*;

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.25, 0.06, 0.0003, -0.0002]).unwrap();
    Camera::new((640, 480), (500.0, 503.0), (322.0, 236.0), distortion).unwrap()
}

/// Noise of the images that the tests state, pixels.
const NOISE_PX: f64 = 0.2;

/// Observations from `truth` of ground points on a grid of pixels, with Gaussian noise and a
/// fraction of outliers.
fn observations(truth: &GroundPose, noise_px: f64, wrong: f64, seed: u64) -> Vec<Observation> {
    let camera = camera();
    let mut random = Random::new(seed);
    let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
    let mut seen = Vec::new();
    for j in 0..12 {
        for i in 0..16 {
            let pixel = Pixel::new(20.0 + 40.0 * i as f64, 20.0 + 40.0 * j as f64);
            let Some(ground) = camera.ray_from_pixel(pixel).and_then(|ray| truth.ground_from_ray(ray)) else {
                continue;
            };
            let gaussian = (-2.0 * (1.0 - uniform()).ln()).sqrt();
            let angle = std::f64::consts::TAU * uniform();
            let pixel = if uniform() < wrong {
                Pixel::new(640.0 * uniform(), 480.0 * uniform())
            } else {
                Pixel::new(
                    pixel.x + noise_px * gaussian * angle.cos(),
                    pixel.y + noise_px * gaussian * angle.sin(),
                )
            };
            seen.push(Observation {
                ground,
                elevation: Elevation::FLAT,
                pixel,
                whitening: nalgebra::Matrix2::identity(),
                row_fraction: 0.0,
                keyframe_row_fraction: 0.0,
                centre_of_projection: nalgebra::Vector3::z(),
                corrected_at_m: 0.0,
            });
        }
    }
    seen
}

/// The estimate with a keyframe one metre above the origin.
fn measured(
    seen: &[Observation],
    prediction: &GroundPose,
    prior: &RigPrior,
    config: &MotionConfig,
    seed: u64,
) -> Option<MotionEstimate> {
    let observations = Observations {
        seen,
        noise_px: NOISE_PX,
        keyframe_pose: &GroundPose::level(1.0),
        keyframe_covariance: &Matrix3::zeros(),
        shutter: None,
        shape: None,
    };
    estimate(&camera(), observations, prediction, prior, config, &mut Random::new(seed))
}

/// The estimate with the prior of the first frame of a recording.
fn from(
    seen: &[Observation],
    prediction: &GroundPose,
    config: &MotionConfig,
    seed: u64,
) -> Option<MotionEstimate> {
    let prior = RigPriorEstimator::new(prediction).prior(prediction, config);
    measured(seen, prediction, &prior, config, seed)
}

fn numbers(pose: &GroundPose) -> [f64; 6] {
    [pose.x_m, pose.y_m, pose.heading_rad, pose.height_m, pose.roll_rad, pose.pitch_rad]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn exact_tracks_give_the_exact_pose_under_every_model(
        x in -0.3..0.3f64, y in -0.3..0.3f64, heading in -0.8..0.8f64, height in 0.8..1.2f64, roll in -0.12..0.12f64, pitch in -0.12..0.12f64,
    ) {
        for model in [MotionModel::Rigid, MotionModel::Similarity, MotionModel::Free] {
            let (fixed_height, fixed_tilt) = (model == MotionModel::Rigid, model != MotionModel::Free);
            let rig = Rig { roll_rad: 0.05, pitch_rad: -0.03, ..Rig::level(1.0) };
            let truth = GroundPose {
                x_m: x, y_m: y, heading_rad: heading,
                height_m: if fixed_height { 1.0 } else { height },
                roll_rad: if fixed_tilt { 0.05 } else { roll },
                pitch_rad: if fixed_tilt { -0.03 } else { pitch },
            };
            let seen = observations(&truth, 0.0, 0.3, 7);
            let config = MotionConfig { model, ..Default::default() };
            let found = from(&seen, &rig.first_pose(), &config, 3).expect("a pose");
            for (a, b) in numbers(&found.pose).iter().zip(numbers(&truth)) {
                // The bias by the prior is below 10⁻⁶.
                prop_assert!((a - b).abs() < 1e-5, "{model:?} {:?} {truth:?}", found.pose);
            }
        }
    }
}

#[test]
fn the_covariance_matches_the_errors() {
    // The mean normalised estimation error squared (NEES) is the number of unknowns when the
    // covariance is right.
    for (model, unknowns) in [(MotionModel::Rigid, 3), (MotionModel::Similarity, 4), (MotionModel::Free, 6)] {
        let truth = GroundPose { x_m: 0.1, y_m: -0.05, heading_rad: 0.2, ..GroundPose::level(1.0) };
        let config = MotionConfig { model, ..Default::default() };
        let runs = 200;
        let mut total = 0.0;
        for seed in 0..runs {
            // Noise large enough that the floor for shared errors is negligible.
            let seen = observations(&truth, 0.5, 0.0, seed);
            let prediction = GroundPose::level(1.0);
            let found = from(&seen, &prediction, &config, seed).expect("a pose");
            let error =
                nalgebra::DVector::from_fn(unknowns, |i, _| numbers(&found.pose)[i] - numbers(&truth)[i]);
            let covariance = nalgebra::DMatrix::from_fn(unknowns, unknowns, |i, j| found.covariance[(i, j)]);
            total += error.dot(&covariance.cholesky().unwrap().solve(&error));
        }
        let mean = total / f64::from(runs as u32);
        // 95 % bounds of a chi-square mean: k ± 1.96 √(2 k / runs); the biweight costs 5 % on top.
        let bound = 1.96 * (2.0 * unknowns as f64 / runs as f64).sqrt() + 0.1 * unknowns as f64;
        assert!((mean - unknowns as f64).abs() < bound, "{model:?}: {mean} for {unknowns}");
    }
}

#[test]
fn errors_of_the_model_are_part_of_the_stated_error() {
    let truth = GroundPose { x_m: 0.1, y_m: -0.05, heading_rad: 0.2, ..GroundPose::level(1.0) };
    let config = MotionConfig { model: MotionModel::Free, ..Default::default() };
    let (runs, mut by_noise, mut by_both) = (200, 0.0, 0.0);
    for seed in 0..runs {
        let mut random = Random::new(seed);
        let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64;
        // Three waves for each coordinate, half an image and more in length: relief, a wrong lens.
        let waves: [_; 6] = std::array::from_fn(|_| {
            let (angle, phase) = (std::f64::consts::TAU * uniform(), std::f64::consts::TAU * uniform());
            let per_px = std::f64::consts::TAU / (320.0 + 960.0 * uniform());
            move |at: Pixel| (per_px * (at.x * angle.cos() + at.y * angle.sin()) + phase).cos()
        });
        let mut seen = observations(&truth, NOISE_PX, 0.0, seed);
        for seen in &mut seen {
            let [x, y] = [0, 3].map(|first| (first..first + 3).map(|k| waves[k](seen.pixel)).sum::<f64>());
            seen.pixel = Pixel::new(seen.pixel.x + 0.5 * x, seen.pixel.y + 0.5 * y);
        }
        let found = from(&seen, &GroundPose::level(1.0), &config, seed).expect("a pose");
        let error = found.pose.to_vector() - truth.to_vector();
        let nees = |covariance: Matrix6<f64>| error.dot(&covariance.cholesky().unwrap().solve(&error));
        by_noise += nees(found.covariance) / runs as f64;
        by_both += nees(found.covariance + found.model_covariance) / runs as f64;
    }
    println!("NEES {by_noise} {by_both}");
    // Six unknowns. How smooth the error is decides how much of it the pose takes up, so that the
    // deviation is true within a factor of two, and the NEES within four.
    assert!(by_noise > 60.0, "the noise alone does not explain the error: NEES {by_noise}");
    assert!(by_both > 1.5 && by_both < 24.0, "NEES {by_both}");

    // Where noise explains the residuals nothing is added.
    let seen = observations(&truth, NOISE_PX, 0.0, 1);
    let found = from(&seen, &GroundPose::level(1.0), &config, 1).expect("a pose");
    let parts = found.model_covariance.diagonal().component_div(&found.covariance.diagonal());
    assert!(parts.iter().all(|part| *part < 0.5), "{parts}");
}

#[test]
fn outliers_alone_give_no_pose() {
    let seen = observations(&GroundPose::level(1.0), 0.0, 1.0, 5);
    assert!(from(&seen, &GroundPose::level(1.0), &MotionConfig::default(), 1).is_none());
    assert!(from(&[], &GroundPose::level(1.0), &MotionConfig::default(), 1).is_none());
}

#[test]
fn the_heading_stays_unwrapped() {
    let truth = GroundPose { heading_rad: 13.0, ..GroundPose::level(1.0) };
    let prediction = GroundPose { heading_rad: 12.9, ..truth };
    let seen = observations(&truth, 0.1, 0.2, 2);
    let found = from(&seen, &prediction, &MotionConfig::default(), 1).unwrap();
    assert!((found.pose.heading_rad - 13.0).abs() < 1e-3);
}

#[test]
fn the_derivative_by_the_keyframe_pose_is_right() {
    let (from, to) = (
        GroundPose::level(1.0),
        GroundPose { x_m: 0.2, y_m: -0.1, heading_rad: 0.3, ..GroundPose::level(1.0) },
    );
    let seen = observations(&to, 0.0, 0.0, 5);
    // The same rays from a keyframe with a small pose error.
    let keyframe_pose = |keyframe: &GroundPose| -> Vec<Observation> {
        let reproject = |seen: &Observation| {
            let pixel = ViewingPose::new(from).pixel(&camera(), seen.ground, 0.0).unwrap();
            let ground = keyframe.ground_from_ray(camera().ray_from_pixel(pixel).unwrap()).unwrap();
            Observation { ground, ..*seen }
        };
        seen.iter().map(reproject).collect()
    };
    for model in [MotionModel::Rigid, MotionModel::Similarity, MotionModel::Free] {
        let config = MotionConfig { model, ..Default::default() };
        let prior =
            RigPrior { mean: [1.0, 0.0, 0.0], sigma: [0.1; 3], mount_share: [1.0; 3], shared_fraction: 0.0 };
        let found = measured(&seen, &to, &prior, &config, 1).unwrap();
        // A shift or a turn of all the ground changes neither height nor tilt, exactly.
        assert_eq!(found.by_keyframe.fixed_view::<3, 3>(3, 0), Matrix3::zeros());
        for number in 0..6 {
            let mut off = numbers(&from);
            off[number] += 1e-4;
            let [x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad] = off;
            let off = GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad };
            let moved = measured(&keyframe_pose(&off), &to, &prior, &config, 1).unwrap();
            for (i, (a, b)) in numbers(&moved.pose).into_iter().zip(numbers(&found.pose)).enumerate() {
                let change = (a - b) / 1e-4;
                // Robust weights and second-order terms change it by about 0.01.
                assert!(
                    (change - found.by_keyframe[(i, number)]).abs() < 0.02,
                    "{model:?}: {i} by {number}: {change} {}",
                    found.by_keyframe
                );
            }
        }
    }
}

#[test]
fn a_tilt_error_of_the_keyframe_is_estimated_with_the_pose() {
    let keyframe = GroundPose { roll_rad: 0.02, pitch_rad: -0.015, ..GroundPose::level(1.0) };
    let taken_for = GroundPose::level(1.0);
    let to = GroundPose { x_m: 0.25, y_m: -0.15, heading_rad: 0.4, ..keyframe };
    // The height has no error: scale is not observable from two images.
    let keyframe_covariance = &Matrix3::from_diagonal(&nalgebra::Vector3::new(0.0, 9e-4, 9e-4));
    let config = MotionConfig { model: MotionModel::Free, ..Default::default() };
    let prior =
        RigPrior { mean: [1.0, 0.0, 0.0], sigma: [0.3; 3], mount_share: [1.0; 3], shared_fraction: 0.0 };
    let (mut squares, runs) = (0.0, 60);
    for seed in 0..runs {
        let reproject = |seen: &Observation| {
            let pixel = ViewingPose::new(keyframe).pixel(&camera(), seen.ground, 0.0).unwrap();
            let ground = taken_for.ground_from_ray(camera().ray_from_pixel(pixel).unwrap()).unwrap();
            Observation { ground, ..*seen }
        };
        let seen: Vec<Observation> = observations(&to, 0.2, 0.1, seed).iter().map(reproject).collect();
        let measure = |keyframe_covariance| {
            let observations = Observations {
                seen: &seen,
                noise_px: NOISE_PX,
                keyframe_pose: &taken_for,
                keyframe_covariance,
                shutter: None,
                shape: None,
            };
            estimate(&camera(), observations, &to, &prior, &config, &mut Random::new(seed)).unwrap()
        };
        let (found, fixed) = (measure(keyframe_covariance), measure(&Matrix3::zeros()));
        assert!(fixed.keyframe_error.is_none());
        // With the keyframe fixed as level, the frame is nearly level too.
        let off = |found: &MotionEstimate| {
            (found.pose.roll_rad - to.roll_rad).hypot(found.pose.pitch_rad - to.pitch_rad)
        };
        assert!(off(&found) < 0.5 * off(&fixed), "{} {}", off(&found), off(&fixed));
        let error = found.keyframe_error.unwrap();
        let off = (error.mean - nalgebra::Vector3::new(0.0, 0.02, -0.015)).fixed_rows::<2>(1).into_owned();
        let covariance = error.covariance.fixed_view::<2, 2>(1, 1).into_owned();
        assert!(covariance.trace() < 0.2 * keyframe_covariance.trace(), "{covariance}");
        squares += off.dot(&(covariance.try_inverse().unwrap() * off));
    }
    // Two degrees of freedom: 95 % bounds of the mean over the runs, and a tenth for the biweight's
    // loss of efficiency.
    let (mean, bound) = (squares / runs as f64, 1.96 * (4.0 / runs as f64).sqrt() + 0.2);
    assert!((mean - 2.0).abs() < bound, "NEES {mean}");
}

#[test]
fn elevations_in_metres_of_the_keyframe_do_not_measure_its_height() {
    let keyframe = GroundPose::level(1.0);
    let to = GroundPose { x_m: 0.25, y_m: -0.15, heading_rad: 0.4, height_m: 1.02, ..keyframe };
    let uneven = |(index, seen): (usize, &Observation)| {
        let mean_m = 0.1 + 0.05 * (0.7 * index as f64).sin();
        let ray = crate::geometry::Ray::new(seen.ground.x_m - keyframe.x_m, seen.ground.y_m - keyframe.y_m);
        let ground =
            GroundPoint::new(keyframe.x_m + (1.0 - mean_m) * ray.x, keyframe.y_m + (1.0 - mean_m) * ray.y);
        let pixel = ViewingPose::new(to).pixel(&camera(), ground, mean_m)?;
        let elevation = Elevation { mean_m, variance_m2: 1e-6 };
        Some(Observation { ground, elevation, pixel, ..*seen })
    };
    let flat = observations(&to, 0.0, 0.0, 1);
    let seen: Vec<Observation> = flat.iter().enumerate().filter_map(uneven).collect();
    let sigma_m: f64 = 0.01;
    let keyframe_covariance = &Matrix3::from_diagonal(&nalgebra::Vector3::new(sigma_m * sigma_m, 0.0, 0.0));
    let observations = Observations {
        seen: &seen,
        noise_px: NOISE_PX,
        keyframe_pose: &keyframe,
        keyframe_covariance,
        shutter: None,
        shape: None,
    };
    let prior =
        RigPrior { mean: [1.0, 0.0, 0.0], sigma: [0.3; 3], mount_share: [1.0; 3], shared_fraction: 0.0 };
    let config = MotionConfig { model: MotionModel::Free, ..Default::default() };
    let found = estimate(&camera(), observations, &to, &prior, &config, &mut Random::new(1)).unwrap();
    let error = found.keyframe_error.unwrap();
    // The prior of the frame's height tells a thousandth.
    assert!(error.covariance[(0, 0)].sqrt() > 0.98 * sigma_m, "{}", error.covariance);
    assert!((found.pose.x_m - 0.25).abs() < 1e-4, "{:?}", found.pose);
}

/// Parallax of ground that slopes along the rows looks like a skew along the motion.
#[test]
fn sloping_ground_does_not_pass_for_a_skew() {
    let (keyframe, to) = (GroundPose::level(1.0), GroundPose { x_m: 0.12, ..GroundPose::level(1.0) });
    let flat = observations(&keyframe, 0.0, 0.0, 1);
    let unknown = GroundShape::unknown(&keyframe, flat.iter().map(|seen| seen.ground));
    let coefficients = nalgebra::Vector6::new(0.0, 0.06, -0.05, 0.03, 0.02, -0.04);
    let uneven = |seen: &Observation| {
        let elevation_m = unknown.at(seen.ground, &coefficients);
        let nearer = 1.0 - elevation_m;
        let ground = GroundPoint::new(nearer * seen.ground.x_m, nearer * seen.ground.y_m);
        let pixel = ViewingPose::new(to).pixel(&camera(), ground, elevation_m)?;
        let elevation = Elevation { mean_m: 0.0, variance_m2: 0.002 * 0.002 };
        Some(Observation { elevation, pixel, row_fraction: pixel.y / 480.0 - 0.5, ..*seen })
    };
    let seen: Vec<Observation> = flat.iter().filter_map(uneven).collect();
    // A skew of 0.2 mm in x and y.
    let prior = ShutterPrior {
        readout: Readout { mean_s: 0.02, variance_s2: 0.0 },
        expected: ExpectedRates {
            rate_variance: PoseRates::new(1e-4, 1e-4, 0.0, 0.0, 0.0, 0.0),
            ..Default::default()
        },
        applies: true,
    };
    let measure = |shape| {
        let observations = Observations {
            seen: &seen,
            noise_px: NOISE_PX,
            keyframe_pose: &keyframe,
            keyframe_covariance: &Matrix3::zeros(),
            shutter: Some((&prior, PoseRates::zeros())),
            shape,
        };
        let config = MotionConfig { model: MotionModel::Rigid, ..Default::default() };
        let rig = RigPriorEstimator::new(&to).prior(&to, &config);
        estimate(&camera(), observations, &to, &rig, &config, &mut Random::new(1)).unwrap()
    };
    let (shaped, independent) = (measure(Some(&unknown)), measure(None));
    let skew_mm = |found: &MotionEstimate| {
        let found = found.shutter.as_ref().unwrap();
        let prior_variance = prior.skew_sigma(&PoseRates::zeros())[0].powi(2);
        1e3 * (found.evidence[0] * prior_variance / (prior_variance + found.evidence_variance[0])).abs()
    };
    let (with, without) = (skew_mm(&shaped), skew_mm(&independent));
    assert!(with < 0.1 * without && with < 0.05, "{with} {without} mm");
    let ShapeEstimate { coefficients: found, shape } = shaped.shape.unwrap();
    assert!((found - coefficients).norm() < 0.005, "{found}");
    assert!(shape.covariance().trace() < 0.1 * unknown.covariance().trace());
    assert!((shaped.pose.x_m - to.x_m).abs() < 2e-4, "{:?}", shaped.pose);
    let elevation_m = unknown.at(seen[0].ground, &coefficients);
    let measured_m = shaped.elevations[0].elevation.mean_m;
    assert!((measured_m - elevation_m).abs() < 0.002, "{measured_m} {elevation_m} m");
}

/// Frames of a camera with this tilt that drives ahead, whose rig is said to be level; after a pass
/// that left this covariance of the tilt.
fn tilted_drive(tilt: [f64; 2], keyframes: u64, earlier: Option<&Matrix2<f64>>) -> RigPriorEstimator {
    let level = GroundPose::level(1.0);
    let mut estimator = RigPriorEstimator::new(&level);
    earlier.into_iter().for_each(|errors| estimator.set_earlier_mount_tilt_covariance(errors));
    let config = MotionConfig::default();
    for seed in 0..keyframes {
        // What a camera with a tilt sees of points that its keyframe, taken to be level, has
        // placed.
        let true_keyframe = GroundPose { roll_rad: tilt[0], pitch_rad: tilt[1], ..level };
        let moved = GroundPose { x_m: 0.25, y_m: 0.1, heading_rad: 0.1, ..true_keyframe };
        let placed = |seen: &Observation| {
            let ray = true_keyframe.ray_from_ground(seen.ground)?;
            Some(Observation { ground: level.ground_from_ray(ray)?, ..*seen })
        };
        let seen: Vec<Observation> =
            observations(&moved, 0.05, 0.0, seed).iter().filter_map(placed).collect();
        let prior = estimator.prior(&level, &config);
        let found = measured(&seen, &level, &prior, &config, seed).unwrap();
        estimator.learn(&found, &level, &Matrix6::zeros());
        estimator.change_keyframe();
    }
    estimator
}

#[test]
fn the_tilt_of_the_mount_is_as_uncertain_as_frames_and_keyframes_leave_it() {
    // Of a tilt of a quarter of a degree five keyframes leave an error as large as stated.
    let tilt = [0.004, -0.003];
    let estimator = tilted_drive(tilt, 5, None);
    let [_, roll_rad, pitch_rad] = estimator.mount();
    let errors = estimator.mount_tilt_errors();
    let off = nalgebra::Vector2::new(roll_rad - tilt[0], pitch_rad - tilt[1]);
    let squared = off.dot(&(errors.try_inverse().unwrap() * off));
    assert!(squared < 14.0, "off by {off:?}, stated {errors}");
    assert!(errors[(0, 0)].max(errors[(1, 1)]).sqrt() < 2e-3, "stated {errors}");
    // Before its first keyframe ends nothing is known.
    let nothing = RigPriorEstimator::new(&GroundPose::level(1.0)).mount_tilt_errors();
    assert_eq!(nothing, RigPriorEstimator::unknown_mount_tilt());
}

#[test]
fn frames_that_an_earlier_pass_saw_do_not_count_twice() {
    let tilt = [0.001, -0.001];
    let first = tilted_drive(tilt, 5, None).mount_tilt_errors();
    let trace = |errors: Matrix2<f64>| errors.trace();
    let again = |keyframes| trace(tilted_drive(tilt, keyframes, Some(&first)).mount_tilt_errors());
    // What the first pass left is known from the start, and by as many keyframes no better.
    assert!((again(0) / trace(first) - 1.0).abs() < 1e-9, "{} {first}", again(0));
    assert!(again(5) > 0.9 * trace(first), "{} {first}", again(5));
    assert!(again(40) < 0.5 * trace(first), "{} {first}", again(40));
}

#[test]
fn auto_is_rigid_on_a_steady_mount_and_opens_for_a_push() {
    let mount = GroundPose::level(1.0);
    let steady = GroundPose { x_m: 0.1, y_m: -0.05, heading_rad: 0.2, ..mount };
    let config = |model| MotionConfig { model, ..Default::default() };
    let mut estimator = RigPriorEstimator::new(&mount);
    for seed in 0..40 {
        let seen = observations(&steady, 0.2, 0.1, seed);
        let prior = estimator.prior(&mount, &config(MotionModel::Auto));
        let auto = measured(&seen, &mount, &prior, &config(MotionModel::Auto), seed).unwrap();
        let rigid = from(&seen, &mount, &config(MotionModel::Rigid), seed).unwrap();
        estimator.learn(&auto, &mount, &Matrix6::zeros());
        // The remaining freedom costs a fraction of the noise of the rigid model's position (0.3 mm
        // here).
        assert!((auto.pose.x_m - rigid.pose.x_m).abs() < 2e-4, "{:?} {:?}", auto.pose, rigid.pose);
        assert!(auto.pose.roll_rad.abs() < 5e-4 && (auto.pose.height_m - 1.0).abs() < 5e-4);
    }
    let pushed = GroundPose { roll_rad: 0.012, height_m: 1.006, ..steady };
    let seen = observations(&pushed, 0.2, 0.1, 99);
    let prior = estimator.prior(&mount, &config(MotionModel::Auto));
    let found = measured(&seen, &mount, &prior, &config(MotionModel::Auto), 1).unwrap();
    assert!(
        (found.pose.roll_rad - 0.012).abs() < 5e-4 && (found.pose.x_m - 0.1).abs() < 1e-3,
        "{:?}",
        found.pose
    );
}
