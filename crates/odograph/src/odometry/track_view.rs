//! The tracks of a frame as they are shown: in the pixels of the image as it came in.

use super::Odometry;
use super::found_corner::FoundCorner;
use super::keyframe::{KeyCorner, Keyframe};
use crate::geometry::Pixel;
use crate::motion::dense::TileTrack;
use crate::motion::{Elevation, MotionEstimate};
use nalgebra::Matrix2;

/// What one track looked like in the last frame, for pictures and pages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackView {
    /// Where it is.
    pub pixel: Pixel,
    /// Where its corner is in the keyframe against which the frame was measured.
    pub corner: Pixel,
    /// Whether it agrees with the movement.
    pub inlier: bool,
    /// Covariance of `pixel` by the noise of the images, pixels².
    pub covariance_px2: Matrix2<f64>,
    /// Elevation of the ground there.
    pub elevation: Elevation,
}

impl TrackView {
    /// A corner at `pixel` whose position is exact.
    pub fn exact(pixel: Pixel) -> Self {
        Self {
            pixel,
            corner: pixel,
            inlier: true,
            covariance_px2: Matrix2::zeros(),
            elevation: Elevation::FLAT,
        }
    }
}

impl Odometry {
    /// The tracks of the last frame.
    pub fn tracks(&self) -> &[TrackView] {
        &self.tracks
    }

    /// Keeps the tracks of a measured frame for [`Odometry::tracks`].
    pub(super) fn show_tracks(
        &mut self,
        found: &[FoundCorner],
        tiles: &[TileTrack],
        estimate: &MotionEstimate,
    ) {
        let resolution = &self.resolution;
        let corners = self.keyframe.as_ref().map_or(&[][..], |keyframe| &keyframe.corners);
        let view = |(index, (found, &inlier)): (usize, (&FoundCorner, &bool))| {
            let corner = corners.get(found.corner)?.template.centre();
            Some(resolution.track_view(TrackView {
                pixel: found.warp.position,
                corner,
                inlier,
                covariance_px2: found.covariance_px2,
                elevation: estimate.elevations.get(index).map_or(Elevation::FLAT, |seen| seen.elevation),
            }))
        };
        self.tracks.clear();
        self.tracks.extend(found.iter().zip(&estimate.inliers).enumerate().filter_map(view));
        let tile = |(&tile, &inlier): (&TileTrack, &bool)| {
            let TileTrack { reference: corner, pixel, covariance_px2 } = tile;
            resolution.track_view(TrackView {
                pixel,
                corner,
                inlier,
                covariance_px2,
                elevation: Elevation::FLAT,
            })
        };
        self.tracks.extend(tiles.iter().zip(&estimate.inliers).map(tile));
    }

    /// Shows the corners of the first keyframe as tracks.
    pub(super) fn show_corners(&mut self, keyframe: &Keyframe) {
        let exact =
            |corner: &KeyCorner| self.resolution.track_view(TrackView::exact(corner.template.centre()));
        self.tracks = keyframe.corners.iter().map(exact).collect();
    }
}
