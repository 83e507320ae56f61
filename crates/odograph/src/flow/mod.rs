//! Subsystem 4: optical flow. Each corner is tracked into a later frame by pyramidal Lucas–Kanade,
//! and dropped when it has become too dissimilar from its first appearance.
//!
//! A corner's first appearance is its [`Template`]: patches of the keyframe on every pyramid level.
//! It is tracked under an affine [`Warp`] from the motion prediction, so that a rotated or scaled
//! patch is still compared with the keyframe and not with the previous frame: errors do not
//! accumulate between keyframes. Gain and light that changes linearly over a patch are eliminated;
//! interpolation bias, noise-induced bias and the bias by curvature are corrected. Derivation:
//! `docs/math/interpolation-bias.md`.
//!
//! Sources: B. Lucas and T. Kanade, "An iterative image registration technique", 1981; J.-Y.
//! Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000; S. Baker and I.
//! Matthews, "Lucas–Kanade 20 years on" (inverse compositional), 2004; Z. Kalal et al.,
//! "Forward–backward error", 2010; J. Shi and C. Tomasi, "Good features to track", 1994
//! (dissimilarity).

mod affine;
mod curvature_bias;
mod interpolation_bias;
mod level_template;
mod noise;
mod patch;
mod subpixel_phase;
mod template;
mod track;

pub use affine::dissimilarity;
pub use noise::Noise;
pub use template::Template;
pub use track::{SEARCH_RADIUS_PX, Track, TrackFailure, forward_backward_px, track};

use crate::geometry::Pixel;
use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

#[cfg(test)]
mod tests;

/// Configuration of optical flow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FlowConfig {
    /// Pyramid levels, including the full image.
    pub levels: usize,
    /// Most iterations per level.
    pub iterations: usize,
    /// Convergence of a level: the remaining displacement is below this, pixels of the full image.
    pub step_px: f64,
    /// Largest forward–backward error, pixels.
    pub forward_backward_px: f64,
    /// Largest dissimilarity from the first appearance: the root of the fraction of the patch's
    /// contrast that gain and light leave unexplained, 0 (identical) to 1 (unrelated).
    pub dissimilarity: f64,
}

impl Default for FlowConfig {
    fn default() -> Self {
        Self { levels: 4, iterations: 12, step_px: 0.001, forward_backward_px: 0.5, dissimilarity: 0.9 }
    }
}

/// Affine warp of a patch: the keyframe point `centre + d` is at `position + linear · d` in another
/// image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Warp {
    /// Position of the template's centre.
    pub position: Pixel,
    /// Rotation, scale and shear.
    pub linear: Matrix2<f64>,
}

impl Warp {
    /// A pure translation.
    pub fn translation(position: Pixel) -> Self {
        Self { position, linear: Matrix2::identity() }
    }

    fn at(&self, offset: Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.position.x, self.position.y) + self.linear * offset
    }
}
