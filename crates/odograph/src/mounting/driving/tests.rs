use super::*;
use crate::camera::Distortion;
use crate::geometry::GroundPoint;
use crate::motion::Random;
use crate::motion::whitening;
use crate::odometry::{Odometry, OdometryConfig};
use crate::simulation::{
    Effects, Path as DrivenPath, PathKind, Simulation, SimulationConfig, SlowVariation, Texture, Vibration,
};

fn normal(random: &mut Random) -> f64 {
    (0..12).map(|_| random.below(1 << 20) as f64 / f64::from(1 << 20)).sum::<f64>() - 6.0
}

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap();
    Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), distortion).unwrap()
}

const RIG: Rig = Rig { height_m: 0.75, roll_rad: 0.06, pitch_rad: -0.05, yaw_rad: 0.0, lever_arm: None };

/// Keyframes with one pair each, of exact tracks with noise, which move and turn as `movement`
/// says.
fn collected(
    keyframes: usize,
    noise_px: f64,
    random: &mut Random,
    movement: impl Fn(usize, &mut Random) -> [f64; 3],
    shake_rad: f64,
) -> DrivenTilt {
    let camera = camera();
    let mut driven = DrivenTilt::new(&camera, DrivingConfig::default());
    driven.groups.clear();
    for index in 0..keyframes {
        let [x, y, turn] = movement(index, random);
        let mut shaken = |pose: GroundPose| GroundPose {
            roll_rad: pose.roll_rad + shake_rad * normal(random),
            pitch_rad: pose.pitch_rad + shake_rad * normal(random),
            ..pose
        };
        let first = shaken(RIG.first_pose());
        let second = shaken(GroundPose { x_m: x, y_m: y, heading_rad: turn, ..RIG.first_pose() });
        let mut tracks = Vec::new();
        while tracks.len() < 80 {
            let corner = Pixel::new(10.0 + random.below(620) as f64, 10.0 + random.below(460) as f64);
            let ground: GroundPoint = first.ground_from_ray(camera.ray_from_pixel(corner).unwrap()).unwrap();
            let seen = second.ray_from_ground(ground).and_then(|ray| camera.pixel_from_ray(ray)).unwrap();
            let wrong = tracks.len().is_multiple_of(10);
            let noise = if wrong { 4.0 } else { noise_px };
            let seen = Pixel::new(seen.x + noise * normal(random), seen.y + noise * normal(random));
            tracks.push(track(corner, seen, !wrong));
        }
        driven.groups.push(Group { pairs: vec![ViewPair { tracks, exposure: None }] });
    }
    driven
}

fn track(first: Pixel, second: Pixel, agrees: bool) -> PairedTrack {
    PairedTrack { first, second, agrees, whitening: Matrix2::identity() }
}

/// Forward, with turns to both sides.
fn turning(index: usize, random: &mut Random) -> [f64; 3] {
    [0.2, 0.02 * normal(random), if index.is_multiple_of(2) { 0.15 } else { -0.1 }]
}

#[test]
fn a_rolling_shutter_is_not_taken_for_a_tilt() {
    // From standstill to driving straight ahead: within one pair skew looks like a tilt.
    let (readout_s, mut random) = (0.020, Random::new(9));
    let camera = camera().with_readout_s(Some(readout_s)).unwrap();
    let mut driven = DrivenTilt::new(&camera, DrivingConfig::default());
    driven.groups.clear();
    let speed = |x_m: f64| (2.0 * 0.6 * x_m).sqrt().min(0.5);
    for keyframe in 0..8 {
        let at = |x_m: f64| {
            let pose = GroundPose { x_m, ..RIG.first_pose() };
            let rates = PoseRates::new(speed(x_m), 0.0, 0.05, 0.0, 0.0, 0.0);
            (pose, rates)
        };
        let view = |x_m: f64, y: f64| {
            let (pose, rates) = at(x_m);
            GroundPose::from_vector(&(pose.to_vector() + readout_s * ((y + 0.5) / 480.0 - 0.5) * rates))
        };
        let (from, mut pairs) = (0.35 * keyframe as f64, Vec::new());
        for step in 1..=3 {
            let to = from + 0.1 * f64::from(step);
            let mut tracks = Vec::new();
            while tracks.len() < 80 {
                let corner = Pixel::new(10.0 + random.below(620) as f64, 10.0 + random.below(460) as f64);
                let ray = camera.ray_from_pixel(corner).unwrap();
                let ground = view(from, corner.y).ground_from_ray(ray).unwrap();
                // The row in which a point is seen and the pose at that row depend on each other.
                let mut seen = corner;
                for _ in 0..20 {
                    let ray = view(to, seen.y).ray_from_ground(ground).unwrap();
                    seen = camera.pixel_from_ray(ray).unwrap();
                }
                let noise = 0.05 * normal(&mut random);
                let seen = Pixel::new(seen.x + noise, seen.y + 0.05 * normal(&mut random));
                tracks.push(track(corner, seen, true));
            }
            let moving = |x_m: f64| {
                let (pose, rates) = at(x_m);
                Moving { pose: pose.to_vector(), rates, accelerations: PoseRates::zeros() }
            };
            pairs.push(ViewPair { tracks, exposure: Some(PairExposure::new(&moving(from), &moving(to))) });
        }
        driven.groups.push(Group { pairs });
    }
    let found = driven.self_calibration(&Rig::level(1.0), None).unwrap().tilt;
    assert!(off(&found).norm() < 2e-3, "{found:?}");
}

