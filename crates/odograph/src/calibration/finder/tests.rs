//! Detection in rendered boards with exact ground truth.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a panic fails the test

use super::{BoardFinder, NotFound, subpixel};
use crate::calibration::{Board, BoardView};
use crate::camera::{Camera, Distortion};
use crate::geometry::Pixel;
use crate::image::GrayImage;
use crate::simulation::{BoardEffects, BoardScene, Framing, Occlusion};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// A rendered plane with 6x6 samples per pixel, Gaussian blur and noise.
pub(super) struct Scene<'a> {
    pub size: (usize, usize),
    /// Maps a pixel to square coordinates, with the corners at integers.
    pub at: &'a dyn Fn(f64, f64) -> (f64, f64),
    /// Gray level at square coordinates.
    pub gray: &'a dyn Fn(f64, f64) -> f64,
    pub blur_px: f64,
    pub noise: f64,
    pub seed: u64,
}

/// SplitMix64: the same noise on every platform.
pub(super) struct Random(pub u64);

impl Random {
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal random number (Box–Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

impl Scene<'_> {
    pub fn render(&self) -> GrayImage {
        let (width, height) = self.size;
        let mut plane = vec![0.0; width * height];
        const SIDE: usize = 6;
        for (i, value) in plane.iter_mut().enumerate() {
            for j in 0..SIDE * SIDE {
                let dx = ((j % SIDE) as f64 + 0.5) / SIDE as f64 - 0.5;
                let dy = ((j / SIDE) as f64 + 0.5) / SIDE as f64 - 0.5;
                let (x, y) = (self.at)((i % width) as f64 + dx, (i / width) as f64 + dy);
                *value += (self.gray)(x, y) / (SIDE * SIDE) as f64;
            }
        }
        if self.blur_px > 0.0 {
            let radius = (4.0 * self.blur_px).ceil() as isize;
            let kernel: Vec<f64> =
                (-radius..=radius).map(|d| (-0.5 * (d as f64 / self.blur_px).powi(2)).exp()).collect();
            let total: f64 = kernel.iter().sum();
            for (along, across, length, count) in [(1, width, width, height), (width, 1, height, width)] {
                for line in 0..count {
                    let values: Vec<f64> = (0..length).map(|i| plane[line * across + i * along]).collect();
                    for i in 0..length {
                        plane[line * across + i * along] = (0..kernel.len())
                            .map(|k| {
                                let from = (i as isize + k as isize - radius).clamp(0, length as isize - 1);
                                kernel[k] * values[from as usize] / total
                            })
                            .sum();
                    }
                }
            }
        }
        let mut random = Random(self.seed);
        let samples = plane
            .iter()
            .map(|value| (value + self.noise * random.normal()).round().clamp(0.0, 255.0) as u8)
            .collect();
        GrayImage::from_samples(width, height, samples).unwrap()
    }
}

/// An infinite chessboard pattern.
pub(super) fn squares(x: f64, y: f64) -> f64 {
    if (x.floor() as i64 + y.floor() as i64) % 2 == 0 { 40.0 } else { 210.0 }
}

/// RMS error of the fit over the corners of rotated and foreshortened squares.
#[test]
fn corner_errors_are_small_under_blur_noise_and_illumination_gradients() {
    for (blur_px, noise, light, limit_px) in
        [(0.5, 0.0, 0.0, 0.012), (0.7, 2.0, 0.0, 0.02), (0.7, 2.0, 0.4, 0.02), (1.5, 2.0, 0.0, 0.03)]
    {
        let mut errors = Vec::new();
        for turn in 0..6 {
            let (sine, cosine) = (0.11 + 0.26 * f64::from(turn)).sin_cos();
            let (long, short) = (24.0, 18.0);
            let at = |x: f64, y: f64| {
                let (x, y) = (x - 61.3, y - 58.6);
                ((cosine * x + sine * y) / long, (cosine * y - sine * x) / short)
            };
            let gray = |x: f64, y: f64| squares(x, y) * (1.0 - light * (0.2 * x + 0.1 * y));
            let image =
                Scene { size: (120, 120), at: &at, gray: &gray, blur_px, noise, seed: 7 + turn as u64 }
                    .render();
            for (i, j) in (-1..=1).flat_map(|i| (-1..=1).map(move |j| (f64::from(i), f64::from(j)))) {
                let truth = Pixel::new(
                    61.3 + cosine * i * long - sine * j * short,
                    58.6 + sine * i * long + cosine * j * short,
                );
                let start = Pixel::new(truth.x.round() + 1.0, truth.y.round() - 1.0);
                let found = subpixel::fit(&image, start, 8.0).expect("a corner").pixel;
                errors.push(found.distance(truth).powi(2));
            }
        }
        let rms_px = (errors.iter().sum::<f64>() / errors.len() as f64).sqrt();
        println!("blur {blur_px} noise {noise} light {light}: {rms_px:.4} px");
        assert!(rms_px < limit_px, "blur {blur_px}, noise {noise}, light {light}: {rms_px} px");
    }
}

#[test]
fn no_corner_on_edges_uniform_areas_or_outside_the_image() {
    let image = |gray: &dyn Fn(usize, usize) -> u8| {
        GrayImage::from_samples(40, 40, (0..1600).map(|i| gray(i % 40, i / 40)).collect()).unwrap()
    };
    let plane = image(&|_, _| 90);
    let edge = image(&|x, _| if x < 20 { 20 } else { 200 });
    let bend = image(&|x, y| if x < 20 || y < 20 { 20 } else { 200 });
    for (name, image) in [("plane", &plane), ("edge", &edge), ("bend", &bend)] {
        assert_eq!(subpixel::fit(image, Pixel::new(20.0, 20.0), 8.0), None, "{name}");
    }
    for start in [(0.0, 0.0), (-5.0, 20.0), (39.9, 39.9), (f64::NAN, 3.0), (1e300, 3.0)] {
        assert_eq!(subpixel::fit(&bend, Pixel::new(start.0, start.1), 8.0), None);
    }
    assert_eq!(subpixel::fit(&GrayImage::new(1, 1), Pixel::new(0.0, 0.0), 8.0), None);
    assert_eq!(subpixel::fit(&bend, Pixel::new(20.0, 20.0), f64::NAN), None);
}

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
    let mut random = Random(5);
    let mut images = Vec::new();
    for (width, height) in [(0, 0), (1, 1), (3, 2), (17, 17), (1, 500), (640, 480)] {
        images.push(GrayImage::new(width, height));
        images.push(GrayImage::from_samples(width, height, vec![255; width * height]).unwrap());
        let noise = (0..width * height).map(|_| (256.0 * random.unit()) as u8).collect();
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
