//! Subsystem 4: optical flow. Each corner is found again in a later frame by pyramidal Lucas–Kanade, and given up when it has become too
//! dissimilar from its first appearance.
//!
//! A corner's first appearance is its [`Template`]: patches of the keyframe on every pyramid level. It is searched for under
//! an affine [`Warp`] which the motion prediction gives, so that a patch that has turned or grown is still compared with itself
//! and not with its neighbour of a frame ago: nothing accumulates between keyframes.
//!
//! Sources: B. Lucas and T. Kanade, "An iterative image registration technique", 1981; J.-Y. Bouguet, "Pyramidal implementation
//! of the Lucas Kanade feature tracker", 2000; S. Baker and I. Matthews, "Lucas–Kanade 20 years on" (inverse compositional), 2004;
//! Z. Kalal et al., "Forward–backward error", 2010; J. Shi and C. Tomasi, "Good features to track", 1994 (dissimilarity).

mod affine;
mod noise;
mod patch;
mod response;
mod sampling_pull;
mod template;
mod track;

pub use affine::dissimilarity;
pub use noise::Noise;
pub use response::Response;
pub use template::Template;
pub use track::{REACH_PX, Track, TrackFailure, forward_backward_px, track};

use crate::geometry::Pixel;
use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

#[cfg(test)]
mod tests;

/// How corners are followed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FlowConfig {
    /// Pyramid levels, the full image counted.
    pub levels: usize,
    /// At most this many steps on each level.
    pub iterations: usize,
    /// A level ends when the steps still to come would lead less than this far, pixels of the full image.
    pub step_px: f64,
    /// Largest distance between a corner and where it comes back to when it is followed forward and then backward, pixels.
    pub forward_backward_px: f64,
    /// Largest dissimilarity from the first appearance: the part of the patch's contrast that is left unexplained after gain and
    /// offset, 0 (identical) to 1 (unrelated).
    pub dissimilarity: f64,
}

impl Default for FlowConfig {
    fn default() -> Self {
        Self { levels: 4, iterations: 12, step_px: 0.001, forward_backward_px: 0.5, dissimilarity: 0.9 }
    }
}

/// Where the neighbourhood of a keyframe point is expected, or was found, in another image: the keyframe point `centre + d`
/// is at `position + linear · d`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Warp {
    /// Where the template's centre is.
    pub position: Pixel,
    /// How its neighbourhood is turned, stretched and sheared.
    pub linear: Matrix2<f64>,
}

impl Warp {
    /// A neighbourhood that has only moved.
    pub fn translation(position: Pixel) -> Self {
        Self { position, linear: Matrix2::identity() }
    }

    fn at(&self, offset: Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.position.x, self.position.y) + self.linear * offset
    }
}
