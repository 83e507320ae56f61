use super::*;
use crate::keyframe::relative_pose::relative_motion;
use crate::motion::Random;
use nalgebra::{Matrix2, Matrix3, Matrix4, Vector4};

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
        assert!(graph.add_edge(edge));
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
        assert!(graph.add_edge(&edge(i, i + 1, EdgeKind::Odometry, Vector4::new(1.0, 0.0, 0.0, 0.0), 0.1)));
    }
    let direct = Vector4::new(4.1, 0.0, 0.0, 0.0);
    assert!(graph.add_edge(&edge(0, 4, EdgeKind::Odometry, direct, 0.1)));
    graph.optimize(20);
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
        graph.optimize(50);
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
    let mut reach = graph.reach(KeyframeId(0)).unwrap();
    assert_eq!(whole.len(), truth.len());
    for (at, of_graph) in whole.iter().enumerate() {
        let one = reach.to(KeyframeId(at as u64)).unwrap();
        for i in 0..3 {
            let (path, least) = (one.covariance[(i, i)], of_graph[(i, i)]);
            assert!(path >= 0.99 * least, "keyframe {at}, number {i}: {path} against {least}");
        }
    }
}

#[test]
fn unconnected_parts_do_not_move() {
    let mut graph = PoseGraph::new(Heights::Held, 1.0);
    (0..4).for_each(|i| graph.insert(KeyframeId(i), pose(10.0 * i as f64, 0.0, 0.0), 1.0));
    let motion = Vector4::new(1.0, 0.0, 0.0, 0.0);
    assert!(graph.add_edge(&edge(0, 1, EdgeKind::Odometry, motion, 0.1)));
    assert!(graph.add_edge(&edge(2, 3, EdgeKind::Odometry, motion, 0.1)));
    assert!(!graph.add_edge(&edge(2, 9, EdgeKind::Odometry, motion, 0.1)), "there is no keyframe 9");
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
        assert!(graph.add_edge(edge));
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
        assert!(graph.add_edge(edge));
        // Asked for only when the graph is too large for being optimised as a whole.
        if edge.kind == EdgeKind::Loop && graph.nodes.len() > 330 {
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

/// Absolute edges of every `step`-th keyframe at its true place in a survey frame, with noise.
fn surveyed(truth: &[GroundPose], step: usize, survey_from_world: &Sim2, sigma_m: f64) -> Vec<AbsoluteEdge> {
    let mut random = Random::new(11);
    let of = |(at, pose): (usize, &GroundPose)| {
        let point_m = Vector2::new(0.3, -0.2);
        let world_from_node = Sim2::rigid(&pose.se2());
        let there = world_from_node.apply(crate::geometry::GroundPoint::new(point_m.x, point_m.y));
        let place = survey_from_world.apply(there);
        let noise = Vector2::from_fn(|_, _| sigma_m * normal(&mut random));
        AbsoluteEdge {
            keyframe: KeyframeId(at as u64),
            point_m,
            direction_rad: 0.4,
            covariance: Matrix3::from_diagonal_element(1e-8),
            place_m: Vector2::new(place.x_m, place.y_m) + noise,
            place_covariance_m2: Matrix2::from_diagonal_element(sigma_m * sigma_m),
            heading: None,
        }
    };
    truth.iter().enumerate().step_by(step).map(of).collect()
}

/// Truth and odometry of a straight drive with a keyframe a metre.
fn drive(length: usize, sigma: f64) -> (Vec<GroundPose>, Vec<MapEdge>) {
    let mut random = Random::new(3);
    let truth: Vec<GroundPose> = (0..=length).map(|i| pose(i as f64, 0.0, 0.0)).collect();
    let edges = (1..=length as u64)
        .map(|i| {
            let noise = Vector4::from_fn(|row, _| if row < 3 { sigma * normal(&mut random) } else { 0.0 });
            edge(i - 1, i, EdgeKind::Odometry, Vector4::new(1.0, 0.0, 0.0, 0.0) + noise, sigma)
        })
        .collect();
    (truth, edges)
}

fn elsewhere() -> Sim2 {
    Sim2 { x_m: 350.0, y_m: -120.0, heading_rad: 2.1, scale: 1.0 }
}

fn worst_in(graph: &PoseGraph, truth: &[GroundPose], survey_from_world: &Sim2) -> f64 {
    let there: Vec<GroundPose> = truth.iter().map(|pose| survey_from_world.apply_to_pose(pose)).collect();
    worst_m(graph, &there)
}

#[test]
fn surveyed_points_bend_a_drifting_path_back() {
    let (truth, edges) = drive(100, 1e-3);
    let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
    let drifted = worst_m(&graph, &truth);
    let places = surveyed(&truth, 10, &elsewhere(), 1e-3);
    let placed = graph.place(&places, None, 60).unwrap();
    assert!(placed.uses.iter().all(|of| of.used) && placed.scale_sigma == 0.0, "{placed:?}");
    graph.adopt_survey_frame();
    let after = worst_in(&graph, &truth, &elsewhere());
    // Between two places ten metres apart, headings that walk by 1 mrad a metre leave millimetres.
    assert!(drifted > 10.0 * after && after < 0.012, "{drifted} m without, {after} m with places");
}

#[test]
fn a_wrong_place_is_rejected_and_does_not_bend_the_path() {
    let (truth, edges) = drive(100, 1e-3);
    let mut places = surveyed(&truth, 10, &elsewhere(), 1e-3);
    let mut right = dead_reckoned(&edges, &truth, Heights::Held);
    right.place(&places, None, 60).unwrap();
    right.adopt_survey_frame();
    places[4].place_m.x += 0.1;
    let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
    let placed = graph.place(&places, None, 60).unwrap();
    let used: Vec<bool> = placed.uses.iter().map(|of| of.used).collect();
    assert_eq!(used, (0..11).map(|at| at != 4).collect::<Vec<_>>());
    // Over the twenty metres between its neighbours the path itself is known to a centimetre.
    assert!((placed.uses[4].off_m.norm() - 0.1).abs() < 0.04, "{:?}", placed.uses[4]);
    graph.adopt_survey_frame();
    let (with, without) = (worst_in(&graph, &truth, &elsewhere()), worst_in(&right, &truth, &elsewhere()));
    assert!(with < without + 0.03, "{without} m, with the wrong place {with} m");
}

#[test]
fn a_wrong_scale_is_found_and_corrected_with_the_heights() {
    for scale in [0.99, 1.012] {
        let (truth, edges) = drive(100, 1e-3);
        // The truth is longer than what odometry measured.
        let longer: Vec<GroundPose> =
            truth.iter().map(|pose| Sim2::about_origin(0.0, scale).apply_to_pose(pose)).collect();
        let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
        let places = surveyed(&longer, 10, &elsewhere(), 1e-3);
        let placed = graph.place(&places, None, 60).unwrap();
        let found = placed.survey_from_graph.scale;
        assert!((found - scale).abs() < 4.0 * placed.scale_sigma + 1e-4, "{placed:?}");
        assert!(placed.scale_sigma > 0.0 && placed.scale_sigma < 2e-4, "{placed:?}");
        graph.adopt_survey_frame();
        // The points of the places are measured in metres that are off by the scale.
        assert!(worst_in(&graph, &longer, &elsewhere()) < 0.012);
        assert!((graph.pose(KeyframeId(50)).unwrap().height_m - scale).abs() < 1e-3);
    }
}

#[test]
fn an_adopted_frame_does_not_depend_on_where_the_graph_began() {
    let (truth, edges) = drive(40, 1e-3);
    let places = surveyed(&truth, 10, &elsewhere(), 1e-3);
    let adopted = |moved: &Sim2| {
        let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
        let poses: Vec<_> = graph.poses().collect();
        for (id, pose) in poses {
            graph.insert(id, moved.apply_to_pose(&pose), 1.0);
        }
        graph.place(&places, None, 60).unwrap();
        graph.adopt_survey_frame();
        graph
    };
    let here = adopted(&Sim2::IDENTITY);
    let there = adopted(&Sim2 { x_m: -70.0, y_m: 9.0, heading_rad: -1.3, scale: 1.0 });
    for ((_, a), (_, b)) in here.poses().zip(there.poses()) {
        assert!(
            (a.x_m - b.x_m).hypot(a.y_m - b.y_m) < 1e-5
                && wrap_angle(a.heading_rad - b.heading_rad).abs() < 1e-6
        );
    }
    let (a, b) = (here.covariances(), there.covariances());
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).amax() < 1e-3 * a.amax()));
}