fn off(found: &TiltMeasurement) -> nalgebra::Vector2<f64> {
    nalgebra::Vector2::new(found.roll_rad - RIG.roll_rad, found.pitch_rad - RIG.pitch_rad)
}

#[test]
fn exact_tracks_give_the_exact_tilt_from_far_off() {
    let mut random = Random::new(1);
    let driven = collected(10, 0.0, &mut random, turning, 0.0);
    for (roll_rad, pitch_rad) in [(0.0, 0.0), (-0.12, 0.12), (0.2, -0.2)] {
        let found = driven.solve(&Rig { roll_rad, pitch_rad, ..Rig::level(1.0) }, None).unwrap();
        // Outliers are separated only down to the lower bound of the noise.
        assert!(off(&found).norm() < 1e-4, "{found:?}");
        assert_eq!(found.observability, Observability::Full);
    }
}

#[test]
fn the_stated_covariance_is_true_also_on_a_mount_that_shakes() {
    for shake_rad in [0.0, 0.004] {
        let trials = 40;
        let mut nees = 0.0;
        let mut random = Random::new(2);
        for _ in 0..trials {
            let driven = collected(25, 0.1, &mut random, turning, shake_rad);
            let found = driven.solve(&Rig::level(1.0), None).unwrap();
            let off = off(&found);
            nees += off.dot(&(found.covariance.try_inverse().unwrap() * off)) / f64::from(trials);
        }
        // 80 squares: 1.43 to 2.67 in 95 of 100 cases; robust weights and an estimated scatter
        // widen that.
        assert!((1.2..3.0).contains(&nees), "shaking by {shake_rad}: {nees}");
    }
}

#[test]
fn tracks_on_straight_edges_count_across_them_only() {
    // Two of three tracks lie on joints along the image's columns, and slide along them towards the
    // middle of the image, as a shadow that stands still there makes them do.
    let mut driven = collected(20, 0.05, &mut Random::new(5), turning, 0.0);
    let (across_px, along_px) = (0.05f64, 5.0f64);
    let on_edge = Matrix2::from_diagonal(&nalgebra::Vector2::new(across_px.powi(2), along_px.powi(2)));
    let mut slid = driven.clone();
    for (driven, slid) in driven.groups.iter_mut().zip(&mut slid.groups) {
        let tracks = driven.pairs.iter_mut().flat_map(|pair| &mut pair.tracks);
        let slid = slid.pairs.iter_mut().flat_map(|pair| &mut pair.tracks);
        for (index, (track, slid)) in tracks.zip(slid).enumerate().filter(|(index, _)| index % 3 != 0) {
            track.second.y += 0.01 * (240.0 - track.second.y);
            slid.second = track.second;
            track.whitening = whitening(&on_edge, across_px.powi(2));
            assert!((track.coordinates() - 1.0).abs() < 1e-3, "{index}");
        }
    }
    let (weighted, plain) =
        [&driven, &slid].map(|driven| driven.solve(&Rig::level(1.0), None).unwrap()).into();
    let information = weighted.covariance.try_inverse().unwrap();
    let nees = off(&weighted).dot(&(information * off(&weighted)));
    assert!(nees < 16.0, "{weighted:?}");
    assert!(off(&plain).norm() > 10.0 * off(&weighted).norm(), "{plain:?}");
}

