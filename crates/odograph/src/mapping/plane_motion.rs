//! How one pose over the plane lies to another: the motions of Sim(2) that tie keyframes.

use crate::geometry::{GroundPose, wrap_angle};
use nalgebra::{Matrix4, Matrix6, Vector4};

/// Where `to` is as `from` sees it: (x, y) in metres in the frame of `from`, heading, and the logarithm of the ratio of heights, as
/// [`super::MapEdge::motion`] has them.
pub fn seen_from(from: &GroundPose, to: &GroundPose) -> Vector4<f64> {
    let (sin, cos) = from.heading_rad.sin_cos();
    let (dx, dy) = (to.x_m - from.x_m, to.y_m - from.y_m);
    Vector4::new(
        cos * dx + sin * dy,
        cos * dy - sin * dx,
        wrap_angle(to.heading_rad - from.heading_rad),
        (to.height_m / from.height_m).ln(),
    )
}

/// The pose that `from` sees at `motion`: the inverse of [`seen_from`]. Roll and pitch are those of `from`.
///
/// `scale` is how many of `from`'s present metres one metre of the motion is: its height now over its height when the motion was measured.
pub fn laid_from(from: &GroundPose, motion: &Vector4<f64>, scale: f64) -> GroundPose {
    let (sin, cos) = from.heading_rad.sin_cos();
    GroundPose {
        x_m: from.x_m + scale * (cos * motion[0] - sin * motion[1]),
        y_m: from.y_m + scale * (sin * motion[0] + cos * motion[1]),
        heading_rad: from.heading_rad + motion[2],
        height_m: from.height_m * motion[3].exp(),
        ..*from
    }
}

/// Covariance of a motion measured by `from` from that of the pose of `to` in the world, (x, y, heading, height, roll, pitch).
pub fn motion_covariance(from: &GroundPose, to: &GroundPose, covariance: &Matrix6<f64>) -> Matrix4<f64> {
    let (sin, cos) = from.heading_rad.sin_cos();
    let mut turn = Matrix4::identity();
    (turn[(0, 0)], turn[(0, 1)], turn[(1, 0)], turn[(1, 1)]) = (cos, sin, -sin, cos);
    turn[(3, 3)] = 1.0 / to.height_m;
    turn * covariance.fixed_view::<4, 4>(0, 0) * turn.transpose()
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
        fn a_motion_leads_back_to_where_it_was_seen(from in poses(), to in poses()) {
            let back = laid_from(&from, &seen_from(&from, &to), 1.0);
            prop_assert!((back.x_m - to.x_m).hypot(back.y_m - to.y_m) < 1e-12 * 10.0);
            prop_assert!(wrap_angle(back.heading_rad - to.heading_rad).abs() < 1e-12);
            prop_assert!((back.height_m - to.height_m).abs() < 1e-12 * 10.0);
        }
    }
}
