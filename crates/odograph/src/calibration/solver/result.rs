//! What a calibration is asked for and what it gives.

use super::quality::ErrorMap;
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::geometry::Pixel;
use nalgebra::{DMatrix, Isometry3, Matrix6};
use std::fmt;
use std::str::FromStr;

/// A family of lenses with its number of free coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LensModel {
    /// No distortion.
    Pinhole,
    /// Brown–Conrady with k1, k2, p1, p2.
    BrownConrady4,
    /// Brown–Conrady with k1, k2, p1, p2, k3: OpenCV's default.
    BrownConrady5,
    /// Brown–Conrady with OpenCV's rational k1 to k6, p1, p2.
    BrownConrady8,
    /// Kannala–Brandt's fisheye with k1 to k4: OpenCV's `fisheye`.
    KannalaBrandt4,
    /// The double sphere with ξ, α.
    DoubleSphere,
}

impl LensModel {
    /// Every model with its name, those with fewer coefficients first.
    pub const NAMED: [(&'static str, Self); 6] = [
        ("pinhole", Self::Pinhole),
        ("double-sphere", Self::DoubleSphere),
        ("brown-conrady4", Self::BrownConrady4),
        ("kannala-brandt4", Self::KannalaBrandt4),
        ("brown-conrady5", Self::BrownConrady5),
        ("brown-conrady8", Self::BrownConrady8),
    ];

    /// Its name, which [`FromStr`] reads.
    pub fn name(self) -> &'static str {
        Self::NAMED.iter().find(|(_, model)| *model == self).map_or("", |(name, _)| name)
    }

    /// How many distortion coefficients it has.
    pub fn coefficients(self) -> usize {
        match self {
            Self::Pinhole => 0,
            Self::DoubleSphere => 2,
            Self::BrownConrady4 | Self::KannalaBrandt4 => 4,
            Self::BrownConrady5 => 5,
            Self::BrownConrady8 => 8,
        }
    }
}

impl fmt::Display for LensModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for LensModel {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let wanted = text.trim();
        let found = Self::NAMED.iter().find(|(name, _)| name.eq_ignore_ascii_case(wanted));
        found.map(|(_, model)| *model).ok_or_else(|| {
            let names = Self::NAMED.map(|(name, _)| name).join(", ");
            Error::usage(format!("there is no lens model `{text}`; there are {names}"))
        })
    }
}

/// How to calibrate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrationConfig {
    /// The lens model; `None` chooses among all by how well they foretell views they have not seen.
    pub model: Option<LensModel>,
    /// Pixels are square: one focal length.
    pub square_pixels: bool,
    /// The principal point is the middle of the image.
    pub centred: bool,
    /// The board is flat and true to size. Where not, its bend and the stretch of its print are estimated too
    /// ([`BoardShape`]).
    pub flat_board: bool,
}

impl Default for CalibrationConfig {
    fn default() -> Self {
        Self { model: None, square_pixels: false, centred: false, flat_board: true }
    }
}

/// A number that was estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// `f` (with square pixels) or `fx`, `fy`; `cx`, `cy`; then the model's coefficients by their names in
    /// [`crate::camera::Distortion`], then those of the [`BoardShape`] by its.
    pub name: &'static str,
    /// Its value: pixels, no unit for coefficients, metres or no unit for the board.
    pub value: f64,
    /// Its standard deviation in the same unit.
    pub deviation: f64,
}

/// How a board differs from its drawing: a point at (x, y) is really at `x + shear · y`, `y (1 + stretch)`,
/// `bend_x u² + bend_xy u v + bend_y v²`, with u and v from −1 to 1 over the board and x, y from its middle.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BoardShape {
    /// Depth at the left and right ends against the middle, metres, positive into the paper.
    pub bend_x: f64,
    /// Depth of the corners against each other: a twist, metres.
    pub bend_xy: f64,
    /// Depth at the upper and lower ends against the middle, metres.
    pub bend_y: f64,
    /// How much longer the print is downwards than its width says.
    pub stretch: f64,
    /// How far its right angles are from right, radians.
    pub shear: f64,
}