#[test]
fn an_error_of_the_principal_point_is_one_of_the_tilt() {
    let driven = collected(20, 0.1, &mut Random::new(4), turning, 0.0);
    let names = vec!["cx".to_owned(), "cy".to_owned()];
    let uncertainty =
        CameraUncertainty::new(names, nalgebra::DMatrix::from_diagonal_element(2, 2, 25.0)).unwrap();
    let without = driven.solve(&Rig::level(1.0), None).unwrap();
    let with = driven.solve(&Rig::level(1.0), Some(&uncertainty)).unwrap();
    assert_eq!((with.roll_rad, with.pitch_rad), (without.roll_rad, without.pitch_rad));
    // Five pixels of 500 are 0.57°; how much of that enters the tilt depends on the motion.
    let deviation = with.covariance.trace().sqrt().to_degrees();
    assert!((0.05..2.0).contains(&deviation), "{with:?}");
}

#[test]
fn what_a_movement_does_not_reveal_is_said() {
    let mut random = Random::new(3);
    // Standing still, to a tenth of a pixel.
    let still = collected(12, 0.1, &mut random, |_, _| [0.0, 0.0, 0.0], 0.0).solve(&Rig::level(1.0), None);
    match still {
        Err(error) => assert!(error.to_string().contains("too little motion"), "{error}"),
        Ok(found) => assert!(matches!(found.observability, Observability::Partial { .. }), "{found:?}"),
    }
    // Short translations have little information, long ones much; so has a turn on the spot by half
    // a radian.
    let deviation = |movement: [f64; 3], random: &mut Random| {
        let found = collected(12, 0.1, random, |_, _| movement, 0.0).solve(&Rig::level(1.0), None).unwrap();
        found.covariance.trace().sqrt()
    };
    let short = deviation([0.02, 0.0, 0.0], &mut random);
    let long = deviation([0.3, 0.0, 0.0], &mut random);
    let turn = deviation([0.02, 0.0, 0.5], &mut random);
    assert!(long < 0.1 * short && turn < 0.2 * short, "{short} {long} {turn}");
    assert!(DrivenTilt::new(&camera(), DrivingConfig::default()).solve(&Rig::level(1.0), None).is_err());
}

/// A rendered drive of five metres in two loops, seen a few times a second.
fn drive(rig: Rig, effects: Effects, path: PathKind) -> Simulation {
    Simulation::new(SimulationConfig {
        camera: Camera::new((320, 240), (250.0, 250.0), (160.3, 119.0), Distortion::None).unwrap(),
        rig,
        texture: Texture::named("asphalt").unwrap(),
        path: DrivenPath::new(path, 0.6, 1.0, false).unwrap(),
        effects: Effects { noise_gray: 2.0, ..effects },
        fps: 12.0,
        duration_s: None,
        colored: false,
        seed: 5,
    })
    .unwrap()
}

/// Tracks a drive repeatedly: from `start`, and from the estimate before.
fn measured(simulation: &Simulation, start: Rig, passes: usize) -> (TiltMeasurement, f64) {
    let camera = &simulation.config().camera;
    let mut rig = start;
    let mut last = None;
    for _ in 0..passes {
        let mut odometry = Odometry::new(camera.clone(), rig, OdometryConfig::default()).unwrap();
        let mut driven = DrivenTilt::new(camera, DrivingConfig::default());
        for frame in simulation.frames() {
            let estimate = odometry.process(frame.image, frame.time_s).unwrap();
            driven.watch(&estimate, &odometry);
        }
        let found = driven.solve(&rig, None).unwrap();
        rig = Rig { roll_rad: found.roll_rad, pitch_rad: found.pitch_rad, ..rig };
        last = Some((found, driven.path_length_m().unwrap().0));
    }
    last.unwrap()
}

const EIGHT: PathKind = PathKind::FigureEight { length_m: 1.7, laps: 1.0 };

#[test]
fn a_rendered_drive_gives_the_tilt_from_five_degrees_off() {
    let simulation = drive(RIG, Effects::default(), EIGHT);
    let start = Rig { roll_rad: RIG.roll_rad - 0.062, pitch_rad: RIG.pitch_rad + 0.062, ..RIG };
    let (found, length_m) = measured(&simulation, start, 2);
    assert!(off(&found).norm() < 0.05f64.to_radians(), "{found:?}");
    assert_eq!(found.observability, Observability::Full);
    // The given height is right, so the length is, to the per mille asked of the height.
    let seen: Vec<GroundPose> = simulation.times_s().iter().map(|&time_s| simulation.truth(time_s)).collect();
    let truth_m: f64 = seen.windows(2).map(|two| two[0].distance_m(&two[1])).sum();
    assert!((length_m / truth_m - 1.0).abs() < 2e-3, "{length_m} {truth_m}");
}

