use super::*;
use crate::geometry::GroundPose;
use crate::trajectory::StampedPose;
use nalgebra::{Isometry3, Matrix4, Translation3, UnitQuaternion, Vector3};
use proptest::prelude::*;

fn trajectory(poses: impl IntoIterator<Item = Isometry3<f64>>) -> Trajectory {
    let stamp = |(index, world_from_camera)| StampedPose { time_s: index as f64 * 0.1, world_from_camera };
    Trajectory { poses: poses.into_iter().enumerate().map(stamp).collect() }
}

/// A camera at 1 m height that moves forward by `step_m` and turns by `turn_rad` per frame.
fn drive(frames: usize, step_m: f64, turn_rad: f64) -> Trajectory {
    let mut pose = GroundPose::level(1.0);
    trajectory((0..frames).map(|_| {
        let here = pose.world_from_camera();
        pose.x_m += step_m * pose.heading_rad.cos();
        pose.y_m += step_m * pose.heading_rad.sin();
        pose.heading_rad += turn_rad;
        here
    }))
}

fn moved(trajectory: &Trajectory, by: &Isometry3<f64>, scale: f64) -> Trajectory {
    let mut moved = trajectory.clone();
    for pose in &mut moved.poses {
        pose.world_from_camera.translation.vector *= scale;
        pose.world_from_camera = by * pose.world_from_camera;
    }
    moved
}

fn with(alignment: Alignment) -> EvaluationOptions {
    EvaluationOptions { alignment, ..EvaluationOptions::default() }
}

#[test]
fn statistics_agree_with_numpy() {
    let s = Statistics::of(&[3.0, 1.0, 2.0, 10.0]).unwrap();
    assert_eq!((s.count, s.mean, s.median, s.min, s.max, s.sse), (4, 4.0, 2.5, 1.0, 10.0, 114.0));
    assert!((s.rmse - 28.5f64.sqrt()).abs() < 1e-15 && (s.std - 12.5f64.sqrt()).abs() < 1e-15);
    assert!(Statistics::of(&[]).is_none());
}

#[test]
fn an_alignment_by_scale_leaves_the_stated_length() {
    let truth = drive(101, 0.1, 0.01);
    let long = moved(&truth, &Isometry3::translation(1.0, 2.0, 0.0), 1.02);
    for alignment in [Alignment::None, Alignment::Se3, Alignment::Sim3] {
        let e = evaluate(&long, &truth, &with(alignment)).unwrap();
        assert!((e.truth_length_m - 10.0).abs() < 1e-9, "{alignment}: {}", e.truth_length_m);
        assert!((e.estimate_length_m - 10.2).abs() < 1e-9, "{alignment}: {}", e.estimate_length_m);
    }
}

#[test]
fn a_known_error_is_measured() {
    // A scale error of 2 %, and a heading drift of 0.1° per metre at 10 cm per frame.
    let truth = drive(101, 0.1, 0.0);
    let long = drive(101, 0.102, 0.0);
    let e = evaluate(&long, &truth, &with(Alignment::None)).unwrap();
    assert!(
        (e.absolute.translation.max - 0.2).abs() < 1e-12 && (e.absolute.translation.mean - 0.1).abs() < 1e-12
    );
    assert!((e.drift[0].translation_percent - 2.0).abs() < 1e-9, "{:?}", e.drift);
    assert!((e.scale.unwrap() - 1.0 / 1.02).abs() < 1e-12);
    assert!((e.final_position_error_m - 0.2).abs() < 1e-12);
    assert!((e.relative[0].translation.rmse - 0.002).abs() < 1e-12);

    let turning = drive(101, 0.1, 0.01f64.to_radians());
    let e = evaluate(&turning, &truth, &with(Alignment::None)).unwrap();
    assert!((e.drift[0].heading_deg_per_m - 0.1).abs() < 1e-9);
    assert!((e.drift[0].heading_bias_deg_per_m - 0.1).abs() < 1e-9);
    assert!((e.drift[0].rotation_deg_per_m - 0.1).abs() < 1e-9);
    assert!((e.final_heading_error_rad.to_degrees() - 1.0).abs() < 1e-9);
    assert_eq!(e.drift.iter().map(|d| d.length_m).collect::<Vec<_>>(), [1.0, 10.0][..e.drift.len()]);
}

