use super::*;
use crate::keyframe::relative_pose::relative_motion;
use crate::motion::Random;
use nalgebra::{Matrix4, Vector4};

fn pose(x_m: f64, y_m: f64, heading_rad: f64) -> GroundPose {
    GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(1.0) }
}

fn edge(from: u64, to: u64, kind: EdgeKind, motion: Vector4<f64>, sigma: f64) -> MapEdge {
    let covariance = Matrix4::from_diagonal(&Vector4::new(1.0, 1.0, 1.0, 1.0)) * sigma * sigma;
    MapEdge { from: KeyframeId(from), to: KeyframeId(to), kind, motion, covariance }
}

/// About normal, unit variance.
fn normal(random: &mut Random) -> f64 {
    (0..12).map(|_| random.below(1_000_001) as f64 / 1e6).sum::<f64>() - 6.0
}

/// A walk to and fro over a grid, measured with noise; neighbouring rows see each other.
struct GridWalk {
    truth: Vec<GroundPose>,
    edges: Vec<MapEdge>,
}

fn grid(side: usize, sigma: f64, bend_per_m: f64, heights: Heights) -> GridWalk {
    let mut random = Random::new(7);
    let place = |i: usize| {
        let (row, along) = (i / side, i % side);
        let back = row % 2 == 1;
        let x = if back { side - 1 - along } else { along };
        let height = 1.0 + if heights == Heights::Free { 0.2 * (0.3 * i as f64).sin() } else { 0.0 };
        GroundPose {
            height_m: height,
            ..pose(x as f64, row as f64, if back { std::f64::consts::PI } else { 0.0 })
        }
    };
    let truth: Vec<GroundPose> = (0..side * side).map(place).collect();
    let mut edges = Vec::new();
    let mut measure = |from: usize, to: usize, kind| {
        let mut motion = relative_motion(&truth[from], &truth[to]);
        let turned = bend_per_m * motion[0];
        let (sin, cos) = (0.5 * turned).sin_cos();
        let (x, y) = (motion[0], motion[1]);
        (motion[0], motion[1]) = (cos * x + sin * y, cos * y - sin * x);
        motion[2] -= turned;
        for (i, value) in motion.iter_mut().enumerate() {
            *value += if i < 3 || heights == Heights::Free { sigma * normal(&mut random) } else { 0.0 };
        }
        edges.push(edge(from as u64, to as u64, kind, motion, sigma));
    };
    for i in 1..truth.len() {
        measure(i - 1, i, EdgeKind::Odometry);
        let (row, along) = (i / side, i % side);
        if row > 0 && along > 0 {
            measure((row - 1) * side + side - 1 - along, i, EdgeKind::Loop);
        }
    }
    GridWalk { truth, edges }
}

/// A graph whose poses are what the odometry edges alone say.
fn dead_reckoned(edges: &[MapEdge], truth: &[GroundPose], heights: Heights) -> PoseGraph {
    let mut graph = PoseGraph::new(heights, 1.0);
    let mut last = truth[0];
    graph.insert(KeyframeId(0), last, last.height_m);
    for edge in edges {
        if edge.kind == EdgeKind::Odometry {
            // The motions were measured at the true heights.
            let [from, to] = [edge.from, edge.to].map(|id| truth[id.0 as usize].height_m);
            last = crate::keyframe::relative_pose::compose(&last, &edge.motion, last.height_m / from);
            graph.insert(edge.to, last, to);
        }
        assert!(graph.tie(edge));
    }
    graph
}

fn worst_m(graph: &PoseGraph, truth: &[GroundPose]) -> f64 {
    graph.poses().zip(truth).map(|((_, a), b)| (a.x_m - b.x_m).hypot(a.y_m - b.y_m)).fold(0.0, f64::max)
}

