//! Blur of the board in an image.

use crate::BoardView;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use odograph::numerics::median;

/// Blur of the edges around the detected points: standard deviation of a Gaussian, pixels; median
/// over the points.
///
/// A step of height `h` blurred by a Gaussian with standard deviation σ has the maximum slope `h /
/// (σ √(2π))`. An ideally sharp sampled edge measures about half a pixel. `None` if no point has
/// enough contrast around it.
pub fn blur_px(image: &GrayImage, view: &BoardView) -> Option<f64> {
    let mut blurs: Vec<f64> = view
        .points
        .iter()
        .enumerate()
        .filter_map(|(place, seen)| {
            // Consecutive points are neighbours on the board, except from one row to the next.
            let near = |other: Option<usize>| {
                let other = view.points.get(other?)?;
                Some(other.pixel.distance(seen.pixel)).filter(|d| d.is_finite())
            };
            let spacing_px =
                near(place.checked_sub(1)).into_iter().chain(near(Some(place + 1))).reduce(f64::min)?;
            // Half a spacing reaches the edge of a disc, but at a chessboard corner no edges other
            // than those that meet there.
            blur_around(image, seen.pixel, (0.5 * spacing_px).clamp(3.0, 12.0) as isize)
        })
        .collect();
    median(&mut blurs)
}

/// Blur from the maximum slope and the contrast in a square window around a pixel.
fn blur_around(image: &GrayImage, at: Pixel, half: isize) -> Option<f64> {
    let (x, y) = (at.x.round() as isize, at.y.round() as isize);
    let inside = x - half >= 1
        && y - half >= 1
        && x + half + 1 < image.width() as isize
        && y + half + 1 < image.height() as isize;
    if !inside {
        return None;
    }
    let (mut low, mut high, mut steepest) = (u8::MAX, u8::MIN, 0);
    for row in y - half..=y + half {
        let row = row as usize;
        let (above, here, below) = (image.row(row - 1), image.row(row), image.row(row + 1));
        for column in (x - half) as usize..=(x + half) as usize {
            low = low.min(here[column]);
            high = high.max(here[column]);
            let dx = i32::from(here[column + 1]) - i32::from(here[column - 1]);
            let dy = i32::from(below[column]) - i32::from(above[column]);
            steepest = steepest.max(dx * dx + dy * dy);
        }
    }
    let contrast = f64::from(high) - f64::from(low);
    // Minimum contrast, gray levels; below it, sensor noise has slopes as steep as an edge.
    const MIN_CONTRAST: f64 = 20.0;
    let slope = 0.5 * f64::from(steepest).sqrt();
    (contrast >= MIN_CONTRAST).then(|| contrast / (slope * std::f64::consts::TAU.sqrt()))
}
