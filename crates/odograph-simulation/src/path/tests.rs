//! Paths are smooth, start at the world origin and end at the specified position.

use super::*;
use odograph::geometry::Ray;
use proptest::prelude::*;

fn shapes() -> Vec<PathKind> {
    vec![
        PathKind::Still { duration_s: 2.0 },
        PathKind::Straight { length_m: 3.0 },
        PathKind::SquareByTranslation { side_m: 1.0 },
        PathKind::SquareWithTurns { side_m: 1.0 },
        PathKind::Pivot { about: GroundPoint::new(0.4, 0.5), turn_rad: -TAU },
        PathKind::FigureEight { length_m: 3.0, laps: 2.0 },
        PathKind::Lanes { length_m: 2.0, spacing_m: 0.5, count: 4 },
        PathKind::RandomWalk { length_m: 8.0, seed: 3 },
        PathKind::RandomWithin { length_m: 12.0, radius_m: 10.0, seed: 3 },
    ]
}

fn numbers(pose: GroundPose) -> [f64; 3] {
    [pose.x_m, pose.y_m, pose.heading_rad]
}

#[test]
fn every_path_has_continuous_velocity_and_acceleration() {
    let rig = Rig::level(0.9);
    for kind in shapes() {
        for at_rest in [true, false] {
            let path = Path::new(kind, 0.5, 0.8, at_rest).unwrap();
            let step = 1e-3;
            let at = |i: usize| numbers(path.pose(i as f64 * step, &rig));
            let count = (path.duration_s() / step) as usize;
            let mut before: Option<[f64; 3]> = None;
            for i in 2..count - 1 {
                let (a, b, c) = (at(i - 1), at(i), at(i + 1));
                let acceleration: [f64; 3] =
                    std::array::from_fn(|k| (c[k] - 2.0 * b[k] + a[k]) / (step * step));
                // Jerk stays below 60 m/s³ (rad/s³); a jump of the velocity by 1 mm/s would make it
                // 1000.
                if let Some(before) = before {
                    for k in 0..3 {
                        let change = (acceleration[k] - before[k]).abs();
                        assert!(
                            change < 0.06,
                            "{kind:?}, at rest {at_rest}: {change} at {} s",
                            i as f64 * step
                        );
                    }
                }
                before = Some(acceleration);
            }
        }
    }
}

#[test]
fn every_path_starts_at_the_origin_along_x() {
    let rig = Rig { height_m: 0.7, roll_rad: 0.05, pitch_rad: -0.1, yaw_rad: 0.6, lever_arm: None };
    for kind in shapes() {
        let path = Path::new(kind, 0.5, 0.8, true).unwrap();
        let first = path.pose(0.0, &rig);
        for (value, wanted) in numbers(first).into_iter().zip(numbers(rig.first_pose())) {
            assert!((value - wanted).abs() < 1e-12, "{kind:?}");
        }
        assert_eq!((first.height_m, first.roll_rad, first.pitch_rad), (0.7, 0.05, -0.1));
    }
}

#[test]
fn closed_paths_close_and_have_the_configured_length() {
    let rig = Rig::level(1.0);
    let end = |kind| {
        let path = Path::new(kind, 0.5, 0.8, true).unwrap();
        (path.pose(path.duration_s(), &rig), path.length_m(), path.duration_s())
    };
    for kind in [
        PathKind::SquareByTranslation { side_m: 1.3 },
        PathKind::SquareWithTurns { side_m: 1.3 },
        PathKind::FigureEight { length_m: 4.0, laps: 1.0 },
    ] {
        let (pose, length_m, _) = end(kind);
        assert!(pose.x_m.hypot(pose.y_m) < 1e-9, "{kind:?}: {pose:?}");
        if !matches!(kind, PathKind::FigureEight { .. }) {
            assert!((length_m - 5.2).abs() < 1e-3, "{kind:?}: {length_m}");
        }
    }
    // Without turns the heading is constant; with turns the last corner completes a full turn; the
    // figure eight cancels its own.
    assert_eq!(end(PathKind::SquareByTranslation { side_m: 1.0 }).0.heading_rad, 0.0);
    assert!((end(PathKind::SquareWithTurns { side_m: 1.0 }).0.heading_rad - TAU).abs() < 1e-9);
    assert!(end(PathKind::FigureEight { length_m: 4.0, laps: 1.0 }).0.heading_rad.abs() < 1e-9);
    let (pose, length_m, duration_s) = end(PathKind::Straight { length_m: 3.0 });
    assert!((pose.x_m - 3.0).abs() < 1e-12 && (length_m - 3.0).abs() < 1e-9);
    // Each ramp of half a second adds a quarter of a second.
    assert!((duration_s - 6.5).abs() < 1e-12);
}

