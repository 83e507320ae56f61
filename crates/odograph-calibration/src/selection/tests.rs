//! Views from a pinhole camera with slight distortion, without images.

use super::*;
use crate::{BoardView, SeenPoint};
use nalgebra::{Rotation3, Vector3};
use odograph::camera::{Camera, Distortion};
use odograph::geometry::{Pixel, Ray};
use odograph::image::GrayImage;

fn board() -> Board {
    "chessboard:9x6:25mm".parse().unwrap()
}

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.1, 0.02, 0.0, 0.0]).unwrap();
    Camera::new((640, 480), (600.0, 600.0), (319.5, 239.5), distortion).unwrap()
}

/// A view with the middle of the board at (x, y, z), metres, and rotations about x, y and z,
/// degrees.
fn view(at: [f64; 3], turned_deg: [f64; 3]) -> Option<BoardView> {
    let [x, y, z] = turned_deg.map(f64::to_radians);
    let rotation = Rotation3::from_euler_angles(x, y, z);
    let camera = camera();
    let points = board().points();
    let seen: Option<Vec<SeenPoint>> = points
        .iter()
        .enumerate()
        .map(|(index, point)| {
            let p = rotation * Vector3::new(point.x_m - 0.1, point.y_m - 0.0625, 0.0) + Vector3::from(at);
            let pixel = camera.pixel_from_ray(Ray::new(p.x / p.z, p.y / p.z))?;
            camera.contains(pixel, 5.0).then_some(SeenPoint { index, pixel })
        })
        .collect();
    Some(BoardView { size: (640, 480), points: seen? })
}

fn picture(number: u64, view: BoardView) -> Sighting {
    Sighting { number, time_s: None, view, blur_px: None }
}

fn selector_of(views: impl IntoIterator<Item = BoardView>) -> ViewSelector {
    let mut selector = ViewSelector::new(&board(), SelectionConfig::default());
    views.into_iter().enumerate().for_each(|(number, view)| selector.add(picture(number as u64, view)));
    selector
}

/// Views that cover the whole image, near and far, with tilts about both axes.
fn thorough() -> Vec<BoardView> {
    let mut views = Vec::new();
    for (n, (x, y)) in [-0.14, 0.0, 0.14].iter().flat_map(|x| [-0.1, 0.0, 0.1].map(|y| (*x, y))).enumerate() {
        for (z, tilt) in [(0.42, 0.0), (0.45, 25.0), (0.55, -30.0)] {
            let turn = if n % 2 == 0 { [tilt, 0.0, 0.0] } else { [0.0, tilt, 10.0] };
            views.extend(view([x * z / 0.5, y * z / 0.5, z], turn));
        }
    }
    views.extend(view([0.0, 0.0, 0.3], [0.0, 0.0, 0.0]));
    views
}

#[test]
fn nominal_focal_length_and_pose_are_approximately_right() {
    let selector = selector_of(thorough());
    let focal_px = selector.focal_px();
    // The model without distortion is biased by a few per cent; that is sufficient for the
    // selection.
    assert!((focal_px - 600.0).abs() < 60.0, "{focal_px}");
    let seen = NominalView::new(&board(), &view([0.05, 0.0, 0.5], [30.0, 0.0, 0.0]).unwrap()).unwrap();
    let pose = seen.pose(600.0).unwrap();
    assert!((pose.normal().y.atan2(pose.normal().z).to_degrees() + 30.0).abs() < 3.0, "{pose:?}");
}

#[test]
fn guidance_names_exactly_what_is_missing() {
    let guidance = selector_of(thorough()).guidance();
    assert_eq!(guidance.missing, [], "{guidance:?}");
    assert!(guidance.coverage.share() > 0.8);

    let flat =
        [-0.1, 0.0, 0.1].iter().flat_map(|x| [-0.08, 0.0, 0.08].map(|y| view([*x, y, 0.42], [0.0; 3])));
    let missing = selector_of(flat.flatten()).guidance().missing;
    assert!(missing.contains(&Hint::Tilt(Direction::Sideways)), "{missing:?}");
    assert!(missing.contains(&Hint::Tilt(Direction::UpAndDown)), "{missing:?}");

    let left = thorough().into_iter().filter(|view| view.points.iter().all(|p| p.pixel.x < 400.0));
    let missing = selector_of(left).guidance().missing;
    assert!(missing.contains(&Hint::GoTo(Region { column: 2, row: 0 })), "{missing:?}");
    assert!(!missing.contains(&Hint::GoTo(Region { column: 0, row: 0 })), "{missing:?}");

    let far = [0.0, 20.0, 40.0, 60.0].iter().filter_map(|turn| view([0.0, 0.0, 1.5], [0.0, *turn, 0.0]));
    let missing = selector_of(far).guidance().missing;
    assert!(missing.contains(&Hint::ComeCloser) && missing.contains(&Hint::MoreViews(8)), "{missing:?}");
    assert_eq!(
        Hint::GoTo(Region { column: 0, row: 0 }).to_string(),
        "hold the board at the top left of the image"
    );
    // Guidance is also available without any view.
    let nothing = selector_of([]).guidance();
    assert!(nothing.missing.contains(&Hint::MoreViews(12)) && nothing.coverage.share() == 0.0);
}