#[test]
fn the_covariance_in_the_survey_frame_is_true() {
    let mut sum = 0.0;
    let runs = 60;
    for run in 0..runs {
        let mut random = Random::new(100 + run);
        let (truth, mut edges) = drive(30, 0.0);
        for edge in &mut edges {
            edge.motion += Vector4::from_fn(|row, _| if row < 3 { 2e-3 * normal(&mut random) } else { 0.0 });
            edge.covariance = Matrix4::from_diagonal_element(4e-6);
        }
        let mut places = surveyed(&truth, 10, &elsewhere(), 3e-3);
        let exact = surveyed(&truth, 10, &elsewhere(), 0.0);
        for (place, exact) in places.iter_mut().zip(exact) {
            place.place_m = exact.place_m + Vector2::from_fn(|_, _| 3e-3 * normal(&mut random));
        }
        let mut graph = dead_reckoned(&edges, &truth, Heights::Held);
        graph.turn_sigma = 1e-9; // the mount is known
        graph.place(&places, None, 60).unwrap();
        graph.adopt_survey_frame();
        let covariances = graph.covariances();
        for at in [5usize, 15, 30] {
            let found = graph.pose(KeyframeId(at as u64)).unwrap();
            let truth = elsewhere().apply_to_pose(&truth[at]);
            let off = Vector2::new(found.x_m - truth.x_m, found.y_m - truth.y_m);
            let block = covariances[at].fixed_view::<2, 2>(0, 0).into_owned();
            sum += (off.transpose() * block.try_inverse().unwrap() * off)[0];
        }
    }
    // Two degrees of freedom; 180 values, partly dependent, have a mean within 2 ± 0.45.
    let nees = sum / (3.0 * runs as f64);
    assert!((1.5..2.5).contains(&nees), "{nees}");
}