#[test]
fn a_shaking_mount_gives_its_mean_tilt_and_a_wider_deviation() {
    // One drive alone is a matter of which phase of the vibration its keyframes meet: between 0.5
    // and 4.1 stated deviations here. The mean over drives is 2.2 where 1 would be right.
    let squares = [3.0, 4.0, 5.0, 6.0, 7.0, 9.0].map(|frequency_hz| {
        let vibration = Vibration { shift_m: 0.001, turn_rad: 0.004, frequency_hz };
        let effects = Effects { vibration: Some(vibration), ..Effects::default() };
        let (found, _) = measured(&drive(RIG, effects, EIGHT), Rig::level(RIG.height_m), 1);
        let variance = found.covariance.trace();
        assert!(variance.sqrt() < 0.2f64.to_radians(), "{found:?}");
        off(&found).norm_squared() / variance
    });
    let root_mean_square = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    assert!(root_mean_square < 2.5, "{root_mean_square}: {squares:?}");
}

/// What [`CalibrationMonitor`] finds in a drive if the rig `given` is used, and after which frame.
fn noticed(
    simulation: &Simulation,
    given: Rig,
    mut monitor: CalibrationMonitor,
) -> Option<(CalibrationUpdate, u64)> {
    let camera = simulation.config().camera.clone();
    let mut odometry = Odometry::new(camera, given, OdometryConfig::default()).unwrap();
    let on_the_way = simulation.frames().find_map(|frame| {
        let estimate = odometry.process(frame.image, frame.time_s).unwrap();
        Some((monitor.watch(&estimate, &odometry)?, estimate.frame))
    });
    on_the_way.or_else(|| Some((monitor.at_end()?, simulation.times_s().len() as u64)))
}

#[test]
fn an_unknown_tilt_is_detected_early_and_refined_later() {
    let simulation = drive(RIG, Effects::default(), EIGHT);
    let camera = &simulation.config().camera;
    let level = Rig { roll_rad: 0.0, pitch_rad: 0.0, ..RIG };
    let (first, at) = noticed(&simulation, level, CalibrationMonitor::new(camera, &level)).unwrap();
    // Within a third of the drive; the standard deviation is as stated. The lens is as given.
    assert!(3 * at < simulation.times_s().len() as u64, "{at}");
    assert_eq!(first.lens, None);
    let tilt = first.tilt.clone().unwrap();
    let deviation = tilt.covariance.trace().sqrt();
    assert!(deviation < 0.05f64.to_radians() && off(&tilt).norm() < 4.0 * deviation, "{first:?}");
    // A tilt with a stated deviation of a fifth of a degree is replaced by that of the whole drive.
    let poor = TiltMeasurement {
        roll_rad: tilt.roll_rad + 0.003,
        covariance: Matrix2::identity() * 0.003f64.powi(2),
        ..tilt
    };
    let earlier = CalibrationUpdate { tilt: Some(poor.clone()), ..first.clone() };
    let taken = earlier.rig(&level);
    let (second, later) =
        noticed(&simulation, taken, CalibrationMonitor::with_estimate(camera, &level, &earlier)).unwrap();
    let tilt = second.tilt.unwrap();
    assert!(later > at && off(&tilt).norm() < 0.05f64.to_radians(), "{tilt:?}");
    assert!(second.pairs >= 2 * first.pairs && tilt.covariance.trace() < poor.covariance.trace());
}

#[test]
fn an_estimate_that_more_of_the_drive_does_not_bear_out_is_withdrawn() {
    let simulation = drive(RIG, Effects::default(), EIGHT);
    let camera = &simulation.config().camera;
    let (tilt, _) = measured(&simulation, RIG, 1);
    let wrong = TiltMeasurement { roll_rad: RIG.roll_rad + 0.03, ..tilt };
    let in_use = CalibrationUpdate { tilt: Some(wrong), pairs: 8, ..CalibrationUpdate::default() };
    let (found, _) =
        noticed(&simulation, in_use.rig(&RIG), CalibrationMonitor::with_estimate(camera, &RIG, &in_use))
            .unwrap();
    assert!(found.is_nothing() && found.pairs > in_use.pairs, "{found:?}");
    // Applied to what was given, it is what was given.
    assert_eq!(found.rig(&RIG), RIG);
}