#[test]
fn similar_views_are_kept_once_and_still_ones_preferred() {
    let mut selector = ViewSelector::new(&board(), SelectionConfig::default());
    // The board rests at two places and moves quickly in between.
    let mut number = 0;
    let mut add = |selector: &mut ViewSelector, x: f64| {
        let view = view([x, 0.0, 0.5], [20.0, 0.0, 0.0]).unwrap();
        selector.add(Sighting { number, time_s: Some(number as f64 / 30.0), view, blur_px: None });
        number += 1;
    };
    for step in 0..30 {
        add(&mut selector, -0.1 + 0.0001 * f64::from(step % 2));
    }
    for step in 0..10 {
        add(&mut selector, -0.1 + 0.018 * f64::from(step));
    }
    for _ in 0..30 {
        add(&mut selector, 0.09);
    }
    let chosen: Vec<u64> = selector.chosen().iter().map(|sighting| sighting.number).collect();
    assert!((5..=8).contains(&chosen.len()), "{chosen:?}");
    assert!(chosen.iter().any(|&n| n < 30), "the first rest: {chosen:?}");
    assert!(chosen.iter().any(|&n| n > 40), "the second rest: {chosen:?}");
    assert_eq!(selector.sightings(), 70);
}

#[test]
fn selection_prefers_informative_views() {
    // A hundred fronto-parallel views in the middle that differ only in distance, then the tilted
    // and off-centre ones.
    let dull = (0..100).filter_map(|n| view([0.0, 0.0, 0.5 + 0.02 * f64::from(n)], [0.0; 3]));
    let telling = thorough();
    let mut selector = ViewSelector::new(&board(), SelectionConfig { most_views: 15, ..Default::default() });
    let count = dull.clone().count() as u64;
    dull.chain(telling).enumerate().for_each(|(n, view)| selector.add(picture(n as u64, view)));
    let chosen = selector.chosen();
    assert_eq!(chosen.len(), 15);
    let dull_chosen = chosen.iter().filter(|sighting| sighting.number < count).count();
    assert!(dull_chosen <= 2, "{dull_chosen} of the dull views");
    assert!(chosen.windows(2).all(|pair| pair[0].number < pair[1].number));
}

#[test]
fn memory_is_bounded() {
    let mut selector = ViewSelector::new(
        &"chessboard:3x2:25mm".parse().unwrap(),
        SelectionConfig { alike_displacement: 0.0, ..Default::default() },
    );
    let corner = |n: u64, index: usize| {
        let (column, row) = ((index % 3) as f64, (index / 3) as f64);
        let shift = (n % 97) as f64;
        Pixel::new(50.0 + shift + 40.0 * column + 0.03 * n as f64 * row, 60.0 + shift + 45.0 * row + column)
    };
    for n in 0..1500 {
        let points = (0..6).map(|index| SeenPoint { index, pixel: corner(n, index) }).collect();
        selector.add(picture(n, BoardView { size: (640, 480), points }));
    }
    assert!(selector.kept.len() <= MAX_KEPT);
    assert_eq!(selector.chosen().len(), 60);
}

#[test]
fn degenerate_points_are_ignored() {
    let line = |y: f64| BoardView {
        size: (640, 480),
        points: (0..9).map(|index| SeenPoint { index, pixel: Pixel::new(20.0 * index as f64, y) }).collect(),
    };
    let none = BoardView { size: (640, 480), points: vec![] };
    let wild = BoardView {
        size: (640, 480),
        points: (0..54).map(|index| SeenPoint { index, pixel: Pixel::new(f64::NAN, 1e300) }).collect(),
    };
    let selector = selector_of([line(3.0), none, wild, line(70.0)]);
    assert_eq!((selector.sightings(), selector.chosen().len()), (4, 0));
}

#[test]
fn blur_is_measured_in_pixels() {
    // Squares of 20 px with Gaussian edges.
    let blurred = |sigma: f64| {
        let step = |at: f64| {
            let near = (at / 20.0).round() * 20.0;
            let sign = if (at / 20.0).round().rem_euclid(2.0) < 1.0 { 1.0 } else { -1.0 };
            sign * ((at - near) / sigma * 0.851).tanh().clamp(-1.0, 1.0)
        };
        let samples = (0..200 * 200).map(|i| {
            let (x, y) = (f64::from(i % 200), f64::from(i / 200));
            (128.0 + 90.0 * step(x) * step(y)) as u8
        });
        GrayImage::from_samples(200, 200, samples.collect()).unwrap()
    };
    let points = (0..54)
        .map(|index| SeenPoint {
            index,
            pixel: Pixel::new(20.0 * (index % 9 + 1) as f64, 20.0 * (index / 9 + 1) as f64),
        })
        .collect();
    let view = BoardView { size: (200, 200), points };
    let (sharp, soft) = (blur_px(&blurred(0.7), &view).unwrap(), blur_px(&blurred(3.0), &view).unwrap());
    // tanh approximates the Gaussian step, so only the order of magnitude and the ratio are tested.
    assert!(
        (0.4..1.2).contains(&sharp) && (2.0..4.0).contains(&soft) && soft > 2.0 * sharp,
        "{sharp} {soft}"
    );
    assert_eq!(blur_px(&GrayImage::new(200, 200), &view), None);
}