#[test]
fn poses_pair_with_the_nearest_in_time() {
    let at =
        |time_s: f64| StampedPose { time_s, world_from_camera: Isometry3::translation(time_s, 0.0, 0.0) };
    // Exact tie: true poses 1/128 s before and after the estimated one.
    let (before, after) = (0.125 - 1.0 / 128.0, 0.125 + 1.0 / 128.0);
    let estimate = Trajectory { poses: [0.004, 0.125, 0.25].map(at).to_vec() };
    let truth = Trajectory { poses: [0.0, 0.05, before, after, 0.2, 0.3].map(at).to_vec() };
    let times = |pairs: Vec<PosePair>| pairs.iter().map(|p| (p.time_s, p.truth_time_s)).collect::<Vec<_>>();
    assert_eq!(times(associate(&estimate, &truth, 0.01).unwrap()), [(0.004, 0.0), (0.125, before)]);
    let few = Trajectory { poses: [before, 0.3].map(at).to_vec() };
    assert_eq!(times(associate(&estimate, &few, 0.01).unwrap()), [(0.125, before)]);
    let error = associate(&estimate, &trajectory_from(1000.0), 0.01).unwrap_err().to_string();
    assert!(error.contains("no pose of the estimate") && error.contains("1000.000 s"), "{error}");
    assert!(error.ends_with("of clocks that count from another moment"), "{error}");
    assert!(associate(&estimate, &truth, f64::NAN).is_err() && associate(&estimate, &truth, -1.0).is_err());
    let back = Trajectory { poses: vec![at(1.0), at(0.5)] };
    assert!(associate(&back, &truth, 0.01).unwrap_err().to_string().contains("do not increase"));
    let broken = Trajectory { poses: vec![at(f64::NAN)] };
    assert!(associate(&truth, &broken, 0.01).unwrap_err().to_string().contains("not finite"));
    let far = trajectory([Isometry3::translation(1e200, 0.0, 0.0)]);
    assert!(associate(&truth, &far, 0.01).unwrap_err().to_string().contains("too far"));
}

fn trajectory_from(start_s: f64) -> Trajectory {
    let mut shifted = drive(3, 0.1, 0.0);
    shifted.poses.iter_mut().for_each(|pose| pose.time_s += start_s);
    shifted
}

fn all_numbers_are_finite(e: &Evaluation) -> bool {
    let of =
        |s: &Statistics| [s.rmse, s.mean, s.median, s.std, s.min, s.max, s.sse].iter().all(|v| v.is_finite());
    of(&e.absolute.translation)
        && of(&e.absolute.rotation)
        && e.relative.iter().all(|r| of(&r.translation) && of(&r.rotation))
        && e.drift
            .iter()
            .all(|d| (d.translation_percent + d.rotation_deg_per_m + d.heading_bias_deg_per_m).is_finite())
        && e.final_heading_error_rad.is_finite()
        && e.final_position_error_m.is_finite()
        && e.scale.is_none_or(f64::is_finite)
        && e.time_covered.is_none_or(f64::is_finite)
}

