//! Pose of a board relative to a calibrated camera.

use super::bundle::{Bundle, BundleState, BundleUnknowns, adjust, listed_residuals, robust_noise_px};
use super::fit::better_mirrored;
use super::lens::Lens;
use super::result::BoardPose;
use super::{sights, zhang};
use crate::{Board, BoardView};
use nalgebra::Matrix6;
use odograph::camera::Camera;
use odograph::error::{Error, Result};
use odograph::geometry::Pixel;

/// Estimates the pose of a board relative to a calibrated camera from one view.
///
/// The pose is initialised from the homography of the rays and refined by Levenberg–Marquardt with
/// a robust loss, from both solutions of the two-fold ambiguity of planar poses.
///
/// Points for which the camera has no ray (86° or more from the optical axis) are ignored. Fails if
/// fewer than four non-collinear points remain, if the image size differs from the camera's, or if
/// the points do not fit this board.
pub fn board_pose(camera: &Camera, board: &Board, view: &BoardView) -> Result<BoardPose> {
    if view.size != (camera.width(), camera.height()) {
        return Err(Error::input(format!(
            "the picture of the board is {}x{} but the camera is calibrated for {}x{}; take both at the same size",
            view.size.0,
            view.size.1,
            camera.width(),
            camera.height()
        )));
    }
    let mut seen = sights::sights_of(board, view)?;
    let mut pairs = Vec::with_capacity(seen.len());
    seen.retain(|sight| {
        let ray = camera.ray_from_pixel(Pixel::new(sight.pixel.0, sight.pixel.1));
        pairs.extend(ray.map(|ray| (sight.on_board, ray.vector().normalize())));
        ray.is_some()
    });
    if let Some(why) = sights::fault(&seen) {
        return Err(Error::input(why));
    }
    let misfit = || Error::input("no pose of the board fits its points; check the board and the camera file");
    let homography = zhang::homography(&pairs).ok_or_else(misfit)?;
    let pose = zhang::pose_from_homography(&homography).ok_or_else(misfit)?;
    let mut state = BundleState { lens: Lens::from_camera(camera), shape: [0.0; 5], poses: vec![pose] };
    let views = [seen.as_slice()];
    let poses_only = BundleUnknowns::poses_only();
    let mut noise_px = adjust(&views, &mut state, &poses_only, 50);
    if let Some(pose) = better_mirrored(&seen, &state, noise_px) {
        state.poses = vec![pose];
        noise_px = adjust(&views, &mut state, &poses_only, 50);
    }
    // With few points the median is unreliable; the RMS residual is used if it is larger.
    let (list, squares) = listed_residuals(&state, &state.poses[0], &seen);
    let rms_px = (squares / list.len().max(1) as f64).sqrt();
    let diagonal = (view.size.0 as f64).hypot(view.size.1 as f64);
    if list.len() < 4 || rms_px > 0.05 * diagonal || robust_noise_px(&views, &state, 6) > 0.02 * diagonal {
        return Err(misfit());
    }
    let freedom = (2.0 * list.len() as f64 - 6.0).max(1.0);
    let assumed_px = (squares / freedom).sqrt().min(2.0 * noise_px).max(noise_px);
    let bundle = Bundle { views: &views, unknowns: &poses_only, noise_px: assumed_px };
    let information: Matrix6<f64> = bundle.pose_information(&state)[0];
    let covariance = information.try_inverse().ok_or_else(misfit)?;
    Ok(BoardPose { camera_from_board: state.poses[0], covariance, rms_px, residuals: list })
}
