use super::*;
use crate::SeenPoint;
use nalgebra::DMatrix;
use odograph::camera::Distortion;
use odograph::motion::Random;

/// A standard normal number: twelve uniform ones.
fn normal(random: &mut Random) -> f64 {
    (0..12).map(|_| random.below(1 << 20) as f64 / f64::from(1 << 20)).sum::<f64>() - 6.0
}

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.2, 0.05, 0.0005, -0.0003]).unwrap();
    Camera::new((1280, 720), (900.0, 902.0), (644.0, 355.0), distortion).unwrap()
}

fn floor(board: &str, forward: Option<BoardDirection>) -> FloorBoard {
    FloorBoard { board: board.parse().unwrap(), thickness_m: 0.0, forward }
}

/// 60 by 45 cm: it fills half of the image.
const CHARUCO: &str = "charuco:12x9:50mm";

/// The rig of all views.
const RIG: Rig = Rig { height_m: 0.75, roll_rad: 0.06, pitch_rad: -0.09, yaw_rad: 0.4, lever_arm: None };

/// The board from a camera at `pose` in the world of [`FloorBoard::points`], with noise.
fn view(
    camera: &Camera,
    floor: &FloorBoard,
    pose: &GroundPose,
    noise_px: f64,
    random: &mut Random,
) -> BoardView {
    let count = floor.board.points().len();
    let all = BoardView {
        size: (camera.width(), camera.height()),
        points: (0..count).map(|index| SeenPoint { index, pixel: Pixel::new(0.0, 0.0) }).collect(),
    };
    let seen = floor.points(&all).into_iter().enumerate().filter_map(|(index, (ground, _))| {
        let pixel = pose.ray_from_ground(ground).and_then(|ray| camera.pixel_from_ray(ray))?;
        let pixel = Pixel::new(pixel.x + noise_px * normal(random), pixel.y + noise_px * normal(random));
        camera.contains(pixel, 0.0).then_some(SeenPoint { index, pixel })
    });
    BoardView { points: seen.collect(), ..all }
}

/// A pose of [`RIG`] with the board somewhere below it.
fn pose(random: &mut Random) -> GroundPose {
    let place = |random: &mut Random| (random.below(1000) as f64 / 1000.0 - 0.5) * 0.2;
    GroundPose {
        x_m: place(random) - 0.2,
        y_m: place(random) - 0.28,
        heading_rad: RIG.yaw_rad,
        ..RIG.first_pose()
    }
}

fn views(floor: &FloorBoard, count: usize, noise_px: f64, random: &mut Random) -> Vec<BoardView> {
    let camera = camera();
    (0..count).map(|_| view(&camera, floor, &pose(random), noise_px, random)).collect()
}

fn errors(rig: &Rig) -> Vector3<f64> {
    Vector3::new(rig.height_m - RIG.height_m, rig.roll_rad - RIG.roll_rad, rig.pitch_rad - RIG.pitch_rad)
}

#[test]
fn one_view_determines_height_and_tilt_as_well_as_asked() {
    let mut random = Random::new(7);
    let floor = floor(CHARUCO, Some(BoardDirection::MinusY));
    for _ in 0..20 {
        let found = rig_from_boards(&camera(), None, &floor, &views(&floor, 1, 0.05, &mut random)).unwrap();
        let rig = found.measured.rig;
        // Corner finders reach a twentieth of a pixel on sharp images. Required are 0.1 % and
        // 0.02°.
        let off = errors(&rig);
        assert!(off[0].abs() < 0.001 * RIG.height_m, "{off}");
        assert!(off[1].hypot(off[2]) < 0.02f64.to_radians(), "{off}");
        assert!((rig.yaw_rad - RIG.yaw_rad).abs() < 0.05f64.to_radians());
        assert!(found.notes.is_empty(), "{:?}", found.notes);
    }
    // Without noise it is exact.
    let exact = rig_from_boards(&camera(), None, &floor, &views(&floor, 3, 0.0, &mut random)).unwrap();
    assert!(errors(&exact.measured.rig).norm() < 1e-9, "{exact:?}");
}

#[test]
fn the_stated_covariance_is_true() {
    let floor = floor(CHARUCO, Some(BoardDirection::X));
    for count in [1, 4] {
        let trials = 100;
        let (mut nees, mut yaw) = (0.0, 0.0);
        let mut random = Random::new(3);
        for _ in 0..trials {
            let views = views(&floor, count, 0.2, &mut random);
            let found = rig_from_boards(&camera(), None, &floor, &views).unwrap();
            let off = errors(&found.measured.rig);
            nees += off.dot(&(found.covariance.try_inverse().unwrap() * off)) / f64::from(trials);
            let deviation = found.measured.deviations.yaw_rad.unwrap();
            yaw += ((found.measured.rig.yaw_rad - RIG.yaw_rad) / deviation).powi(2) / f64::from(trials);
        }
        // 300 sums of squares: 2.54 to 3.50 with 95 %. With four views, scatter that cannot be
        // excluded makes it smaller.
        assert!((if count == 1 { 2.5 } else { 1.8 }..3.55).contains(&nees), "{count} views: {nees}");
        assert!((0.5..1.35).contains(&yaw), "{count} views: {yaw}");
    }
}

