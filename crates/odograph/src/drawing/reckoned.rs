//! Stretches of the path that other sensors give where the camera was lost.

use super::MUTED;
use crate::geometry::GroundPoint;

/// A stretch of consecutive frames without a measured pose, by dead reckoning with other sensors.
#[derive(Debug, Clone, PartialEq)]
pub struct ReckonedStretch {
    /// Time of its first frame, seconds, of the same clock as those of the frames.
    pub from_s: f64,
    /// Time of its last frame, seconds.
    pub to_s: f64,
    /// The positions at its frames.
    pub points: Vec<GroundPoint>,
}

impl ReckonedStretch {
    /// The stretch between two moments, or after one if there is no second.
    pub fn between(stretches: &[Self], after_s: f64, before_s: Option<f64>) -> Option<&Self> {
        let inside = |stretch: &&Self| {
            stretch.from_s > after_s
                && before_s.is_none_or(|before_s| stretch.to_s < before_s)
                && stretch.is_drawable()
        };
        stretches.iter().find(inside)
    }

    /// Whether all its positions are finite numbers of a size that can be drawn.
    pub(super) fn is_drawable(&self) -> bool {
        self.points.iter().all(|at| at.x_m.abs() < 1e12 && at.y_m.abs() < 1e12)
    }
}

/// The style of a reckoned stretch.
pub(super) fn style() -> String {
    format!(
        "class=\"reckoned\" fill=\"none\" stroke=\"{MUTED}\" stroke-width=\"2.4\" stroke-dasharray=\"7 5\" \
         stroke-linejoin=\"round\""
    )
}

/// Its mark in the legend, 40 units long.
pub(super) fn mark() -> String {
    format!("<path {} d=\"M0 0h38\"/>", style())
}
