//! What a view teaches about the lens: its Fisher information, with the board's pose left free.

use super::guidance::Coverage;
use super::nominal::Seen;
use nalgebra::{SMatrix, SVector, Vector3};

/// Focal lengths, principal point, three radial and two tangential coefficients.
const UNKNOWNS: usize = 9;
type Information = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// What one view adds.
#[derive(Debug, Clone)]
pub struct Lesson {
    information: Information,
    /// The cells of the image it covers.
    cells: Vec<usize>,
}

impl Seen {
    /// What the view teaches, for corners that are `noise_px` unsure and a lens around a pinhole of the nominal focal length.
    ///
    /// The unknowns are made alike in size: the focal lengths and the principal point count in focal lengths.
    pub fn lesson(&self, focal_px: f64, noise_px: f64) -> Lesson {
        let cells = Coverage::cells_of(self.size, self.points.iter().map(|(_, pixel)| *pixel));
        let mut lesson = Lesson { information: Information::zeros(), cells };
        let Some(pose) = self.pose(focal_px) else { return lesson };
        let mut lens = Information::zeros();
        let mut mixed = SMatrix::<f64, UNKNOWNS, 6>::zeros();
        let mut posed = SMatrix::<f64, 6, 6>::zeros();
        for (point, _) in &self.points {
            let turned = pose.camera_from_board * Vector3::new(point.x_m, point.y_m, 0.0);
            let at = turned + pose.translation_m;
            if at.z <= 0.0 {
                continue;
            }
            let (x, y) = (at.x / at.z, at.y / at.z);
            let r2 = x * x + y * y;
            let radial = [r2, r2 * r2, r2 * r2 * r2];
            let (dx, dy) = (
                // By translation: the derivative of x/z; by rotation: that of the turned point, cross product.
                Vector3::new(1.0, 0.0, -x) / at.z,
                Vector3::new(0.0, 1.0, -y) / at.z,
            );
            let rows = [
                (
                    [
                        x,
                        0.0,
                        1.0,
                        0.0,
                        x * radial[0],
                        x * radial[1],
                        x * radial[2],
                        2.0 * x * y,
                        r2 + 2.0 * x * x,
                    ],
                    dx,
                ),
                (
                    [
                        0.0,
                        y,
                        0.0,
                        1.0,
                        y * radial[0],
                        y * radial[1],
                        y * radial[2],
                        r2 + 2.0 * y * y,
                        2.0 * x * y,
                    ],
                    dy,
                ),
            ];
            for (by_lens, by_point) in rows {
                let by_lens = SVector::<f64, UNKNOWNS>::from(by_lens);
                let by_turn = turned.cross(&by_point);
                let by_pose = SVector::<f64, 6>::from([
                    by_turn.x, by_turn.y, by_turn.z, by_point.x, by_point.y, by_point.z,
                ]);
                lens.ger(1.0, &by_lens, &by_lens, 1.0);
                mixed.ger(1.0, &by_lens, &by_pose, 1.0);
                posed.ger(1.0, &by_pose, &by_pose, 1.0);
            }
        }
        // The pose is not known: what the view says about it is taken away (Schur complement).
        if let Some(inverse) = posed.try_inverse() {
            let left = lens - mixed * inverse * mixed.transpose();
            let weight = (focal_px / noise_px).powi(2);
            if left.iter().all(|v| v.is_finite()) {
                lesson.information = 0.5 * weight * (left + left.transpose());
            }
        }
        lesson
    }
}

/// What is known about the lens after some views.
pub struct Knowledge {
    information: Information,
    log_determinant: f64,
    covered: Vec<bool>,
}

/// What covering one cell of the image for the first time is worth, in units of information (nats). Information alone already goes
/// to the corners; this keeps it from leaving out places that the nominal lens thinks it knows.
const WORTH_OF_A_CELL: f64 = 0.1;

impl Knowledge {
    /// What is known of any lens: its unknowns to within a half, in units of the focal length.
    pub fn new() -> Self {
        let information = Information::identity() * 4.0;
        let log_determinant = log_determinant(&information);
        Self { information, log_determinant, covered: vec![false; Coverage::CELLS] }
    }

    /// What a lesson would add.
    pub fn gain(&self, lesson: &Lesson) -> f64 {
        let cells = lesson.cells.iter().filter(|&&cell| !self.covered[cell]).count();
        log_determinant(&(self.information + lesson.information)) - self.log_determinant
            + WORTH_OF_A_CELL * cells as f64
    }

    /// Takes it in.
    pub fn learn(&mut self, lesson: &Lesson) {
        self.information += lesson.information;
        self.log_determinant = log_determinant(&self.information);
        lesson.cells.iter().for_each(|&cell| self.covered[cell] = true);
    }
}

/// Of a positive definite matrix; what rounding has made indefinite counts as nothing.
fn log_determinant(information: &Information) -> f64 {
    information
        .cholesky()
        .map_or(f64::NEG_INFINITY, |factor| (0..UNKNOWNS).map(|i| 2.0 * factor.l_dirty()[(i, i)].ln()).sum())
}
