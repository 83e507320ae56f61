//! Result of a calibration.

use super::config::LensModel;
use super::quality::ErrorMap;
use nalgebra::{DMatrix, Isometry3};
use odograph::camera::Camera;
use odograph::geometry::Pixel;
use std::fmt;

/// An estimated parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// `f` (with square pixels) or `fx`, `fy`; `cx`, `cy`; then the distortion coefficients, named
    /// as in [`odograph::camera::Distortion`]; then the parameters of the [`BoardShape`], named as
    /// its fields.
    pub name: &'static str,
    /// Estimate. Focal lengths and principal point in pixels; distortion coefficients without unit;
    /// board parameters in metres, radians or without unit.
    pub value: f64,
    /// Standard deviation, in the same unit.
    pub deviation: f64,
}

/// Deviation of a board from its nominal geometry. With x and y from the middle of the board, and u
/// and v the same normalised to −1 … 1 over the board, the point at (x, y) is really at `x + shear
/// · y`, `y (1 + stretch)`, `bend_x u² + bend_xy u v + bend_y v²`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BoardShape {
    /// Depth of the left and right ends relative to the middle, metres, positive into the paper.
    pub bend_x: f64,
    /// Twist: depth of the corners from the mixed term, metres.
    pub bend_xy: f64,
    /// Depth of the upper and lower ends relative to the middle, metres, positive into the paper.
    pub bend_y: f64,
    /// Relative scale error of the print along y, with respect to x.
    pub stretch: f64,
    /// Shear angle: deviation of the axes from orthogonality, radians.
    pub shear: f64,
}

/// A view used in or rejected from a calibration. Views are kept in the order of the input.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedView {
    /// Pose: transforms points from the board frame to the camera frame. For unused views it is
    /// estimated with the final camera; it is the identity if no pose was found.
    pub camera_from_board: Isometry3<f64>,
    /// RMS reprojection error, pixels; NaN if there is no pose.
    pub rms_px: f64,
    /// For each point its index and its residual (detected minus predicted position) in x and y,
    /// pixels.
    pub residuals: Vec<(usize, f64, f64)>,
    /// Whether the view contributed to the estimate of the camera.
    pub used: bool,
    /// Reason for the rejection, or a remark on the view, as text for users.
    pub why_not: Option<String>,
}

impl CalibratedView {
    /// Angle between the board normal and the optical axis, radians; 0 for a fronto-parallel board.
    pub fn tilt_rad(&self) -> f64 {
        let normal = self.camera_from_board.rotation * nalgebra::Vector3::z();
        normal.z.abs().min(1.0).acos()
    }
}

/// Comparison figures of one lens model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelComparison {
    /// The lens model.
    pub model: LensModel,
    /// RMS reprojection error over held-out views, pixels; infinite if it could not be computed.
    pub hold_out_rms_px: f64,
    /// RMS reprojection error over the views of the fit, pixels.
    pub rms_px: f64,
    /// Expected ray error from the covariance, RMS over the image, pixels
    /// ([`Calibration::expected_error_px`]).
    pub expected_error_px: f64,
    /// The same with the misfit of the model that cross-validation shows: the model with the
    /// smallest one is selected. Equal to `expected_error_px` if nothing was compared.
    pub with_misfit_px: f64,
}

/// Evidence that the board was not flat, from a fit that estimates its [`BoardShape`] too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BendEvidence {
    /// Relative decrease of the RMS residual.
    pub gain: f64,
    /// Largest bend, metres.
    pub depth_m: f64,
}

/// Overall quality of a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// Reliable.
    Good,
    /// Usable, but can be improved; see [`Calibration::reasons`].
    Usable,
    /// Not reliable, repeat the calibration; see [`Calibration::reasons`].
    DoItAgain,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Good => "good",
            Self::Usable => "usable",
            Self::DoItAgain => "do it again",
        })
    }
}

/// A calibrated camera with its uncertainty and quality figures.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// The calibrated camera.
    pub camera: Camera,
    /// The lens model of the camera.
    pub model: LensModel,
    /// The estimated parameters of the camera and of the board shape, without the poses.
    pub parameters: Vec<Parameter>,
    /// Covariance of the [`parameters`](Self::parameters), in their order and units. The poses are
    /// marginalised out.
    pub covariance: DMatrix<f64>,
    /// Standard deviation of the point detections per axis, pixels; estimated from the residuals.
    pub noise_px: f64,
    /// RMS reprojection error over all points of the used views, pixels (OpenCV's RMS).
    pub rms_px: f64,
    /// Cross-validation error: RMS reprojection error over held-out views, pixels. For each
    /// held-out view only the pose is estimated; the camera is estimated from the other views.
    pub hold_out_rms_px: f64,
    /// All views, in the order of the input.
    pub views: Vec<CalibratedView>,
    /// The compared lens models in ascending order of their number of coefficients; only one if the
    /// configuration names the model.
    pub candidates: Vec<ModelComparison>,
    /// Estimated deformation of the board; `None` if the board was assumed flat.
    pub board_shape: Option<BoardShape>,
    /// Set if the board was assumed flat, and the views show that it was not.
    pub bend: Option<BendEvidence>,
    /// Overall quality.
    pub verdict: Verdict,
    /// Reasons for the verdict with advice, as text for users; the most severe first.
    pub reasons: Vec<String>,
    pub(super) error_map: ErrorMap,
}

impl Calibration {
    /// Number of views that contributed to the estimate of the camera.
    pub fn views_used(&self) -> usize {
        self.views.iter().filter(|view| view.used).count()
    }

    /// Expected error of the ray through a pixel due to the uncertainty of the camera parameters,
    /// pixels.
    ///
    /// It is the RMS distance between the projections of the same direction by the true and by the
    /// estimated camera. The rotation that best aligns the two cameras over the whole image is
    /// removed first: an error of the principal point is mostly a rotation, which is absorbed by
    /// the extrinsics.
    ///
    /// `None` if the camera has no ray for the pixel.
    pub fn expected_error_px(&self, pixel: Pixel) -> Option<f64> {
        self.error_map.expected_error_px(&self.camera, pixel)
    }

    /// RMS of [`Calibration::expected_error_px`] over the image, pixels.
    pub fn expected_error_over_image_px(&self) -> f64 {
        self.error_map.over_image_px()
    }
}