#[test]
fn the_uncertainty_of_the_camera_is_carried_on() {
    let floor = floor(CHARUCO, None);
    let views = views(&floor, 3, 0.05, &mut Random::new(1));
    // A focal length that is 1 % off makes the height 1 % off, in every view alike.
    let deviations = [("f", 9.0), ("cx", 2.0), ("cy", 2.0), ("k9", 1.0)];
    let covariance =
        DMatrix::from_fn(4, 4, |i, j| if i == j { deviations[i].1 * deviations[i].1 } else { 0.0 });
    let names = deviations.iter().map(|(name, _)| (*name).to_owned()).collect();
    let uncertainty = CameraUncertainty::new(names, covariance).unwrap();
    let without = rig_from_boards(&camera(), None, &floor, &views).unwrap().measured;
    let with = rig_from_boards(&camera(), Some(&uncertainty), &floor, &views).unwrap().measured;
    assert_eq!(with.rig, without.rig);
    let height = with.deviations.height_m.unwrap();
    assert!((height / (0.01 * RIG.height_m) - 1.0).abs() < 0.3, "{height}");
    assert!(without.deviations.height_m.unwrap() < 0.1 * height);
    assert!(CameraUncertainty::new(vec!["f".into()], DMatrix::zeros(2, 2)).is_err());
}

#[test]
fn directions_thickness_and_missing_yaw() {
    let mut random = Random::new(5);
    for (forward, board_turns_rad) in [
        (BoardDirection::MinusY, 0.0f64),
        (BoardDirection::MinusX, 0.5 * std::f64::consts::PI),
        (BoardDirection::Y, std::f64::consts::PI),
        (BoardDirection::X, -0.5 * std::f64::consts::PI),
    ] {
        // The same image with another forward direction of the board: up the print is 0, its left a
        // quarter turn to the left.
        let drawn = floor(CHARUCO, Some(BoardDirection::MinusY));
        let views = views(&drawn, 1, 0.0, &mut random);
        let given = FloorBoard { forward: Some(forward), thickness_m: 0.005, ..drawn };
        let rig = rig_from_boards(&camera(), None, &given, &views).unwrap().measured.rig;
        assert!(
            wrap_angle(rig.yaw_rad - (RIG.yaw_rad - board_turns_rad)).abs() < 1e-9,
            "{forward:?} {rig:?}"
        );
        assert!((rig.height_m - RIG.height_m - 0.005).abs() < 1e-9);
        let without =
            rig_from_boards(&camera(), None, &FloorBoard { forward: None, ..given }, &views).unwrap();
        assert_eq!((without.measured.rig.yaw_rad, without.measured.deviations.yaw_rad), (0.0, None));
    }
}

#[test]
fn a_board_that_looks_the_same_turned_says_so() {
    for (board, turns) in [
        ("chessboard:9x6:25mm", 1),
        ("chessboard:8x6:25mm", 2),
        ("chessboard:7x7:25mm", 2),
        ("chessboard:8x8:25mm", 4),
        ("circles:7x5:20mm", 2),
        ("circles:5x5:20mm", 4),
        ("asymmetric-circles:4x11:20mm", 1),
        ("asymmetric-circles:4x10:20mm", 2),
        (CHARUCO, 1),
        ("aprilgrid:5x5:30mm", 1),
    ] {
        assert_eq!(ambiguity_turns(&board.parse().unwrap()), turns, "{board}");
    }
    let drawn = floor("chessboard:8x6:25mm", Some(BoardDirection::X));
    let mut views = views(&drawn, 2, 0.0, &mut Random::new(2));
    // The finder may start at the other end in one of them.
    let count = drawn.board.points().len();
    views[1].points.iter_mut().for_each(|point| point.index = count - 1 - point.index);
    let found = rig_from_boards(&camera(), None, &drawn, &views).unwrap();
    assert!((found.measured.rig.yaw_rad - RIG.yaw_rad).abs() < 1e-9, "{found:?}");
    assert!(found.notes[0].contains("looks the same after a turn of 180°"), "{:?}", found.notes);
}