/// What is found if the drive is rendered with one camera and tracked with another.
fn through_lens(camera: &Camera, given: &Camera, rig: Rig, effects: Effects) -> Option<CalibrationUpdate> {
    let config = SimulationConfig { camera: camera.clone(), ..drive(RIG, effects, EIGHT).config().clone() };
    let simulation = Simulation::new(config).unwrap();
    let mut odometry = Odometry::new(given.clone(), rig, OdometryConfig::default()).unwrap();
    let mut monitor = CalibrationMonitor::new(given, &rig);
    simulation.frames().find_map(|frame| {
        let estimate = odometry.process(frame.image, frame.time_s).unwrap();
        monitor.watch(&estimate, &odometry)
    })
}

fn barrel(coefficients: &[f64]) -> Camera {
    let distortion = Distortion::from_opencv(coefficients).unwrap();
    Camera::new((320, 240), (250.0, 250.0), (160.3, 119.0), distortion).unwrap()
}

const LENS: [f64; 4] = [-0.12, 0.02, 0.0, 0.0];

#[test]
fn a_wrong_lens_is_found_beside_the_tilt_even_while_the_camera_sways() {
    let level = Rig { roll_rad: 0.0, pitch_rad: 0.0, ..RIG };
    let sway =
        Effects { tilt_change: Some(SlowVariation { amplitude: 0.03, period_s: 2.0 }), ..Effects::default() };
    for (given, rig, effects) in [
        (vec![], RIG, Effects::default()),
        (vec![-0.1, 0.02, 0.0, 0.0], level, Effects::default()),
        (vec![-0.08, 0.0, 0.0, 0.0], RIG, sway),
    ] {
        let found = through_lens(&barrel(&LENS), &barrel(&given), rig, effects).unwrap();
        let lens = found.lens.unwrap();
        // At the edge of the image, where nothing is tracked; the given lens was off by 2 to 10
        // pixels.
        let off_px = lens.off_from_px(&barrel(&LENS));
        assert!(off_px < f64::min(0.5, 5.0 * lens.deviation_px + 0.05), "{off_px} {lens:?}");
        assert!(lens.off_px > 1.0 && lens.is_significant());
        if let Some(tilt) = found.tilt {
            assert!(off(&tilt).norm() < 0.1f64.to_radians(), "{tilt:?}");
        }
    }
}

#[test]
fn a_careless_calibration_is_corrected_even_where_the_path_is_straight() {
    let given = {
        let distortion = Distortion::from_opencv(&[-0.11, 0.02, 0.002, -0.002]).unwrap();
        Camera::new((320, 240), (250.0, 250.0), (156.3, 122.0), distortion).unwrap()
    };
    let ahead = PathKind::Straight { length_m: 4.0 };
    let config =
        SimulationConfig { camera: barrel(&LENS), ..drive(RIG, Effects::default(), ahead).config().clone() };
    let simulation = Simulation::new(config).unwrap();
    let followed = |camera: &Camera, rig: Rig| {
        let mut odometry = Odometry::new(camera.clone(), rig, OdometryConfig::default()).unwrap();
        let mut monitor = CalibrationMonitor::new(camera, &rig);
        let (mut last, mut found) = (None, None);
        for frame in simulation.frames() {
            let estimate = odometry.process(frame.image, frame.time_s).unwrap();
            found = found.or_else(|| monitor.watch(&estimate, &odometry));
            last = estimate.estimate.map(|estimate| estimate.pose);
        }
        (last.unwrap(), found)
    };
    let truth = simulation.frames().last().unwrap().truth;
    let off_m = |pose: &GroundPose| (pose.x_m - truth.x_m).hypot(pose.y_m - truth.y_m);
    let (before, found) = followed(&given, RIG);
    let found = found.unwrap();
    assert!(found.lens.is_some(), "{found:?}");
    let (after, _) = followed(&found.camera(&given), found.rig(&RIG));
    // A straight path shows tilt, principal point and decentering together, not one by one; that is
    // enough for the path. The first metre, which this estimate is of, leaves a part.
    assert!(off_m(&before) > 0.05 && off_m(&after) < 0.02, "{} {}", off_m(&before), off_m(&after));
}

