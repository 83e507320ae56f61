//! Detection of chessboards and circle grids in rendered images with exact ground truth.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use odograph::camera::{Camera, Distortion};
use odograph::image::GrayImage;
use odograph_calibration::{Board, BoardFinder, BoardView, NotFound, seen_instead};
use odograph_simulation::{BoardEffects, BoardScene, Framing, Occlusion};

fn camera(size: (usize, usize), distortion: &[f64]) -> Camera {
    let focal = 0.9 * size.0 as f64;
    let centre = (0.5 * size.0 as f64 + 2.3, 0.5 * size.1 as f64 - 3.1);
    let distortion = Distortion::from_opencv(distortion).unwrap();
    Camera::new((size.0, size.1), (focal, 1.001 * focal), centre, distortion).unwrap()
}

/// RMS error of the detected points, pixels; the indices must match.
fn error_px(found: &BoardView, truth: &BoardView) -> f64 {
    assert_eq!(found.size, truth.size);
    assert_eq!(found.points.len(), truth.points.len());
    let squares = found.points.iter().zip(&truth.points).map(|(found, truth)| {
        assert_eq!(found.index, truth.index);
        found.pixel.distance(truth.pixel).powi(2)
    });
    (squares.sum::<f64>() / truth.points.len() as f64).sqrt()
}

#[test]
fn chessboards_are_found_in_every_pose() {
    let barrel = [-0.3, 0.1, 0.001, -0.0005];
    for (text, size, distortion, count) in [
        ("chessboard:9x6:25mm", (640, 480), &barrel[..], 12),
        ("chessboard:7x7:25mm", (640, 480), &[], 6),
        ("chessboard:24x17:15mm", (1280, 720), &barrel[..], 3),
        ("chessboard:8x6:25mm", (1280, 720), &barrel[..], 6),
        ("chessboard:3x4:60mm", (320, 240), &[], 6),
    ] {
        let board: Board = text.parse().unwrap();
        let scene = BoardScene::new(&board, &camera(size, distortion), 3);
        let finder = BoardFinder::new(&board);
        let (mut squares, mut worst) = (0.0, 0.0f64);
        for (number, pose) in scene.poses(count, Framing::Whole, 11).iter().enumerate() {
            let effects = BoardEffects {
                light_gradient: (0.5 * (number % 2) as f64, -0.3),
                ..BoardEffects::camera_like(2.0, number as u64)
            };
            let image = scene.render(pose, &effects);
            let found = finder.find(&image).unwrap_or_else(|why| panic!("{text}, pose {number}: {why}"));
            let error_px = error_px(&found, &scene.true_view(pose));
            squares += error_px * error_px;
            worst = worst.max(error_px);
        }
        let rms_px = (squares / count as f64).sqrt();
        println!("{text} in {size:?}: {rms_px:.4} px rms, worst view {worst:.4} px");
        // The noise accounts for 0.01 to 0.02 px with squares of 20 px and more, and for 0.05 px
        // with squares of 8 px.
        assert!(rms_px < 0.04 && worst < 0.08, "{text}: {rms_px} px, worst {worst} px");
    }
}

