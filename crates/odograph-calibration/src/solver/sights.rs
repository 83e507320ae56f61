//! Validation of the input views and conversion to correspondences.

use super::bundle::BoardCorrespondence;
use crate::{Board, BoardView};
use nalgebra::{Matrix2, Vector2};
use odograph::error::{Error, Result};

/// The correspondences of one view, or the reason why the view is unusable.
pub type Sights = std::result::Result<Vec<BoardCorrespondence>, String>;

/// Two views are duplicates if the mean distance of their points is below this share of the image
/// diagonal.
const SAME: f64 = 0.004;

/// The correspondences of one view. Fails on NaN coordinates, positions far outside the image, and
/// indices that are duplicated or not on the board.
pub fn sights_of(board: &Board, view: &BoardView) -> Result<Vec<BoardCorrespondence>> {
    let points = board.points();
    let largest = |f: &dyn Fn(usize) -> f64| (0..points.len()).map(f).fold(0.0, f64::max).max(1e-12);
    let (half_x, half_y) = (largest(&|i| points[i].x_m) / 2.0, largest(&|i| points[i].y_m) / 2.0);
    let mut seen = vec![false; points.len()];
    let mut sights = Vec::with_capacity(view.points.len());
    for point in &view.points {
        let Some(on_board) = points.get(point.index) else {
            return Err(Error::input(format!(
                "point {} is not on the board {board}, which has {}; give the board that was photographed",
                point.index,
                points.len()
            )));
        };
        if std::mem::replace(&mut seen[point.index], true) {
            return Err(Error::input(format!("point {} is given twice; give each point once", point.index)));
        }
        let (x, y) = (point.pixel.x, point.pixel.y);
        let far = 10.0 * view.size.0.max(view.size.1) as f64;
        if !(x.abs() <= far && y.abs() <= far) {
            return Err(Error::input(format!(
                "point {} is at ({x}, {y}), which is no place in an image of {}x{}; leave out points that were not found",
                point.index, view.size.0, view.size.1
            )));
        }
        sights.push(BoardCorrespondence {
            index: point.index,
            on_board: (on_board.x_m, on_board.y_m),
            relative: (on_board.x_m / half_x - 1.0, on_board.y_m / half_y - 1.0),
            down_m: on_board.y_m - half_y,
            pixel: (x, y),
        });
    }
    Ok(sights)
}

/// The reason why the points of a view do not determine a pose, if any.
pub fn fault(sights: &[BoardCorrespondence]) -> Option<String> {
    if sights.len() < 4 {
        return Some(format!("only {} of the board's points are seen; four are needed", sights.len()));
    }
    if thickness(sights, |sight| sight.on_board) < 0.02 {
        return Some("the points seen lie on one line of the board; show more of it".to_owned());
    }
    if thickness(sights, |sight| sight.pixel) < 0.02 {
        return Some("the board is seen edge-on; turn it towards the camera".to_owned());
    }
    (handedness(sights) <= 0.0).then(|| "the board is seen mirrored; mirror the picture back".to_owned())
}

/// Aspect ratio of a point cloud: smaller over larger standard deviation along its principal axes.
fn thickness(sights: &[BoardCorrespondence], place: impl Fn(&BoardCorrespondence) -> (f64, f64)) -> f64 {
    let spread = covariance(sights, &place, &place);
    let eigen = spread.symmetric_eigenvalues();
    (eigen.min().max(0.0) / eigen.max().max(1e-300)).sqrt()
}

fn covariance(
    sights: &[BoardCorrespondence],
    a: &dyn Fn(&BoardCorrespondence) -> (f64, f64),
    b: &dyn Fn(&BoardCorrespondence) -> (f64, f64),
) -> Matrix2<f64> {
    let count = sights.len().max(1) as f64;
    let vector = |(x, y): (f64, f64)| Vector2::new(x, y);
    let mean = |f: &dyn Fn(&BoardCorrespondence) -> (f64, f64)| {
        sights.iter().map(|s| vector(f(s))).sum::<Vector2<f64>>() / count
    };
    let (mean_a, mean_b) = (mean(a), mean(b));
    let product = |s: &BoardCorrespondence| (vector(a(s)) - mean_a) * (vector(b(s)) - mean_b).transpose();
    sights.iter().map(product).sum::<Matrix2<f64>>() / count
}