#[test]
fn the_principal_point_of_a_wide_lens_is_found_with_its_bending() {
    let fisheye = |center_px: (f64, f64), k1: f64| {
        let distortion = Distortion::KannalaBrandt { k1, k2: 0.003, k3: 0.0, k4: 0.0 };
        Camera::new((320, 240), (150.0, 150.0), center_px, distortion).unwrap()
    };
    let truth = fisheye((161.0, 119.0), -0.01);
    let found = through_lens(&truth, &fisheye((159.0, 120.0), 0.02), RIG, Effects::default()).unwrap();
    let lens = found.lens.unwrap();
    assert_eq!(lens.coefficients.len(), 5);
    // At the corner, of which the first check has seen little; the given lens was off by 10 pixels.
    // The principal point by 2.
    let off_px = lens.off_from_px(&truth);
    assert!(lens.off_px > 5.0 && off_px < 1.0, "{off_px} {lens:?}");
    let ((x, y), (true_x, true_y)) = (lens.camera.principal_px(), truth.principal_px());
    assert!((x - true_x).hypot(y - true_y) < 0.3, "{x} {y}");
}

#[test]
fn a_right_lens_is_kept_even_while_the_camera_sways() {
    let sway =
        Effects { tilt_change: Some(SlowVariation { amplitude: 0.05, period_s: 2.0 }), ..Effects::default() };
    assert_eq!(through_lens(&barrel(&LENS), &barrel(&LENS), RIG, sway), None);
    assert_eq!(through_lens(&barrel(&LENS), &barrel(&LENS), RIG, Effects::default()), None);
}

#[test]
fn a_right_or_changing_tilt_is_kept() {
    let steady = drive(RIG, Effects::default(), EIGHT);
    let camera = &steady.config().camera;
    assert_eq!(noticed(&steady, RIG, CalibrationMonitor::new(camera, &RIG)), None);
    let swaying =
        Effects { tilt_change: Some(SlowVariation { amplitude: 0.05, period_s: 2.0 }), ..Effects::default() };
    let swaying = drive(RIG, swaying, EIGHT);
    assert_eq!(noticed(&swaying, RIG, CalibrationMonitor::new(camera, &RIG)), None);
}

#[test]
fn a_live_run_is_recalibrated_and_its_covariance_covers_what_was_before() {
    let simulation = drive(RIG, Effects::default(), PathKind::Straight { length_m: 6.0 });
    let camera = &simulation.config().camera;
    let level = Rig { roll_rad: 0.0, pitch_rad: 0.0, ..RIG };
    let mut odometry = Odometry::new(camera.clone(), level, OdometryConfig::default()).unwrap();
    let mut calibration = OnlineCalibration::new(camera, &level, false);
    let mut since = None;
    for frame in simulation.frames() {
        let estimate = odometry.process(frame.image.clone(), frame.time_s).unwrap();
        let is_recalibrated = calibration.watch(&frame.image, &estimate, &mut odometry).unwrap();
        let known = estimate.estimate.expect("tracked");
        let (pose, truth) = (known.pose, frame.truth);
        if is_recalibrated && since.is_none() {
            since = Some((pose, truth));
            continue;
        }
        let Some((first, truth_first)) = since else { continue };
        // The part before is bent, by 6 % at this tilt, and the stated deviation says so.
        let off_m = (pose.x_m - truth.x_m).hypot(pose.y_m - truth.y_m);
        let deviation_m = (known.covariance[(0, 0)] + known.covariance[(1, 1)]).sqrt();
        assert!(off_m < 3.0 * deviation_m, "{off_m} m ± {deviation_m} m");
        // From there on lengths are right. Measured: 0.04 % of them.
        let length_m = (pose.x_m - first.x_m).hypot(pose.y_m - first.y_m);
        let true_m = (truth.x_m - truth_first.x_m).hypot(truth.y_m - truth_first.y_m);
        assert!((length_m - true_m).abs() < 0.002 * true_m.max(0.5), "{length_m} m of {true_m} m");
    }
    let tilt = calibration.found().and_then(|found| found.tilt.clone()).expect("found");
    assert!(off(&tilt).norm() < 0.05f64.to_radians(), "{tilt:?}");
}

#[test]
fn a_calibration_of_another_size_is_refused() {
    let camera = barrel(&LENS);
    let mut odometry = Odometry::new(camera, RIG, OdometryConfig::default()).unwrap();
    let other = Camera::new((64, 48), (50.0, 50.0), (31.5, 23.5), Distortion::from_opencv(&[]).unwrap());
    let error = odometry.recalibrate(other.unwrap(), None).unwrap_err();
    assert!(error.to_string().contains("64x48"), "{error}");
}