#[test]
fn a_loop_closed_by_equal_links_shares_its_misclosure_equally() {
    // Four links along a line that are each 1.00 long, and a direct measurement of 4.10 as good as
    // one of them: by hand, each link becomes 1 + 0.1/5, so the last keyframe lies at 4.08.
    let mut graph = PoseGraph::new(Heights::Held, 1.0);
    graph.turn_sigma = 1e-9; // the mount is known
    (0..5).for_each(|i| graph.insert(KeyframeId(i), pose(i as f64, 0.0, 0.0), 1.0));
    for i in 0..4 {
        assert!(graph.tie(&edge(i, i + 1, EdgeKind::Odometry, Vector4::new(1.0, 0.0, 0.0, 0.0), 0.1)));
    }
    let direct = Vector4::new(4.1, 0.0, 0.0, 0.0);
    assert!(graph.tie(&edge(0, 4, EdgeKind::Odometry, direct, 0.1)));
    let done = graph.optimize(20);
    assert!(done.converged && done.cost.1 < done.cost.0, "{done:?}");
    let last = graph.pose(KeyframeId(4)).unwrap();
    assert!((last.x_m - 4.08).abs() < 1e-6 && last.y_m.abs() < 1e-9, "{last:?}");
    // Along the line four links in a row have 4 σ², beside them the direct one with σ²: 4/5 of
    // 0.01.
    let sigma2 = graph.covariances()[4][(0, 0)];
    assert!((sigma2 - 0.008).abs() < 1e-5, "{sigma2}");
}

#[test]
fn the_covariance_of_a_noisy_grid_is_true() {
    for heights in [Heights::Held, Heights::Free] {
        let GridWalk { truth, edges } = grid(12, 0.01, 0.0, heights);
        let mut graph = dead_reckoned(&edges, &truth, heights);
        let before = worst_m(&graph, &truth);
        let done = graph.optimize(50);
        assert!(done.converged, "{done:?}");
        let after = worst_m(&graph, &truth);
        assert!(after < 0.25 * before, "{heights:?}: {before} m without, {after} m with loops");
        // Mean normalised square of x and y: two per keyframe were they independent; they move
        // together, so it scatters widely.
        let covariances = graph.covariances();
        let nees: f64 = (1..truth.len())
            .map(|i| {
                let found = graph.pose(KeyframeId(i as u64)).unwrap();
                let off = nalgebra::Vector2::new(found.x_m - truth[i].x_m, found.y_m - truth[i].y_m);
                let block = covariances[i].fixed_view::<2, 2>(0, 0).into_owned();
                (off.transpose() * block.try_inverse().unwrap() * off)[0]
            })
            .sum::<f64>()
            / (truth.len() - 1) as f64;
        assert!((0.2..8.0).contains(&nees), "{heights:?}: {nees}");
    }
}

#[test]
fn a_false_loop_is_not_followed() {
    let GridWalk { truth, mut edges } = grid(12, 0.01, 0.0, Heights::Held);
    let mut right = dead_reckoned(&edges, &truth, Heights::Held);
    right.optimize(50);
    // Two keyframes ten metres apart taken for the same place.
    edges.push(edge(5, 130, EdgeKind::Loop, Vector4::new(0.1, 0.0, 0.0, 0.0), 0.01));
    let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
    graph.optimize(50);
    let (with, without) = (worst_m(&graph, &truth), worst_m(&right, &truth));
    assert!(with < without + 0.005, "{without} m, with the false loop {with} m");
}

#[test]
fn a_mount_that_turns_every_metre_is_found_out() {
    let bend = 0.004;
    let GridWalk { truth, edges } = grid(12, 0.002, bend, Heights::Held);
    let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
    let before = worst_m(&graph, &truth);
    graph.optimize(50);
    let (ahead, left) = graph.turn_per_m();
    // The rotation per metre to the left is nearly confounded with headings that alternate from row
    // to row: only the ends of the rows separate them.
    assert!((ahead - bend).abs() < 0.15 * bend && left.abs() < 0.25 * bend, "{ahead} {left}");
    let after = worst_m(&graph, &truth);
    assert!(before > 1.0 && after < 0.05, "{before} m without, {after} m with loops");
}

#[test]
fn a_turn_that_no_mount_has_is_not_taken_for_one() {
    // Ten times the prior standard deviation of the turn: a tilt of 6°.
    let bend = 0.05;
    let GridWalk { truth, edges } = grid(6, 0.002, bend, Heights::Held);
    let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
    graph.optimize(50);
    assert_eq!(graph.turn_per_m(), (0.0, 0.0));
}