#[test]
fn failure_reasons_describe_the_visible_board() {
    let camera = camera((640, 480), &[]);
    let drawn: Board = "chessboard:9x6:25mm".parse().unwrap();
    let scene = BoardScene::new(&drawn, &camera, 3);
    let pose = scene.poses(1, Framing::Whole, 5)[0];
    let find = |text: &str, effects: &BoardEffects| {
        BoardFinder::new(&text.parse().unwrap()).find(&scene.render(&pose, effects))
    };
    let plain = BoardEffects::camera_like(2.0, 1);
    assert!(find("chessboard:6x9:25mm", &plain).is_ok(), "a board may be said the other way round");
    for other in ["chessboard:8x6:25mm", "chessboard:7x5:25mm", "chessboard:11x7:25mm"] {
        let why = find(other, &plain).unwrap_err();
        assert!(matches!(why, NotFound::OtherSize { seen: (9, 6), .. }), "{other}: {why}");
    }
    let said = find("chessboard:8x6:25mm", &plain).unwrap_err().to_string();
    assert_eq!(said, "8x6 corners expected, the board seen has 9x6");
    let corner = scene.true_view(&pose).points[30].pixel;
    let (x, y) = (corner.x / 640.0, corner.y / 480.0);
    let hidden = BoardEffects {
        occlusion: Some(Occlusion { from: (x - 0.06, y - 0.06), to: (x + 0.06, y + 0.06) }),
        ..plain.clone()
    };
    let why = find("chessboard:9x6:25mm", &hidden).unwrap_err();
    assert!(matches!(why, NotFound::Partial { .. }), "{why}");
    let blurred = BoardEffects { blur_px: 9.0, ..plain };
    let why = find("chessboard:9x6:25mm", &blurred).unwrap_err();
    assert!(matches!(why, NotFound::Blurred | NotFound::NoCorners), "{why}");
}

#[test]
fn circle_grids_are_found_in_every_pose() {
    for (text, size) in [
        ("circles:7x5:20mm", (640, 480)),
        ("asymmetric-circles:4x11:20mm", (640, 480)),
        ("asymmetric-circles:4x6:20mm", (1280, 720)),
        ("circles:3x3:30mm", (320, 240)),
    ] {
        let board: Board = text.parse().unwrap();
        let scene = BoardScene::new(&board, &camera(size, &[-0.2, 0.05, 0.0, 0.0]), 3);
        let finder = BoardFinder::new(&board);
        for (number, pose) in scene.poses(8, Framing::Whole, 12).iter().enumerate() {
            let image = scene.render(pose, &BoardEffects::camera_like(2.0, number as u64));
            let found = finder.find(&image).unwrap_or_else(|why| panic!("{text}, pose {number}: {why}"));
            let error_px = error_px(&found, &scene.true_view(pose));
            // The centre of a disc's image is not the image of its centre: the bias is up to half a
            // pixel for oblique discs of 50 px.
            assert!(error_px < 0.5, "{text}, pose {number}: {error_px} px");
        }
        // Fronto-parallel in a pinhole camera there is no bias.
        let scene = BoardScene::new(&board, &camera(size, &[]), 3);
        let pose = Isometry3::translation(-0.071, -0.052, 0.5);
        let found = finder.find(&scene.render(&pose, &BoardEffects::camera_like(2.0, 1))).unwrap();
        let error_px = error_px(&found, &scene.true_view(&pose));
        println!("{text} seen squarely: {error_px:.4} px");
        assert!(error_px < 0.03, "{text} seen squarely: {error_px} px");
    }
}

#[test]
fn no_board_is_found_in_images_without_one() {
    let boards =
        ["chessboard:9x6:25mm", "chessboard:3x3:25mm", "circles:3x3:20mm", "asymmetric-circles:3x4:20mm"];
    let mut random = odograph::motion::Random::new(5);
    let mut images = Vec::new();
    for (width, height) in [(0, 0), (1, 1), (3, 2), (17, 17), (1, 500), (640, 480)] {
        images.push(GrayImage::new(width, height));
        images.push(GrayImage::from_samples(width, height, vec![255; width * height]).unwrap());
        let noise = (0..width * height).map(|_| random.below(256) as u8).collect();
        images.push(GrayImage::from_samples(width, height, noise).unwrap());
    }
    // Dots and squares of single pixels, and stripes.
    for pattern in
        [|x: usize, y: usize| x % 2 + y % 2, |x, y| (x + y) % 2, |x, _| x / 5 % 2, |x, y| x / 9 * y / 9 % 2]
    {
        let samples = (0..640 * 480).map(|i| if pattern(i % 640, i / 640) == 0 { 0 } else { 255 }).collect();
        images.push(GrayImage::from_samples(640, 480, samples).unwrap());
    }
    for text in boards {
        let finder = BoardFinder::new(&text.parse().unwrap());
        for image in &images {
            assert!(finder.find(image).is_err(), "{text} in {}x{}", image.width(), image.height());
        }
    }
}