/// A view of the board in a calibration, in the order in which they were given.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedView {
    /// Where the board was: takes board points to camera points. Of views that were not used, as far as it could be told;
    /// the identity where it could not.
    pub camera_from_board: Isometry3<f64>,
    /// Root of the mean square distance, pixels, from where points were seen to where they should be; NaN where
    /// there is no pose.
    pub rms_px: f64,
    /// Of each point its index and how far right and down of its place it was seen, pixels.
    pub residuals: Vec<(usize, f64, f64)>,
    /// Whether the camera was estimated from it.
    pub used: bool,
    /// Why it was not used, or what is odd about it, for people.
    pub why_not: Option<String>,
}

impl CalibratedView {
    /// Angle between the board's normal and the optical axis, radians; 0 where the board is seen straight on.
    pub fn tilt_rad(&self) -> f64 {
        let normal = self.camera_from_board.rotation * nalgebra::Vector3::z();
        normal.z.abs().min(1.0).acos()
    }
}

/// How a lens model did.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The model.
    pub model: LensModel,
    /// Root mean square distance, pixels, over views that the model was not fitted to; infinite where it failed.
    pub hold_out_rms_px: f64,
    /// The same over the views that it was fitted to.
    pub rms_px: f64,
    /// Error of a ray in pixels that is expected from the covariance, root mean square over the image
    /// ([`Calibration::expected_error_px`]).
    pub expected_error_px: f64,
}

/// What to do with a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// It can be trusted.
    Good,
    /// It will do, and could be better: see the reasons.
    Usable,
    /// Better not: see the reasons.
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

/// A calibrated camera and how far to trust it.
#[derive(Debug, Clone)]
pub struct Calibration {
    /// The camera.
    pub camera: Camera,
    /// Its lens model.
    pub model: LensModel,
    /// What was estimated, without the boards' poses.
    pub parameters: Vec<Parameter>,
    /// Covariance of the [`parameters`](Self::parameters) in their order and units, the poses' uncertainty included.
    pub covariance: DMatrix<f64>,
    /// Standard deviation of a seen point in x and in y, pixels, as the residuals tell.
    pub noise_px: f64,
    /// Root of the mean square distance, pixels, over all points of the views used (OpenCV's RMS).
    pub rms_px: f64,
    /// The same over views left out in turn: the camera from the others, only the pose from the view itself.
    pub hold_out_rms_px: f64,
    /// All views, in the order given.
    pub views: Vec<CalibratedView>,
    /// The models that were tried, fewer coefficients first; one if it was chosen by the caller.
    pub candidates: Vec<Candidate>,
    /// How the board differs from its drawing; `None` where it was taken as flat.
    pub board_shape: Option<BoardShape>,
    /// What to do with it.
    pub verdict: Verdict,
    /// Why, and what to do better: sentences for people, the weightiest first.
    pub reasons: Vec<String>,
    pub(super) error_map: ErrorMap,
}

impl Calibration {
    /// How many views the camera was estimated from.
    pub fn views_used(&self) -> usize {
        self.views.iter().filter(|view| view.used).count()
    }

    /// The error, in pixels, to be expected of the ray through a pixel because the camera's numbers are uncertain: root of the
    /// mean square distance between where the true and the estimated camera see the same direction, once the rotation of the
    /// camera that brings them best together over the whole image is taken out (a change of the principal point is mostly a
    /// rotation, which no use of the camera can tell from its mounting).
    ///
    /// `None` where the camera has no ray for the pixel.
    pub fn expected_error_px(&self, pixel: Pixel) -> Option<f64> {
        self.error_map.expected_error_px(&self.camera, pixel)
    }

    /// [`Calibration::expected_error_px`] over the whole image, root mean square.
    pub fn expected_error_over_image_px(&self) -> f64 {
        self.error_map.over_image_px()
    }
}

/// Where a board is in front of a known camera.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardPose {
    /// Takes board points to camera points.
    pub camera_from_board: Isometry3<f64>,
    /// Covariance of a small rotation (radians) and then shift (metres) after it, both in the camera's frame: the true pose
    /// turns a board point p into `exp(ω) R p + t + δ`, (ω, δ) of this covariance. The camera is taken as exact.
    pub covariance: Matrix6<f64>,
    /// Root of the mean square distance, pixels.
    pub rms_px: f64,
    /// Of each point that was used its index and how far right and down of its place it was seen, pixels.
    pub residuals: Vec<(usize, f64, f64)>,
}
