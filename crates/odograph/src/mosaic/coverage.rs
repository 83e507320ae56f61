//! Coarse coverage of the ground: enough to choose the few frames of which a mosaic is made.

use super::footprint::{Footprint, GroundCamera};
use crate::camera::Camera;
use crate::geometry::{GroundPoint, GroundPose, Pixel, Ray};
use std::collections::BTreeMap;

/// Sample points along each side of an image whose ground is looked up: more find narrower strips
/// of new ground and take longer.
const POINTS: usize = 16;
/// Cells along the longer side of the first footprint: the finest strip of new ground that counts.
const CELLS: f64 = 32.0;
/// Cells along each side of a square that shares a word.
const SQUARE: i64 = 8;
/// A change of the ground resolution by this factor starts a new grid, whose cells fit the
/// footprint again.
const OTHER_SCALE: f64 = 4.0;
/// Cells farther than this from the origin are not addressed.
const FARTHEST_CELL: f64 = 1e12;

/// The ground that frames of one camera have shown, as cells a thirty-second of a frame wide: a bit
/// each, where there are any.
///
/// Every frame is tested for new ground, which takes some hundred lookups. Cells are seen
/// where their middle is inside an image.
#[derive(Debug, Clone)]
pub struct Coverage {
    camera: Camera,
    /// The rays of pixels spread evenly over the image.
    rays: Vec<Ray>,
    footprint: Option<Footprint>,
    /// Side of a cell, metres; known from the first frame on.
    side_m: Option<f64>,
    seen: BTreeMap<(i64, i64), u64>,
}

impl Coverage {
    /// Empty coverage.
    pub fn new(camera: &Camera) -> Self {
        let at = |index: usize, size: usize| (index as f64 + 0.5) * size as f64 / POINTS as f64 - 0.5;
        let ray = |k: usize| {
            let (column, row) = (k % POINTS, k / POINTS);
            camera.ray_from_pixel(Pixel::new(at(column, camera.width()), at(row, camera.height())))
        };
        Self {
            camera: camera.clone(),
            rays: (0..POINTS * POINTS).filter_map(ray).collect(),
            footprint: None,
            side_m: None,
            seen: BTreeMap::new(),
        }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.side_m = None;
        self.seen.clear();
    }

    /// The share of a frame from this pose, 0 to 1, whose ground is in neither this coverage nor
    /// `other`; 0 where the camera does not see the ground.
    pub fn share_new(&self, other: Option<&Self>, pose: &GroundPose) -> f64 {
        let Some(view) = GroundCamera::new(&self.camera, pose) else { return 0.0 };
        let (mut points, mut new) = (0, 0);
        for ray in &self.rays {
            let Some(point) = pose.ground_from_ray(*ray).filter(|point| view.look(*point).is_some()) else {
                continue;
            };
            points += 1;
            new += i32::from(!self.has(point) && other.is_none_or(|other| !other.has(point)));
        }
        f64::from(new) / f64::from(points.max(1))
    }

    /// Adds what a frame from this pose shows.
    pub fn add(&mut self, pose: &GroundPose) {
        let Some(view) = GroundCamera::new(&self.camera, pose) else { return };
        let own_m = view.centre_resolution_m() * self.camera.width().max(self.camera.height()) as f64 / CELLS;
        if self.side_m.is_some_and(|side_m| (own_m / side_m).max(side_m / own_m) > OTHER_SCALE) {
            self.side_m = None;
            self.seen.clear();
        }
        let side_m = *self.side_m.get_or_insert(own_m);
        let Some((low, high)) = Footprint::of(&mut self.footprint, &self.camera).bounds(&view) else {
            return;
        };
        let farthest = [low.x_m, low.y_m, high.x_m, high.y_m].iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        if farthest / side_m > FARTHEST_CELL {
            return;
        }
        let (right, bottom) = (self.camera.width() as f64 - 0.5, self.camera.height() as f64 - 0.5);
        for row in cell(low.y_m, side_m)..=cell(high.y_m, side_m) {
            for column in cell(low.x_m, side_m)..=cell(high.x_m, side_m) {
                let middle = |index: i64| (index as f64 + 0.5) * side_m;
                let look = view.look(GroundPoint::new(middle(column), middle(row)));
                if look.is_some_and(|at| at.x >= -0.5 && at.y >= -0.5 && at.x <= right && at.y <= bottom) {
                    let (square, bit) = place(column, row);
                    *self.seen.entry(square).or_insert(0) |= bit;
                }
            }
        }
    }

    fn has(&self, point: GroundPoint) -> bool {
        let Some(side_m) = self.side_m else { return false };
        let (square, bit) = place(cell(point.x_m, side_m), cell(point.y_m, side_m));
        self.seen.get(&square).is_some_and(|seen| seen & bit != 0)
    }
}

/// The cell on one axis that holds a coordinate.
fn cell(metres: f64, side_m: f64) -> i64 {
    (metres / side_m).floor() as i64
}

/// The square of a cell, and its bit there.
fn place(column: i64, row: i64) -> ((i64, i64), u64) {
    let square = (column.div_euclid(SQUARE), row.div_euclid(SQUARE));
    (square, 1 << (SQUARE * row.rem_euclid(SQUARE) + column.rem_euclid(SQUARE)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x_m: f64, heading_rad: f64) -> GroundPose {
        GroundPose { x_m, heading_rad, ..GroundPose::level(1.0) }
    }

    #[test]
    fn what_is_new_is_what_the_frame_has_moved_by() {
        // 1.2 m by 0.9 m; the image's up is world x, so moving along x shows new rows.
        let camera = Camera::from_field_of_view((640, 480), (1.2, 0.9), 1.0).unwrap();
        let mut coverage = Coverage::new(&camera);
        assert_eq!(coverage.share_new(None, &at(0.0, 0.0)), 1.0);
        coverage.add(&at(0.0, 0.0));
        assert_eq!(coverage.share_new(None, &at(0.0, 0.0)), 0.0);
        for moved_m in [0.1, 0.3, 0.6, 0.85] {
            let share = coverage.share_new(None, &at(moved_m, 0.0));
            // Known to a row of points, a sixteenth.
            assert!((share - moved_m / 0.9).abs() < 0.07, "{share} after {moved_m} m");
        }
        let mut further = Coverage::new(&camera);
        further.add(&at(0.3, 0.0));
        assert!(coverage.share_new(Some(&further), &at(0.3, 0.0)) < 0.01);
        // A quarter turn shows 1.2 m where 0.9 m were seen.
        let turned = coverage.share_new(None, &at(0.0, std::f64::consts::FRAC_PI_2));
        assert!((turned - 0.25).abs() < 0.07, "{turned}");
    }

    #[test]
    fn a_tilted_camera_shows_nothing_and_a_climbing_one_starts_anew() {
        let camera = Camera::from_field_of_view((640, 480), (1.2, 0.9), 1.0).unwrap();
        let mut coverage = Coverage::new(&camera);
        let away = GroundPose { pitch_rad: -1.6, ..GroundPose::level(1.0) };
        coverage.add(&away);
        assert_eq!(coverage.share_new(None, &away), 0.0);
        coverage.add(&GroundPose::level(1.0));
        coverage.add(&GroundPose::level(100.0));
        assert_eq!(coverage.share_new(None, &GroundPose::level(100.0)), 0.0);
        assert!(coverage.seen.len() < 40, "{} squares", coverage.seen.len());
        coverage.add(&GroundPose { x_m: f64::INFINITY, ..GroundPose::level(1.0) });
        coverage.add(&GroundPose { x_m: 1e300, ..GroundPose::level(1.0) });
    }
}
