//! Positions of a satellite receiver in the map: where they show that the path has drifted, they
//! are absolute edges of the pose graph.

use super::Mapper;
use super::mapper::STEPS_AT_THE_END;
use crate::geometry::{GroundPoint, PlaneTransform, Sim2};
use crate::keyframe::KeyframeId;
use crate::numerics::variance_of_mean_factor;
use crate::pose_graph::AbsoluteEdge;
use nalgebra::{Matrix2, Matrix3, Vector2};

/// A position of the antenna as measured by odometry, and by the receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AntennaFix {
    /// The keyframe of the run that the frame was measured against.
    pub keyframe: KeyframeId,
    /// The antenna in the odometry frame, metres.
    pub position_m: Vector2<f64>,
    /// Its covariance as measured against the keyframe, square metres.
    pub covariance_m2: Matrix2<f64>,
    /// East and north in a plane, metres.
    pub place_m: Vector2<f64>,
    /// Their covariance, square metres.
    pub place_covariance_m2: Matrix2<f64>,
}

/// Correction of the map by the positions of a receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriftCorrection {
    /// Length on Earth of a metre of the map before the correction; it is 1 afterwards.
    pub scale: f64,
    /// Its standard deviation; 0 where the positions show none.
    pub scale_sigma: f64,
}

/// The positions show a drift if the variance of their residuals is this multiple of the stated
/// one, and the graph explains all but this share of it. Lower follows smaller drifts, and bends
/// more paths to errors of the receiver.
const DRIFT_SHOWN: f64 = 2.0;
const UNEXPLAINED: f64 = 0.5;

impl Mapper {
    /// Optimises the finished map with the positions as absolute edges, if they show that the path
    /// has drifted or that its metres are wrong: `spread` is the variance of their residuals from
    /// the path as it is, in units of the stated one, and `start` the placement of the map in their
    /// plane. `None`, and the map is as it was, if they show nothing, or if control points hold it.
    ///
    /// To be called once, after [`Mapper::finish`].
    pub fn correct_drift(
        &mut self,
        fixes: &[AntennaFix],
        start: &Sim2,
        spread: f64,
    ) -> Option<DriftCorrection> {
        let is_shown = spread > DRIFT_SHOWN || start.scale != 1.0;
        if self.is_surveyed || !is_shown {
            return None;
        }
        let before = self.graph.clone();
        let mut edges: Vec<AbsoluteEdge> = fixes.iter().filter_map(|fix| self.absolute_edge(fix)).collect();
        let mut placed = self.graph.place(&edges, Some(*start), STEPS_AT_THE_END).ok()?;
        let spread_after = placed.spread;
        // Errors that last say less than as many independent ones, and must not bend the path.
        let off: Vec<Vector2<f64>> = placed.uses.iter().filter(|of| of.used).map(|of| of.off_m).collect();
        let lasting = variance_of_mean_factor(&off);
        if lasting > 1.0 {
            edges.iter_mut().for_each(|edge| edge.place_covariance_m2 *= lasting);
            self.graph = before.clone();
            placed = self.graph.place(&edges, Some(*start), STEPS_AT_THE_END).ok()?;
        }
        let explained = spread > DRIFT_SHOWN && spread_after < UNEXPLAINED * spread;
        if !explained && placed.scale_sigma == 0.0 {
            self.graph = before;
            return None;
        }
        self.graph.adopt_survey_scale();
        self.is_surveyed = true;
        self.take_over_graph();
        Some(DriftCorrection { scale: placed.survey_from_graph.scale, scale_sigma: placed.scale_sigma })
    }

    fn absolute_edge(&self, fix: &AntennaFix) -> Option<AbsoluteEdge> {
        let keyframe = self.of_run(fix.keyframe)?;
        let odometry_from_keyframe = Sim2::rigid(&keyframe.odometry_pose.se2());
        let point =
            odometry_from_keyframe.inverse().apply(GroundPoint::new(fix.position_m.x, fix.position_m.y));
        let turn = odometry_from_keyframe.between_by_to().fixed_view::<2, 2>(0, 0).into_owned();
        let mut covariance = Matrix3::zeros();
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&(turn * fix.covariance_m2 * turn.transpose()));
        Some(AbsoluteEdge {
            keyframe: keyframe.id,
            point_m: Vector2::new(point.x_m, point.y_m),
            direction_rad: 0.0,
            covariance,
            place_m: fix.place_m,
            place_covariance_m2: fix.place_covariance_m2,
            heading: None,
        })
    }
}