#[test]
fn degenerate_paths_have_finite_errors() {
    let still = drive(10, 0.0, 0.0);
    let straight = drive(50, 0.1, 0.0);
    let turned = Isometry3::new(Vector3::new(3.0, -2.0, 1.0), Vector3::new(0.4, 0.5, -2.0));
    for truth in [&drive(1, 0.0, 0.0), &still, &straight] {
        for estimate in [drive(1, 0.0, 0.0), still.clone(), straight.clone(), moved(&straight, &turned, 1.0)]
        {
            for alignment in
                [Alignment::None, Alignment::Origin, Alignment::Se2, Alignment::Se3, Alignment::Sim3]
            {
                match evaluate(&estimate, truth, &with(alignment)) {
                    Ok(e) => assert!(all_numbers_are_finite(&e), "{alignment}: {e:?}"),
                    Err(error) => {
                        assert!(
                            alignment == Alignment::Sim3
                                && error.to_string().contains("do not determine a scale")
                        );
                    }
                }
            }
        }
    }
    // On a straight path the rotation about the path is free; the first orientations determine it.
    let e = evaluate(&moved(&straight, &turned, 1.0), &straight, &with(Alignment::Se3)).unwrap();
    assert!(!e.alignment.rotation_determined && e.absolute.translation.max < 1e-12);
    assert!(e.absolute.rotation.max < 1e-7);
    let e = evaluate(&still, &still, &with(Alignment::Se3)).unwrap();
    assert!(e.scale.is_none() && e.drift.is_empty() && e.relative.len() == 1);
    assert!((e.alignment.truth_from_estimate.to_homogeneous() - Matrix4::identity()).amax() < 1e-12);
}

#[test]
fn invalid_options_are_rejected() {
    let t = drive(10, 0.1, 0.0);
    for options in [
        EvaluationOptions { deltas: vec![Delta::Frames(0)], ..Default::default() },
        EvaluationOptions { deltas: vec![Delta::Metres(f64::NAN)], ..Default::default() },
        EvaluationOptions { segment_lengths_m: vec![-1.0], ..Default::default() },
    ] {
        assert!(evaluate(&t, &t, &options).is_err());
    }
}

prop_compose! {
    fn isometries()(t in prop::array::uniform3(-50.0..50.0f64), r in prop::array::uniform3(-1.8..1.8f64)) -> Isometry3<f64> {
        Isometry3::new(Vector3::from(t), Vector3::from(r))
    }
}

prop_compose! {
    fn trajectories()(poses in prop::collection::vec(isometries(), 4..40)) -> Trajectory { trajectory(poses) }
}

