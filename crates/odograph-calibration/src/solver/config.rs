//! Configuration of a calibration.

use odograph::error::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// A lens model, including its number of distortion coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LensModel {
    /// No distortion.
    Pinhole,
    /// Brown–Conrady with k1, k2, p1, p2.
    BrownConrady4,
    /// Brown–Conrady with k1, k2, p1, p2, k3: OpenCV's default.
    BrownConrady5,
    /// Brown–Conrady with OpenCV's rational radial term: k1 to k6, p1, p2.
    BrownConrady8,
    /// Kannala–Brandt fisheye model with k1 to k4: OpenCV's `fisheye`.
    KannalaBrandt4,
    /// Double sphere model with ξ and α.
    DoubleSphere,
}

impl LensModel {
    /// All models with their names, in ascending order of their number of coefficients.
    pub const NAMED: [(&'static str, Self); 6] = [
        ("pinhole", Self::Pinhole),
        ("double-sphere", Self::DoubleSphere),
        ("brown-conrady4", Self::BrownConrady4),
        ("kannala-brandt4", Self::KannalaBrandt4),
        ("brown-conrady5", Self::BrownConrady5),
        ("brown-conrady8", Self::BrownConrady8),
    ];

    /// The name, as accepted by [`FromStr`].
    pub fn name(self) -> &'static str {
        Self::NAMED.iter().find(|(_, model)| *model == self).map_or("", |(name, _)| name)
    }

    /// Number of distortion coefficients.
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

/// Configuration of a calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrationConfig {
    /// The lens model; `None` selects the one whose rays are surest over the whole image.
    pub model: Option<LensModel>,
    /// Constrains both focal lengths to be equal (square pixels).
    pub square_pixels: bool,
    /// Fixes the principal point at the image centre.
    pub centred: bool,
    /// Assumes that the board is flat and printed true to size. If false, the deformation of the
    /// board is estimated too ([`BoardShape`](super::BoardShape)).
    pub flat_board: bool,
}

impl Default for CalibrationConfig {
    fn default() -> Self {
        Self { model: None, square_pixels: false, centred: false, flat_board: true }
    }
}