/// Positive if the board is seen from its printed side: sign of the determinant of the best-fitting
/// affine map from board to image.
fn handedness(sights: &[BoardCorrespondence]) -> f64 {
    // The map is C_pb C_bb⁻¹, and C_bb is positive definite.
    covariance(sights, &|s| s.pixel, &|s| s.on_board).determinant()
}

/// The common image size, and for each view its correspondences or the reason why it is unusable.
///
/// Fails if the sizes differ, if a view has invalid points, or if too few usable views remain.
pub fn gather(board: &Board, views: &[BoardView]) -> Result<((usize, usize), Vec<Sights>)> {
    let Some(first) = views.first() else {
        return Err(Error::input(
            "there is no view of the board; film it, whole and sharp, from ten or more sides",
        ));
    };
    let size = first.size;
    if size.0 == 0 || size.1 == 0 {
        return Err(Error::input(format!("an image size of {}x{} is not usable", size.0, size.1)));
    }
    if let Some(other) = views.iter().position(|view| view.size != size) {
        let (w, h) = views[other].size;
        return Err(Error::input(format!(
            "view {} is {w}x{h} but the first is {}x{}; calibrate each image size on its own",
            other + 1,
            size.0,
            size.1
        )));
    }
    let mut all = Vec::with_capacity(views.len());
    for (number, view) in views.iter().enumerate() {
        let sights = sights_of(board, view).map_err(|error| error.at(format!("view {}", number + 1)))?;
        all.push(match fault(&sights) {
            Some(why) => Err(why),
            None => Ok(sights),
        });
    }
    enough(&all, size)?;
    Ok((size, all))
}

/// Fails if the usable views are too few or too similar to determine a camera.
fn enough(all: &[Sights], size: (usize, usize)) -> Result<()> {
    let usable: Vec<&[BoardCorrespondence]> =
        all.iter().filter_map(|sights| sights.as_deref().ok()).collect();
    if usable.is_empty() {
        let mirrored = all.iter().filter(|s| matches!(s, Err(why) if why.contains("mirrored"))).count();
        if mirrored == all.len() {
            return Err(Error::input(
                "every view shows the board mirrored; turn mirroring off in the camera or mirror the pictures back",
            ));
        }
        let why = all.iter().find_map(|sights| sights.as_ref().err()).map_or("", String::as_str);
        return Err(Error::input(format!("no view can be used: {why} (view 1)")));
    }
    let distinct = distinct(&usable, size);
    if usable.len() >= 3 && distinct < 3 {
        return Err(Error::input(format!(
            "all {} views show the board in the same place; move and tilt it between them, at least ten different ways",
            usable.len()
        )));
    }
    if usable.len() < 3 {
        return Err(Error::input(format!(
            "only {} {} can be used; three are the least, ten with different tilts are good",
            usable.len(),
            if usable.len() == 1 { "view" } else { "views" }
        )));
    }
    Ok(())
}

/// Number of distinct views, counted greedily, up to a limit of 50.
pub fn distinct(views: &[&[BoardCorrespondence]], size: (usize, usize)) -> usize {
    let near_px = SAME * (size.0 as f64).hypot(size.1 as f64);
    let mut kept: Vec<&[BoardCorrespondence]> = Vec::new();
    for view in views {
        // Larger counts are not needed.
        if kept.len() >= 50 {
            break;
        }
        if !kept.iter().any(|other| apart_px(view, other) < near_px) {
            kept.push(view);
        }
    }
    kept.len()
}

/// Mean distance between the common points of two views, pixels; infinite if they have none in
/// common.
fn apart_px(a: &[BoardCorrespondence], b: &[BoardCorrespondence]) -> f64 {
    let (mut sum, mut count, mut at) = (0.0, 0.0, 0);
    // Assumes that the points are sorted by index, as a finder returns them. Unsorted points only
    // make the views appear more different.
    for sight in a {
        while at < b.len() && b[at].index < sight.index {
            at += 1;
        }
        if let Some(other) = b.get(at).filter(|other| other.index == sight.index) {
            sum += (sight.pixel.0 - other.pixel.0).hypot(sight.pixel.1 - other.pixel.1);
            count += 1.0;
        }
    }
    if count > 0.0 { sum / count } else { f64::INFINITY }
}
