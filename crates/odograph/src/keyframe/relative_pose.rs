//! Relative motions of poses over the plane, as edges of the pose graph hold them.

use crate::geometry::pose_index::{HEADING, LN_SCALE, X, Y};
use crate::geometry::{GroundPoint, GroundPose, PlaneTransform, Sim2, propagated, wrap_angle};
use nalgebra::{Matrix4, Matrix6, Vector4};

/// The pose of `to` in the frame of `from`: (x, y) in metres, heading wrapped, and the logarithm of
/// the ratio of heights, as in [`super::MapEdge::motion`].
pub fn relative_motion(from: &GroundPose, to: &GroundPose) -> Vector4<f64> {
    let seen = from.se2().between(&to.se2());
    Vector4::new(seen.x_m, seen.y_m, wrap_angle(seen.heading_rad), (to.height_m / from.height_m).ln())
}

/// The pose at `motion` from `from`: the inverse of [`relative_motion`]. Roll and pitch are those
/// of `from`.
///
/// `scale` is the length now of a metre of the motion: the height of `from` now over its height
/// when the motion was measured.
pub fn compose(from: &GroundPose, motion: &Vector4<f64>, scale: f64) -> GroundPose {
    let world_from_measured = Sim2 { scale, ..Sim2::rigid(&from.se2()) };
    let GroundPoint { x_m, y_m } = world_from_measured.apply(GroundPoint::new(motion[X], motion[Y]));
    GroundPose {
        x_m,
        y_m,
        heading_rad: from.heading_rad + motion[HEADING],
        height_m: from.height_m * motion[LN_SCALE].exp(),
        ..*from
    }
}

/// Covariance of a motion from the covariance of `to` in the world, (x, y, heading, height, roll,
/// pitch).
pub fn motion_covariance(from: &GroundPose, to: &GroundPose, covariance: &Matrix6<f64>) -> Matrix4<f64> {
    let mut by_to = Sim2::rigid(&from.se2()).between_by_to();
    by_to[(LN_SCALE, LN_SCALE)] = 1.0 / to.height_m;
    propagated(&by_to, &covariance.fixed_view::<4, 4>(0, 0).into_owned())
}

/// A motion as a transform from the metres of `to` to those of `from`, which were measured at the
/// heights `measured_m` of `from` and of `to`. The motion has the ratio of true heights; if both
/// were measured at their true heights, their metres are equal and the scale is 1.
pub fn similarity(motion: &Vector4<f64>, measured_m: [f64; 2]) -> Sim2 {
    let mut similarity = Sim2::from_vector(motion);
    similarity.scale *= measured_m[0] / measured_m[1];
    similarity
}

/// The inverse motion, of `from` in the frame of `to`; both measured at the heights `measured_m` of
/// `from` and of `to`.
pub fn inverse(motion: &Vector4<f64>, measured_m: [f64; 2]) -> Vector4<f64> {
    let inverse = similarity(motion, measured_m).inverse();
    Vector4::new(inverse.x_m, inverse.y_m, inverse.heading_rad, -motion[LN_SCALE])
}

/// Standard deviation of a position along one axis, metres.
pub fn position_sigma_m(covariance: &Matrix4<f64>) -> f64 {
    (0.5 * (covariance[(X, X)] + covariance[(Y, Y)])).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    prop_compose! {
        fn poses()(x_m in -5.0..5.0, y_m in -5.0..5.0, heading_rad in -3.1..3.1, height_m in 0.1..10.0) -> GroundPose {
            GroundPose { x_m, y_m, heading_rad, ..GroundPose::level(height_m) }
        }
    }

    proptest! {
        #[test]
        fn a_relative_pose_leads_back_to_its_target(from in poses(), to in poses()) {
            let back = compose(&from, &relative_motion(&from, &to), 1.0);
            prop_assert!((back.x_m - to.x_m).hypot(back.y_m - to.y_m) < 1e-12 * 10.0);
            prop_assert!(wrap_angle(back.heading_rad - to.heading_rad).abs() < 1e-12);
            prop_assert!((back.height_m - to.height_m).abs() < 1e-12 * 10.0);
        }

        #[test]
        fn the_inverse_of_a_motion_swaps_its_frames(from in poses(), to in poses(), drift in 0.5..2.0) {
            // Odometry that has drifted holds `to` for higher than it is, and its metres are longer
            // by as much.
            let measured_m = [from.height_m, drift * to.height_m];
            let inverse = inverse(&relative_motion(&from, &to), measured_m);
            let mut expected = relative_motion(&to, &from);
            expected[0] *= drift;
            expected[1] *= drift;
            let off = inverse - expected;
            prop_assert!(off[0].hypot(off[1]) < 1e-10 && wrap_angle(off[2]).abs() < 1e-12 && off[3].abs() < 1e-12);
        }
    }
}
