//! The corners found, as whitened observations of ground points.

use super::super::TrackView;
use super::super::found_corner::FoundCorner;
use super::Tracker;
use crate::buffer::Buffer;
use crate::geometry::GroundPose;
use crate::motion::{
    Correspondence, Elevation, Observation, RollingShutter, ShutterPrior, whitened, whitening,
};
use crate::numerics::median;
use nalgebra::Matrix2;

impl Tracker<'_> {
    /// The corners found, each whitened by the covariance of its patch, and the standard deviation
    /// of the median one by the noise of the images, pixels. Pixels of a rolling shutter are
    /// corrected to where a global one would have seen them from `pose`.
    pub(super) fn observations(
        &self,
        found: &[FoundCorner],
        pose: &GroundPose,
        shutter: Option<(&ShutterPrior, &RollingShutter)>,
        (relief_m2, new_ground_m2): (f64, f64),
    ) -> (Buffer<Observation>, f64) {
        let keyframe = self.keyframe;
        let correspondence = |found: &FoundCorner| {
            let corner = &keyframe.corners[found.corner];
            let (mut ground, mut pixel, mut row_fraction) = (corner.patch.ground, found.warp.position, 0.0);
            let [x_by_readout, y_by_readout] = corner.patch.by_readout;
            if let Some((prior, shutter)) = shutter {
                let later_s = prior.readout.mean_s - keyframe.shutter.readout_s;
                ground.x_m += later_s * x_by_readout;
                ground.y_m += later_s * y_by_readout;
                row_fraction = shutter.row_fraction(pixel.y);
            }
            let covariance_px2 = found.covariance_px2;
            let keyframe_row_fraction = keyframe.shutter.row_fraction(corner.template.centre().y);
            let unknown = Elevation { mean_m: corner.patch.elevation_m, variance_m2: relief_m2 };
            let mut elevation = corner.elevation.unwrap_or(unknown);
            if corner.is_on_new_ground {
                elevation.variance_m2 += new_ground_m2;
            }
            if let Some((_, shutter)) = shutter {
                pixel = shutter.global_pixel(self.camera, pose, pixel, elevation.mean_m).unwrap_or(pixel);
            }
            let centre_of_projection = corner.patch.centre_of_projection;
            Correspondence {
                ground,
                elevation,
                pixel,
                covariance_px2,
                row_fraction,
                keyframe_row_fraction,
                centre_of_projection,
            }
        };
        let correspondences: Buffer<Correspondence> = found.iter().map(correspondence).collect();
        whitened(&correspondences, SHARED_PX2).unwrap_or_else(|| (Buffer::new(), 0.0))
    }
}

/// Lower bound of a track's variance, pixels²: 0.02 px of interpolation and warp error. Where all
/// tracks are good, all have equal weight.
const SHARED_PX2: f64 = 4e-4;

/// The whitening matrix of each track, relative to their median variance; none of no tracks.
pub fn track_whitenings(tracks: &[&TrackView]) -> Vec<Matrix2<f64>> {
    let covariance = |track: &TrackView| track.covariance_px2 + SHARED_PX2 * Matrix2::identity();
    let mut variances: Vec<f64> = tracks.iter().map(|track| 0.5 * covariance(track).trace()).collect();
    let Some(median_px2) = median(&mut variances) else { return Vec::new() };
    tracks.iter().map(|track| whitening(&covariance(track), median_px2)).collect()
}