#[test]
fn places_that_say_nothing_leave_the_graph_as_it_was() {
    let (truth, edges) = drive(20, 1e-3);
    let before = dead_reckoned(&edges, &truth, Heights::Held);
    let all = surveyed(&truth, 5, &elsewhere(), 1e-3);
    let mut graph = before.clone();
    assert_eq!(graph.place(&all[..1], None, 60), Err(Unplaceable::TooFew));
    let close: Vec<AbsoluteEdge> = (0..3).map(|_| all[2]).collect();
    assert!(graph.place(&close, None, 60).is_err());
    let nan = AbsoluteEdge { place_m: Vector2::new(f64::NAN, 0.0), ..all[1] };
    assert!(graph.place(&[nan, nan], None, 60).is_err());
    assert!(graph.poses().zip(before.poses()).all(|(a, b)| a == b) && graph.survey.is_none());
    // One place with a direction is enough.
    let heading = Some((elsewhere().heading_rad + 0.4, 1e-6));
    let placed = graph.place(&[AbsoluteEdge { heading, ..all[2] }], None, 60).unwrap();
    assert!(wrap_angle(placed.survey_from_graph.heading_rad - elsewhere().heading_rad).abs() < 0.02);
}

proptest::proptest! {
    #[test]
    fn jacobians_of_absolute_edges_are_those_of_differences(
        node in proptest::array::uniform3(-3.0..3.0f64), scale in 0.5..2.0f64, place in proptest::array::uniform4(-2.0..2.0f64),
        point in proptest::array::uniform2(-1.0..1.0f64),
    ) {
        let at = |numbers: Vector4<f64>| Node {
            id: KeyframeId(0),
            pose: GroundPose { height_m: numbers[3].exp(), ..pose(numbers[0], numbers[1], numbers[2]) },
            measured_at_m: 1.0,
        };
        let placed = |numbers: Vector4<f64>| Sim2::from_vector(&Vector4::new(numbers[0], numbers[1], numbers[2], 0.3 * numbers[3]));
        let (own, placement) = (Vector4::new(node[0], node[1], node[2], scale.ln()), Vector4::from(place));
        let mut edge = AbsoluteEdge {
            keyframe: KeyframeId(0),
            point_m: Vector2::from(point),
            direction_rad: 0.3,
            covariance: Matrix3::new(2.0, 0.3, 0.1, 0.3, 1.0, 0.2, 0.1, 0.2, 0.5),
            place_m: Vector2::new(0.4, -0.3),
            place_covariance_m2: Matrix2::new(0.5, 0.1, 0.1, 0.3),
            heading: Some((0.0, 0.1)),
        };
        // Away from where the angle wraps.
        edge.heading = Some((own[2] + 0.3 + placement[2] + 0.5, 0.1));
        let weighted = absolute::WeightedPoint::new(0, &at(own), &edge, &placed(placement)).unwrap();
        let exact = weighted.linearized(&at(own), &placed(placement));
        for column in 0..4 {
            let mut step = Vector4::zeros();
            step[column] = 1e-6;
            let by = |of: &dyn Fn(Vector4<f64>) -> Vector4<f64>| (of(step) - of(-step)) / 2e-6;
            let misses = |own: Vector4<f64>, placement: Vector4<f64>| weighted.linearized(&at(own), &placed(placement)).misses;
            let by_node = by(&|step| misses(own + step, placement));
            proptest::prop_assert!((by_node - exact.by_node.column(column)).amax() < 1e-6);
            let by_placement = by(&|step| misses(own, placement + step));
            let expected = if column < 3 { exact.by_placement.column(column).into_owned() } else { 0.3 * exact.by_scale.column(2) };
            proptest::prop_assert!((by_placement - expected).amax() < 1e-6);
        }
        proptest::prop_assert_eq!(weighted.squared(&at(own), &placed(placement)), exact.misses.norm_squared());
    }
}