#[test]
fn views_that_do_not_belong_are_named() {
    let mut random = Random::new(9);
    let floor = floor(CHARUCO, Some(BoardDirection::X));
    let camera = camera();
    let mut all = views(&floor, 4, 0.1, &mut random);
    // On a book, three degrees off.
    let leaning = GroundPose { roll_rad: RIG.roll_rad + 0.05, ..pose(&mut random) };
    all.insert(1, view(&camera, &floor, &leaning, 0.1, &mut random));
    // Hand-held, as in a calibration.
    for _ in 0..3 {
        let held = GroundPose { roll_rad: -0.3, pitch_rad: 0.2, x_m: 0.29, y_m: 0.04, ..pose(&mut random) };
        all.push(view(&camera, &floor, &held, 0.1, &mut random));
    }
    // Upright, and hardly in the picture.
    let upright = GroundPose { pitch_rad: -1.25, roll_rad: 0.0, x_m: -0.9, ..pose(&mut random) };
    all.push(view(&camera, &floor, &upright, 0.1, &mut random));
    all.push(BoardView { size: (1280, 720), points: all[0].points[..3].to_vec() });
    let found = rig_from_boards(&camera, None, &floor, &all).unwrap();
    assert!(errors(&found.measured.rig).norm() < 1e-3);
    let whys: Vec<&str> = found.views.iter().map(|v| v.why_not.as_deref().unwrap_or("")).collect();
    for (index, part) in [
        (0, ""),
        (1, "contradicts the other views (tilt by 2.8"),
        (4, ""),
        (5, "another height or tilt than most"),
        (7, "another height or tilt than most"),
        (8, "stands upright"),
        (9, "only 3 points"),
    ] {
        assert!(whys[index].contains(part) && whys[index].is_empty() == part.is_empty(), "{whys:?}");
    }
}

#[test]
fn boards_that_were_turned_between_views_determine_no_yaw() {
    let mut random = Random::new(4);
    let floor = floor(CHARUCO, Some(BoardDirection::X));
    let mut turned = |yaw_rad: f64| {
        let pose = GroundPose { heading_rad: yaw_rad, ..pose(&mut random) };
        view(&camera(), &floor, &pose, 0.1, &mut random)
    };
    let views = [turned(0.4), turned(1.4), turned(-1.0)];
    let found = rig_from_boards(&camera(), None, &floor, &views).unwrap();
    assert!(found.measured.deviations.yaw_rad.is_none() && found.measured.rig.yaw_rad == 0.0);
    assert!(found.notes[0].contains("mount yaw is not measured"), "{:?}", found.notes);
    assert!(errors(&found.measured.rig).norm() < 1e-3);
}

#[test]
fn what_cannot_be_measured_is_refused_in_one_sentence() {
    let mut random = Random::new(4);
    let floor = floor(CHARUCO, None);
    let good = views(&floor, 1, 0.1, &mut random);
    let refuse = |floor: &FloorBoard, views: &[BoardView], part: &str| {
        let error = rig_from_boards(&camera(), None, floor, views).unwrap_err().to_string();
        assert!(error.contains(part) && !error.contains('\n'), "{error}");
    };
    refuse(&floor, &[], "no view of the board");
    let small = BoardView { size: (640, 360), ..good[0].clone() };
    refuse(&floor, &[good[0].clone(), small], "picture 2 is 640x360");
    refuse(&FloorBoard { thickness_m: -1.0, ..floor }, &good, "thick is not usable");
    let line = BoardView { points: good[0].points[..8].to_vec(), ..good[0].clone() };
    refuse(&floor, std::slice::from_ref(&line), "do not spread over the board");
    let other = GroundPose { roll_rad: 0.2, ..pose(&mut random) };
    let other = view(&camera(), &floor, &other, 0.1, &mut random);
    refuse(&floor, &[good[0].clone(), other], "contradict each other");
    // A calibration: the camera is held differently in every picture but two.
    let held = |(roll_rad, pitch_rad): (f64, f64), random: &mut Random| {
        let place = pose(random);
        let roll_rad = RIG.roll_rad + roll_rad;
        let held = GroundPose { roll_rad, pitch_rad: RIG.pitch_rad + pitch_rad, ..place };
        view(&camera(), &floor, &held, 0.1, random)
    };
    let tilts = [(0.08, 0.0), (-0.08, 0.0), (0.0, 0.08), (0.0, -0.08), (0.15, 0.0)];
    let mut calibration = views(&floor, 2, 0.1, &mut random);
    calibration.extend(tilts.map(|tilt| held(tilt, &mut random)));
    refuse(&floor, &calibration, "only 2 of the 7 views of the board agree");
    let mut mirrored = good[0].clone();
    mirrored.points.iter_mut().for_each(|point| point.pixel.x = 1279.0 - point.pixel.x);
    refuse(&floor, &[mirrored, line], "mirrored");
}