proptest! {
    #[test]
    fn alignment_recovers_any_movement(truth in trajectories(), by in isometries(), scale in 0.1..10.0f64) {
        let estimate = moved(&truth, &by.inverse(), 1.0);
        let e = evaluate(&estimate, &truth, &with(Alignment::Se3)).unwrap();
        prop_assert!(e.absolute.translation.max < 1e-9 && e.absolute.rotation.max < 1e-6);
        let off = e.alignment.truth_from_estimate.inverse() * by;
        prop_assert!(off.translation.vector.norm() < 1e-8);
        let scaled = moved(&truth, &by, scale);
        let e = evaluate(&scaled, &truth, &with(Alignment::Sim3)).unwrap();
        prop_assert!(e.absolute.translation.max < 1e-9);
        prop_assert!((e.alignment.scale * scale - 1.0).abs() < 1e-12);
        prop_assert_eq!(e.scale, Some(e.alignment.scale));
    }

    #[test]
    fn a_plane_movement_is_recovered_by_se2(truth in trajectories(), x in -9.0..9.0f64, y in -9.0..9.0f64, a in -3.1..3.1f64) {
        let by = Isometry3::from_parts(Translation3::new(x, y, 0.0), UnitQuaternion::from_axis_angle(&Vector3::z_axis(), a));
        let e = evaluate(&moved(&truth, &by, 1.0), &truth, &with(Alignment::Se2)).unwrap();
        prop_assert!(e.absolute.translation.max < 1e-9);
        let lifted = Isometry3::translation(0.0, 0.0, 2.0);
        let e = evaluate(&moved(&truth, &lifted, 1.0), &truth, &with(Alignment::Se2)).unwrap();
        prop_assert!((e.absolute.translation.min - 2.0).abs() < 1e-9);
    }

    #[test]
    fn alignment_is_the_least_squares(truth in trajectories(), noise in trajectories(), small in isometries()) {
        let mut estimate = truth.clone();
        for (pose, noise) in estimate.poses.iter_mut().zip(noise.poses.iter().cycle()) {
            pose.world_from_camera.translation.vector += noise.world_from_camera.translation.vector * 0.1;
        }
        let e = evaluate(&estimate, &truth, &with(Alignment::Se3)).unwrap();
        let nudge = Isometry3::new(small.translation.vector * 1e-3, small.rotation.scaled_axis() * 1e-3);
        let other: f64 = e.pairs.iter().map(|p| ((nudge * p.estimate).translation.vector - p.truth.translation.vector).norm_squared()).sum();
        prop_assert!(other >= e.absolute.translation.sse - 1e-9);
    }

    #[test]
    fn relative_errors_and_drift_do_not_depend_on_the_worlds(truth in trajectories(), estimate in trajectories(), a in isometries(), b in isometries()) {
        let options = |all_pairs| EvaluationOptions {
            deltas: vec![Delta::Frames(2), Delta::Metres(60.0)], all_pairs, segment_lengths_m: vec![80.0], ..with(Alignment::None)
        };
        for all_pairs in [false, true] {
            let one = evaluate(&estimate, &truth, &options(all_pairs)).unwrap();
            let other = evaluate(&moved(&estimate, &a, 1.0), &moved(&truth, &b, 1.0), &options(all_pairs)).unwrap();
            prop_assert_eq!(one.relative.len(), other.relative.len());
            for (x, y) in one.relative.iter().zip(&other.relative) {
                prop_assert_eq!(&x.stretches, &y.stretches);
                prop_assert!((x.translation.rmse - y.translation.rmse).abs() < 1e-9);
                prop_assert!((x.rotation.mean - y.rotation.mean).abs() < 1e-9);
            }
            for (x, y) in one.drift.iter().zip(&other.drift) {
                prop_assert!((x.translation_percent - y.translation_percent).abs() < 1e-9);
                prop_assert!((x.rotation_deg_per_m - y.rotation_deg_per_m).abs() < 1e-9);
            }
            // The heading error is about the true world's z axis, so it is invariant to the
            // estimate's world only.
            let other = evaluate(&moved(&estimate, &a, 1.0), &truth, &options(all_pairs)).unwrap();
            for (x, y) in one.drift.iter().zip(&other.drift) {
                prop_assert!((x.heading_bias_deg_per_m - y.heading_bias_deg_per_m).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn the_first_poses_meet_under_origin(truth in trajectories(), estimate in trajectories()) {
        let e = evaluate(&estimate, &truth, &with(Alignment::Origin)).unwrap();
        prop_assert!(e.absolute.translation_m[0] < 1e-9 && e.absolute.rotation_rad[0] < 1e-6);
    }

    #[test]
    fn every_start_takes_the_nearest_length(steps in prop::collection::vec(0.0..0.4f64, 2..40), length_m in 0.1..2.0f64) {
        let mut x = 0.0;
        let t = trajectory(steps.iter().map(|step| { x += step; Isometry3::translation(x, 0.0, 0.0) }).collect::<Vec<_>>());
        let options = EvaluationOptions { deltas: vec![Delta::Metres(length_m)], all_pairs: true, ..with(Alignment::None) };
        let found = evaluate(&t, &t, &options).unwrap().relative.pop().map_or(vec![], |r| r.stretches);
        let at: Vec<f64> = t.poses.iter().map(|p| p.world_from_camera.translation.vector.x).collect();
        let mut expected = vec![];
        for i in 0..at.len() - 1 {
            let off = |j: usize| (at[j] - at[i] - length_m).abs();
            let mut best = i + 1;
            for j in i + 1..at.len() { if off(j) < off(best) { best = j; } }
            if off(best) <= length_m * 0.1 { expected.push((i, best)); }
        }
        // Lengths that tie up to rounding may be resolved either way.
        prop_assert_eq!(found.len(), expected.len());
        for (a, b) in found.iter().zip(&expected) {
            prop_assert!(a.0 == b.0 && (at[a.1] - at[b.1]).abs() < 1e-9 || ((at[a.1] - at[a.0] - length_m).abs() - (at[b.1] - at[b.0] - length_m).abs()).abs() < 1e-9);
        }
    }
}