#[test]
fn the_best_path_is_never_more_certain_than_the_graph() {
    let GridWalk { truth, edges } = grid(8, 0.01, 0.0, Heights::Held);
    let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
    graph.optimize(50);
    let whole = graph.covariances();
    let reached: Vec<Reached> = graph.reach(KeyframeId(0)).unwrap().collect();
    assert_eq!(reached.len(), truth.len());
    for one in &reached {
        let at = one.id.0 as usize;
        for i in 0..3 {
            let (way, least) = (one.covariance[(i, i)], whole[at][(i, i)]);
            assert!(way >= 0.99 * least, "keyframe {at}, number {i}: {way} against {least}");
        }
    }
}

#[test]
fn unconnected_parts_do_not_move() {
    let mut graph = PoseGraph::new(Heights::Held, 1.0);
    (0..4).for_each(|i| graph.insert(KeyframeId(i), pose(10.0 * i as f64, 0.0, 0.0), 1.0));
    let motion = Vector4::new(1.0, 0.0, 0.0, 0.0);
    assert!(graph.tie(&edge(0, 1, EdgeKind::Odometry, motion, 0.1)));
    assert!(graph.tie(&edge(2, 3, EdgeKind::Odometry, motion, 0.1)));
    assert!(!graph.tie(&edge(2, 9, EdgeKind::Odometry, motion, 0.1)), "there is no keyframe 9");
    graph.optimize(20);
    let x = |i: u64| graph.pose(KeyframeId(i)).unwrap().x_m;
    for (i, expected) in [(0, 0.0), (1, 1.0), (2, 20.0), (3, 21.0)] {
        assert!((x(i) - expected).abs() < 1e-6, "{i}: {}", x(i));
    }
}

#[test]
fn a_large_graph_comes_near_its_best_by_pieces() {
    // The path is measured step by step and relaxed at every tenth loop, as in a run.
    let GridWalk { truth, edges } = grid(30, 0.003, 0.0, Heights::Held);
    let mut graph = PoseGraph::new(Heights::Held, 1.0);
    graph.insert(KeyframeId(0), truth[0], 1.0);
    let mut fresh = Vec::new();
    for edge in &edges {
        if edge.kind == EdgeKind::Odometry {
            let from = graph.pose(edge.from).unwrap();
            graph.insert(edge.to, crate::keyframe::relative_pose::compose(&from, &edge.motion, 1.0), 1.0);
        }
        assert!(graph.tie(edge));
        fresh.extend((edge.kind == EdgeKind::Loop).then_some(*edge));
        if fresh.len() == 10 {
            graph.relax(&std::mem::take(&mut fresh), 2);
        }
    }
    let mut best = graph.clone();
    best.optimize(50);
    let drifted = worst_m(&dead_reckoned(&edges, &truth, Heights::Held), &truth);
    let off: Vec<GroundPose> = best.poses().map(|(_, pose)| pose).collect();
    let (by_pieces, whole) = (worst_m(&graph, &off), worst_m(&best, &truth));
    // What is left to be done at the end is far less than what noise leaves of the best: 7 mm of
    // 62, of 995 without loops.
    assert!(
        drifted > 10.0 * whole && by_pieces < 0.1 * whole,
        "{drifted} m without loops, {whole} m off at best, {by_pieces} m from that best"
    );
}

#[test]
fn a_large_graph_estimates_the_mount_turn_while_running() {
    let bend = 0.004;
    let GridWalk { truth, edges } = grid(22, 0.002, bend, Heights::Held);
    let mut graph = PoseGraph::new(Heights::Held, 1.0);
    graph.insert(KeyframeId(0), truth[0], 1.0);
    for edge in &edges {
        if edge.kind == EdgeKind::Odometry {
            let from = graph.pose(edge.from).unwrap();
            graph.insert(edge.to, crate::keyframe::relative_pose::compose(&from, &edge.motion, 1.0), 1.0);
        }
        assert!(graph.tie(edge));
        // Asked for only when the graph is too large for being optimised as a whole.
        if edge.kind == EdgeKind::Loop && graph.len() > 330 {
            graph.relax(&[*edge], 2);
        }
    }
    let (ahead, _) = graph.turn_per_m();
    assert!((ahead - bend).abs() < 0.15 * bend, "{ahead}");
    let mut best = graph.clone();
    best.optimize(50);
    let off: Vec<GroundPose> = best.poses().map(|(_, pose)| pose).collect();
    let (by_pieces, whole) = (worst_m(&graph, &off), worst_m(&best, &truth));
    assert!(by_pieces < 0.5 * whole, "{by_pieces} m from the best, which is {whole} m off");
}
