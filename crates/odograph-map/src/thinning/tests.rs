use super::*;
use nalgebra::{Matrix4, Matrix6};
use odograph::camera::Rig;
use odograph::geometry::wrap_angle;
use odograph::ground_map::MapKeyframe;
use odograph::place_recognition::Signature;

fn pose(number: u64) -> GroundPose {
    GroundPose {
        x_m: 0.1 * number as f64,
        y_m: (0.4 * number as f64).sin(),
        heading_rad: 0.3 * number as f64,
        // A rising camera: the motions measured from each keyframe are in units of its own height.
        height_m: 1.0 + 0.02 * number as f64,
        ..GroundPose::level(1.0)
    }
}

/// The exact edge between two poses, with a full covariance.
fn edge(from: u64, to: u64) -> MapEdge {
    let (a, b) = (pose(from), pose(to));
    let half = Matrix4::from_fn(|row, column| 1e-3 * ((3 * row + column) as f64 + to as f64).sin());
    MapEdge {
        from: KeyframeId(from),
        to: KeyframeId(to),
        kind: if to < from { EdgeKind::Loop } else { EdgeKind::Odometry },
        motion: relative_pose::relative_motion(&a, &b),
        covariance: half * half.transpose() + Matrix4::identity() * 1e-8,
    }
}

fn map(count: u64, edges: Vec<MapEdge>) -> GroundMap {
    let keyframe = |number| MapKeyframe {
        id: KeyframeId(number),
        session: 0,
        segment: 0,
        frame: number,
        time_s: number as f64,
        odometry_pose: pose(number),
        pose: pose(number),
        covariance: Matrix6::identity(),
        signature: Signature::default(),
    };
    GroundMap {
        camera: Camera::from_field_of_view((64, 48), (0.8, 0.6), 1.0).unwrap(),
        rig: Rig::level(1.0),
        other_cameras: BTreeMap::new(),
        masks: BTreeMap::new(),
        keyframes: (0..count).map(keyframe).collect(),
        edges,
    }
}

#[test]
fn composed_edges_agree_with_the_keyframe_poses() {
    let mut edges: Vec<MapEdge> = (1..20).map(|number| edge(number - 1, number)).collect();
    edges.push(edge(17, 3));
    edges.push(edge(12, 5));
    let map = map(20, edges);
    let thinned = thinning(&map, 6);
    assert_eq!(thinned.gone.len(), 14);
    let left: BTreeSet<KeyframeId> =
        map.keyframes.iter().map(|keyframe| keyframe.id).filter(|id| !thinned.gone.contains(id)).collect();
    let kept = |edge: &&MapEdge| left.contains(&edge.from) && left.contains(&edge.to);
    let mut reached = BTreeSet::from([*left.first().unwrap()]);
    for _ in 0..left.len() {
        for one in map.edges.iter().chain(&thinned.edges).filter(kept) {
            let expected = edge(one.from.0, one.to.0).motion;
            let misses = (one.motion - expected).map(|value| wrap_angle(value).abs());
            assert!(misses.max() < 1e-9, "{one:?} instead of {expected}");
            if reached.contains(&one.from) || reached.contains(&one.to) {
                reached.extend([one.from, one.to]);
            }
        }
    }
    assert_eq!(reached, left, "one piece");
    assert!(thinned.edges.iter().all(|edge| left.contains(&edge.from) && left.contains(&edge.to)));
    // Six footprints of 0.8 m by 0.6 m cannot cover a path of four metres; a poor selection covers
    // less than half of it.
    assert!(thinned.ground_kept > 0.7, "{}", thinned.ground_kept);
}

#[test]
fn covariance_propagation_agrees_with_numerical_jacobians() {
    let ties = Ties::of(&map(3, vec![]));
    let (first, second) = (edge(0, 1), edge(1, 2));
    // Numerical Jacobian by finite differences.
    let step = 1e-6;
    let moved = |edge: &MapEdge, k: usize| {
        let mut edge = *edge;
        edge.motion[k] += step;
        edge
    };
    let numeric = |change: &dyn Fn(usize) -> Vector4<f64>, base: Vector4<f64>| {
        Matrix4::from_columns(&[0, 1, 2, 3].map(|k| (change(k) - base) / step))
    };
    let whole = ties.composed_of(&first, &second);
    let by_first = numeric(&|k| ties.composed_of(&moved(&first, k), &second).motion, whole.motion);
    let by_second = numeric(&|k| ties.composed_of(&first, &moved(&second, k)).motion, whole.motion);
    let expected = by_first * first.covariance * by_first.transpose()
        + by_second * second.covariance * by_second.transpose();
    assert!((whole.covariance - expected).amax() < 1e-5 * expected.amax());
    let back = ties.reversed(&first);
    let by = numeric(&|k| ties.reversed(&moved(&first, k)).motion, back.motion);
    let expected = by * first.covariance * by.transpose();
    assert!((back.covariance - expected).amax() < 1e-5 * expected.amax());
    let again = ties.reversed(&back);
    assert!(
        (again.motion - first.motion).amax() < 1e-12 && (again.covariance - first.covariance).amax() < 1e-15
    );
}

#[test]
fn redundant_keyframes_are_removed_first() {
    // Four keyframes far apart and five at the same position: four of the five are removed.
    let mut map = map(9, vec![]);
    for (number, keyframe) in map.keyframes.iter_mut().enumerate() {
        keyframe.pose =
            GroundPose { x_m: if number < 5 { 0.0 } else { 10.0 * number as f64 }, ..GroundPose::level(1.0) };
    }
    let thinned = thinning(&map, 5);
    assert!(thinned.gone.iter().all(|id| id.0 < 5) && thinned.ground_kept == 1.0, "{thinned:?}");
    assert!(thinning(&map, 3).ground_kept < 0.7);
    assert!(thinning(&map, 100).gone.is_empty());
}