#[test]
fn lanes_are_parallel_with_the_configured_spacing() {
    let rig = Rig::level(1.0);
    let path =
        Path::new(PathKind::Lanes { length_m: 2.0, spacing_m: 0.5, count: 3 }, 0.5, 0.8, false).unwrap();
    let turn_s = (path.duration_s() - 3.0 * 4.0) / 2.0;
    for lane in 0..3 {
        let pose = path.pose(f64::from(lane) * (4.0 + turn_s) + 2.0, &rig);
        assert!((pose.y_m - 0.5 * f64::from(lane)).abs() < 1e-9, "lane {lane}: {pose:?}");
        assert!((pose.heading_rad.sin()).abs() < 1e-9);
    }
}

#[test]
fn a_path_at_full_speed_goes_on_beyond_its_ends() {
    let rig = Rig::level(0.9);
    for (at_rest, speed_m_s) in [(true, 0.0), (false, 0.5)] {
        let path = Path::new(PathKind::Straight { length_m: 2.0 }, 0.5, 0.8, at_rest).unwrap();
        for time_s in [-0.02, path.duration_s() + 0.01] {
            let rate = (path.pose(time_s + 0.01, &rig).x_m - path.pose(time_s, &rig).x_m) / 0.01;
            assert!((rate - speed_m_s).abs() < 1e-6, "{rate} at {time_s} s");
        }
    }
}

#[test]
fn the_pivot_point_stays_at_the_same_pixel() {
    let rig = Rig { height_m: 0.8, roll_rad: 0.03, pitch_rad: -0.06, yaw_rad: 0.5, lever_arm: None };
    let corner = Ray::new(-0.62, -0.47);
    let about = rig.first_pose().ground_from_ray(corner).unwrap();
    let path = Path::new(PathKind::Pivot { about, turn_rad: TAU }, 0.5, 0.8, true).unwrap();
    for i in 0..=50 {
        let pose = path.pose(path.duration_s() * f64::from(i) / 50.0, &rig);
        let seen = pose.ray_from_ground(about).unwrap();
        assert!((seen.x - corner.x).hypot(seen.y - corner.y) < 1e-12);
    }
    let end = path.pose(path.duration_s(), &rig);
    assert!((end.heading_rad - TAU).abs() < 1e-12);
}

#[test]
fn mount_yaw_rotates_the_path_and_not_the_first_image() {
    let path = Path::new(PathKind::Straight { length_m: 1.0 }, 0.5, 0.8, true).unwrap();
    // The top of the image points to the vehicle's left, so forward is to the image's right: world
    // −y.
    let end = path.pose(path.duration_s(), &Rig { yaw_rad: FRAC_PI_2, ..Rig::level(1.0) });
    assert!(end.x_m.abs() < 1e-12 && (end.y_m + 1.0).abs() < 1e-12 && end.heading_rad == 0.0);
}

#[test]
fn invalid_paths_are_rejected_by_name() {
    let refused = |kind, speed, rate| Path::new(kind, speed, rate, true).unwrap_err().to_string();
    assert!(refused(PathKind::Straight { length_m: -1.0 }, 0.5, 1.0).contains("length is -1"));
    assert!(refused(PathKind::Straight { length_m: 1.0 }, f64::NAN, 1.0).contains("speed is NaN"));
    assert!(refused(PathKind::Straight { length_m: 1e6 }, 0.1, 1.0).contains("a day"));
    assert!(
        refused(PathKind::RandomWithin { length_m: 1.0, radius_m: 0.1, seed: 1 }, 0.1, 1.0).contains("yard")
    );
    assert!(refused(PathKind::Lanes { length_m: 1.0, spacing_m: 1.0, count: 0 }, 0.1, 1.0).contains("lanes"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn a_random_walk_keeps_its_speed(seed in 0u64..1000, speed in 0.1..2.0f64) {
        let path = Path::new(PathKind::RandomWalk { length_m: 5.0, seed }, speed, 1.0, false).unwrap();
        let rig = Rig::level(1.0);
        for i in 0..20 {
            let time_s = path.duration_s() * (f64::from(i) + 0.5) / 21.0;
            let (a, b) = (path.pose(time_s, &rig), path.pose(time_s + 1e-4, &rig));
            let measured = (b.x_m - a.x_m).hypot(b.y_m - a.y_m) / 1e-4;
            prop_assert!((measured - speed).abs() < 1e-4 * speed, "{measured} for {speed}");
        }
    }

    #[test]
    fn a_random_walk_in_a_yard_stays_there(seed in 0u64..1000, radius_m in 10.0..20.0f64) {
        let kind = PathKind::RandomWithin { length_m: 150.0, radius_m, seed };
        let path = Path::new(kind, 1.0, 1.0, false).unwrap();
        let far = (0..300).map(|i| path.pose(0.5 * f64::from(i), &Rig::level(1.0))).map(|at| at.x_m.hypot(at.y_m));
        prop_assert!(far.fold(0.0, f64::max) < radius_m);
    }
}