#[test]
fn first_corner_is_next_to_the_black_corner_square() {
    let board: Board = "chessboard:6x5:25mm".parse().unwrap();
    let scene = BoardScene::new(&board, &camera((640, 480), &[]), 3);
    let finder = BoardFinder::new(&board);
    for turn in 0..8 {
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.2 + f64::from(turn) * 0.785);
        let middle = turned * Vector3::new(0.0625, 0.05, 0.0);
        let pose = Isometry3::from_parts((Vector3::new(0.0, 0.0, 0.4) - middle).into(), turned);
        let found = finder.find(&scene.render(&pose, &BoardEffects::camera_like(2.0, 1))).unwrap();
        assert!(error_px(&found, &scene.true_view(&pose)) < 0.05, "turn {turn}");
    }
}

/// Images of a board from a few places.
fn shown(text: &str, count: usize) -> Vec<GrayImage> {
    let board: Board = text.parse().unwrap();
    let scene = BoardScene::new(&board, &camera((640, 480), &[-0.2, 0.05, 0.0, 0.0]), 3);
    let poses = scene.poses(count, Framing::Whole, 5);
    poses.iter().map(|pose| scene.render(pose, &BoardEffects::camera_like(2.0, 1))).collect()
}

#[test]
fn another_board_is_recognised_by_kind_count_and_dictionary() {
    for (expected, shows) in [
        ("chessboard:9x6:25mm", "chessboard:8x6:25mm"),
        ("chessboard:9x6:25mm", "charuco:8x11:25mm"),
        ("charuco:8x11:20mm", "chessboard:10x7:20mm"),
        ("charuco:8x11:20mm", "charuco:7x5:20mm:15mm:5x5_50"),
        ("charuco:7x5:20mm", "charuco:5x7:20mm:12mm:4x4_50"),
        ("aprilgrid:6x6:88mm", "charuco:6x8:88mm:66mm:apriltag_36h11"),
        ("charuco:6x8:25mm:18mm:6x6_250", "aprilgrid:4x3:25mm"),
        ("aprilgrid:6x6:88mm", "aprilgrid:4x3:88mm"),
        ("chessboard:9x6:20mm", "circles:7x5:20mm"),
        ("circles:7x5:20mm", "asymmetric-circles:4x11:20mm"),
        ("asymmetric-circles:4x11:20mm", "chessboard:7x5:20mm"),
    ] {
        let (expected, shows): (Board, Board) = (expected.parse().unwrap(), shows.parse().unwrap());
        let images = shown(&shows.to_string(), 4);
        let seen = seen_instead(&expected, &images).unwrap_or_else(|| panic!("{expected} for {shows}"));
        assert_eq!(seen.board.to_string(), shows.to_string(), "for {expected}");
        assert!(seen.images >= 3 && seen.of == 4, "{shows}: {seen}");
    }
}

#[test]
fn images_without_a_board_show_no_other_board() {
    let expected: Board = "chessboard:9x6:25mm".parse().unwrap();
    assert_eq!(seen_instead(&expected, &[GrayImage::new(320, 240)]), None);
    assert_eq!(seen_instead(&expected, &[]), None);
    // The board itself is no other board, nor is its upper part.
    assert_eq!(seen_instead(&expected, &shown("chessboard:9x6:25mm", 2)), None);
    let larger: Board = "charuco:6x9:25mm:18.75mm:4x4_100".parse().unwrap();
    assert_eq!(seen_instead(&larger, &shown("charuco:6x5:25mm", 2)), None);
}
