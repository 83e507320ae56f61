//! Sub-pixel corners of rendered squares with exact ground truth.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a panic fails the test

use super::subpixel;
use crate::test_random::gaussian;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use odograph::motion::Random;

/// A rendered plane with 6x6 samples per pixel, Gaussian blur and noise.
struct PlaneScene<'a> {
    size: (usize, usize),
    /// Maps a pixel to square coordinates, with the corners at integers.
    at: &'a dyn Fn(f64, f64) -> (f64, f64),
    /// Gray level at square coordinates.
    gray: &'a dyn Fn(f64, f64) -> f64,
    blur_px: f64,
    noise: f64,
    seed: u64,
}

impl PlaneScene<'_> {
    fn render(&self) -> GrayImage {
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
        let mut random = Random::new(self.seed);
        let samples = plane
            .iter()
            .map(|value| (value + self.noise * gaussian(&mut random)).round().clamp(0.0, 255.0) as u8)
            .collect();
        GrayImage::from_samples(width, height, samples).unwrap()
    }
}

/// An infinite chessboard pattern.
fn squares(x: f64, y: f64) -> f64 {
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
                PlaneScene { size: (120, 120), at: &at, gray: &gray, blur_px, noise, seed: 7 + turn as u64 }
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

#[test]
fn a_single_marker_is_found_with_its_number_corners_and_orientation() {
    use crate::{MarkerFamily, MarkerFinder};
    let mut squares = Vec::new();
    for text in ["apriltag:36h11:80mm", "aruco:4x4_50:80mm", "aruco:6x6_250:80mm"] {
        let family: MarkerFamily = text.parse().unwrap();
        let finder = MarkerFinder::new(&family);
        for (number, turn) in [(0, 0.2f64), (7, 2.0), (49, 4.1)] {
            let side_px = 60.0;
            let (sin, cos) = turn.sin_cos();
            let at = |x: f64, y: f64| {
                let (dx, dy) = ((x - 100.3) / side_px, (y - 90.6) / side_px);
                (cos * dx + sin * dy + 0.5, cos * dy - sin * dx + 0.5)
            };
            let gray = |x: f64, y: f64| {
                let sheet = (-0.2..1.2).contains(&x) && (-0.2..1.2).contains(&y);
                match (sheet, family.is_black(number, x, y)) {
                    (true, true) => 30.0,
                    (true, false) => 220.0,
                    (false, _) => 110.0,
                }
            };
            let scene =
                PlaneScene { size: (200, 180), at: &at, gray: &gray, blur_px: 0.7, noise: 2.0, seed: 3 };
            let seen = finder.find(&scene.render(), 20.0);
            assert!(seen.len() == 1 && seen[0].number == number, "{text} {number}: {seen:?}");
            let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
            for (corner, (x, y)) in seen[0].corners.iter().zip(corners) {
                let off = at(corner.x, corner.y);
                let off_px = side_px * (off.0 - x).hypot(off.1 - y);
                assert!(off_px < 0.6, "{text} {number}: {off_px} px");
                squares.push(off_px * off_px);
            }
            assert!(finder.find(&scene.render(), 90.0).is_empty());
        }
    }
    // Landmarks take a corner to have 0.2 px along each axis.
    let sigma_px = (squares.iter().sum::<f64>() / (2 * squares.len()) as f64).sqrt();
    assert!(sigma_px < 0.2, "{sigma_px} px");
}
