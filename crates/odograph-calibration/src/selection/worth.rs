//! Information of a view about the lens: Fisher information with the pose of the board marginalised
//! out.

use super::guidance::ViewCoverage;
use super::nominal::NominalView;
use nalgebra::{SMatrix, SVector, Vector3};

/// Two focal lengths, the principal point, three radial and two tangential distortion coefficients.
const UNKNOWNS: usize = 9;
type InformationMatrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

/// The contribution of one view.
#[derive(Debug, Clone)]
pub struct Lesson {
    information: InformationMatrix,
    /// The image cells covered by the view.
    cells: Vec<usize>,
}

impl NominalView {
    /// The information of the view about a lens near a pinhole with the nominal focal length;
    /// `noise_px` is the standard deviation of a corner.
    ///
    /// All unknowns are scaled to comparable size: focal lengths and principal point are in units
    /// of the focal length.
    pub fn lesson(&self, focal_px: f64, noise_px: f64) -> Lesson {
        let cells = ViewCoverage::cells_of(self.size, self.points.iter().map(|(_, pixel)| *pixel));
        let mut lesson = Lesson { information: InformationMatrix::zeros(), cells };
        let Some(pose) = self.pose(focal_px) else { return lesson };
        let mut lens = InformationMatrix::zeros();
        let mut mixed = SMatrix::<f64, UNKNOWNS, 6>::zeros();
        let mut posed = SMatrix::<f64, 6, 6>::zeros();
        for (point, _) in &self.points {
            let turned = pose.camera_from_board * Vector3::new(point.x_m, point.y_m, 0.0);
            let at = turned + pose.translation_m;
            if at.z <= 0.0 {
                continue;
            }
            let (x, y) = (at.x / at.z, at.y / at.z);
            // By translation: the derivative of x / z. By rotation: the cross product of the
            // rotated point with it.
            let by_points = [Vector3::new(1.0, 0.0, -x) / at.z, Vector3::new(0.0, 1.0, -y) / at.z];
            for (by_lens, by_point) in by_lens(x, y).into_iter().zip(by_points) {
                let by_turn = turned.cross(&by_point);
                let by_pose = SVector::<f64, 6>::from([
                    by_turn.x, by_turn.y, by_turn.z, by_point.x, by_point.y, by_point.z,
                ]);
                lens.ger(1.0, &by_lens, &by_lens, 1.0);
                mixed.ger(1.0, &by_lens, &by_pose, 1.0);
                posed.ger(1.0, &by_pose, &by_pose, 1.0);
            }
        }
        // The pose is unknown and is marginalised out (Schur complement).
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

/// Derivatives of the pixel by the lens at a point in the image plane of a pinhole.
fn by_lens(x: f64, y: f64) -> [SVector<f64, UNKNOWNS>; 2] {
    let r2 = x * x + y * y;
    let [r4, r6] = [r2 * r2, r2 * r2 * r2];
    let mixed = 2.0 * x * y;
    [
        [x, 0.0, 1.0, 0.0, x * r2, x * r4, x * r6, mixed, r2 + 2.0 * x * x].into(),
        [0.0, y, 0.0, 1.0, y * r2, y * r4, y * r6, r2 + 2.0 * y * y, mixed].into(),
    ]
}

/// The accumulated information about the lens.
pub struct Knowledge {
    information: InformationMatrix,
    log_determinant: f64,
    covered: Vec<bool>,
}

/// Weight of covering an image cell for the first time, in the unit of the log-determinant (nats).
/// The information criterion alone already favours the corners; this keeps it from neglecting
/// regions that the nominal lens constrains only by its model.
const WORTH_OF_A_CELL: f64 = 0.1;

impl Knowledge {
    /// Prior: every unknown has a standard deviation of 0.5, in units of the focal length.
    pub fn new() -> Self {
        let information = InformationMatrix::identity() * 4.0;
        let log_determinant = log_determinant(&information);
        Self { information, log_determinant, covered: vec![false; ViewCoverage::CELLS] }
    }

    /// Gain in information and coverage by a view.
    pub fn gain(&self, lesson: &Lesson) -> f64 {
        let cells = lesson.cells.iter().filter(|&&cell| !self.covered[cell]).count();
        log_determinant(&(self.information + lesson.information)) - self.log_determinant
            + WORTH_OF_A_CELL * cells as f64
    }

    /// Adds the information of a view.
    pub fn learn(&mut self, lesson: &Lesson) {
        self.information += lesson.information;
        self.log_determinant = log_determinant(&self.information);
        lesson.cells.iter().for_each(|&cell| self.covered[cell] = true);
    }
}

/// Log-determinant of a positive definite matrix; negative infinity if rounding has made it
/// indefinite.
fn log_determinant(information: &InformationMatrix) -> f64 {
    information
        .cholesky()
        .map_or(f64::NEG_INFINITY, |factor| (0..UNKNOWNS).map(|i| 2.0 * factor.l_dirty()[(i, i)].ln()).sum())
}
