//! Absolute edges: points fixed to keyframes that lie at known places of another frame of
//! reference, the survey frame; their residuals and Jacobians. Derivation:
//! `docs/math/pose-graph.md`, "Absolute edges".

use super::{Node, PoseGraph};
use crate::geometry::pose_index::HEADING;
use crate::geometry::{GroundPoint, PlaneTransform, Sim2, wrap_angle};
use crate::keyframe::KeyframeId;
use crate::numerics::robust_variance;
use nalgebra::{Matrix2, Matrix3, Matrix4, Vector2, Vector4};

/// A point fixed to a keyframe that lies at a known place: a surveyed marker that the keyframe
/// shows, or the antenna of a satellite receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AbsoluteEdge {
    /// The keyframe.
    pub keyframe: KeyframeId,
    /// The point in the frame of the keyframe, metres as they are when the keyframe is at the
    /// height of its `odometry_pose`.
    pub point_m: Vector2<f64>,
    /// A direction there, counter-clockwise from the keyframe's heading, radians.
    pub direction_rad: f64,
    /// Covariance of the point (square metres) and the direction in the frame of the keyframe.
    pub covariance: Matrix3<f64>,
    /// Where the point lies in the survey frame, metres.
    pub place_m: Vector2<f64>,
    /// Covariance of the place, square metres.
    pub place_covariance_m2: Matrix2<f64>,
    /// The direction in the survey frame, radians, and its variance, where it is known.
    pub heading: Option<(f64, f64)>,
}

/// Absolute edges of a graph, and the graph's placement in the survey frame.
#[derive(Debug, Clone)]
pub(super) struct Survey {
    pub edges: Vec<WeightedPoint>,
    pub placement: Sim2,
    pub scale: PlacementScale,
}

/// What is unknown of a placement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PlacementScale {
    /// All four numbers.
    Free,
    /// Position and direction; the scale is 1.
    Held,
    /// Nothing: the frame of the graph is the survey frame, and its keyframes are all free.
    Adopted,
}

/// An absolute edge with its whitening matrix.
#[derive(Debug, Clone)]
pub(super) struct WeightedPoint {
    pub node: usize,
    pub used: bool,
    point_m: GroundPoint,
    direction_rad: f64,
    pub place_m: Vector2<f64>,
    heading_rad: f64,
    /// Of (x, y, heading, 0) in the survey frame; the row of the heading is zero where it is
    /// unknown.
    whitening: Matrix4<f64>,
    /// Largest squared residual of an edge that agrees.
    pub gate: f64,
}

/// A whitened residual with its Jacobians.
pub(super) struct LinearizedPoint {
    pub misses: Vector4<f64>,
    pub by_node: Matrix4<f64>,
    /// With respect to x, y and heading of the placement.
    pub by_placement: Matrix4<f64>,
    /// With respect to the logarithm of its scale, in the third column.
    pub by_scale: Matrix4<f64>,
}

/// Squared residuals beyond which an edge contradicts: one in ten thousand normal ones of two and
/// of three numbers.
const GATES_SQUARED: [f64; 2] = [18.4, 21.1];
/// Prior standard deviation of ln scale: of a height measured with a tape.
const SCALE_SIGMA: f64 = 0.03;
/// Standard deviation of an unknown that is held fixed: far below that of any measurement, and
/// large enough for the normal equations to stay well conditioned.
const HELD_SIGMA: f64 = 1e-9;

impl WeightedPoint {
    /// `survey_from_graph` turns the keyframe's part of the covariance. `None` if a number is not
    /// finite or the covariance is not positive definite.
    pub fn new(node: usize, at: &Node, edge: &AbsoluteEdge, survey_from_graph: &Sim2) -> Option<Self> {
        let survey_from_node = *survey_from_graph * at.world_from_node();
        let turn = survey_from_node.product_by_right().fixed_view::<3, 3>(0, 0).into_owned();
        let mut covariance = turn * edge.covariance * turn.transpose();
        let mut places = covariance.fixed_view_mut::<2, 2>(0, 0);
        places += edge.place_covariance_m2;
        let (heading_rad, variance) = edge.heading.unwrap_or((0.0, 0.0));
        covariance[(HEADING, HEADING)] += variance;
        let numbers = edge.point_m.iter().chain(&edge.place_m).chain([&edge.direction_rad, &heading_rad]);
        if !numbers.into_iter().chain(covariance.iter()).all(|value| value.is_finite()) {
            return None;
        }
        let mut whitening = Matrix4::zeros();
        if edge.heading.is_some() {
            let root = covariance.cholesky()?.inverse().cholesky()?.l().transpose();
            whitening.fixed_view_mut::<3, 3>(0, 0).copy_from(&root);
        } else {
            let of_place = covariance.fixed_view::<2, 2>(0, 0).into_owned();
            let root = of_place.cholesky()?.inverse().cholesky()?.l().transpose();
            whitening.fixed_view_mut::<2, 2>(0, 0).copy_from(&root);
        }
        Some(Self {
            node,
            used: true,
            point_m: GroundPoint::new(edge.point_m.x, edge.point_m.y),
            direction_rad: edge.direction_rad,
            place_m: edge.place_m,
            heading_rad,
            whitening,
            gate: GATES_SQUARED[usize::from(edge.heading.is_some())],
        })
    }

    /// Where the point is in the survey frame, and the direction there.
    pub fn predicted(&self, node: &Node, placement: &Sim2) -> (Vector2<f64>, f64) {
        let survey_from_node = *placement * node.world_from_node();
        let GroundPoint { x_m, y_m } = survey_from_node.apply(self.point_m);
        (Vector2::new(x_m, y_m), survey_from_node.heading_rad + self.direction_rad)
    }

    fn misses(&self, node: &Node, placement: &Sim2) -> Vector4<f64> {
        let (there_m, heading_rad) = self.predicted(node, placement);
        let off_m = self.place_m - there_m;
        self.whitening * Vector4::new(off_m.x, off_m.y, wrap_angle(self.heading_rad - heading_rad), 0.0)
    }

    /// The squared norm of the whitened residual.
    pub fn squared(&self, node: &Node, placement: &Sim2) -> f64 {
        self.misses(node, placement).norm_squared()
    }

    /// The whitened residual with its Jacobians.
    pub fn linearized(&self, node: &Node, placement: &Sim2) -> LinearizedPoint {
        let world_from_node = node.world_from_node();
        let in_graph = world_from_node.apply(self.point_m);
        let own = Sim2::lever_arm(in_graph.x_m - node.pose.x_m, in_graph.y_m - node.pose.y_m);
        let by_node = placement.product_by_right() * own;
        let (arm_x, arm_y) = placement.rotate(in_graph.x_m, in_graph.y_m);
        let arm = Sim2::lever_arm(arm_x, arm_y);
        let mut by_placement = arm;
        by_placement.column_mut(3).fill(0.0);
        let mut by_scale = Matrix4::zeros();
        by_scale.set_column(2, &arm.column(3));
        LinearizedPoint {
            misses: self.misses(node, placement),
            by_node: -self.whitening * by_node,
            by_placement: -self.whitening * by_placement,
            by_scale: -self.whitening * by_scale,
        }
    }
}

impl Survey {
    /// Prior standard deviation of ln scale.
    pub fn scale_sigma(&self) -> f64 {
        if self.scale == PlacementScale::Free { SCALE_SIGMA } else { HELD_SIGMA }
    }

    /// The edges in use.
    pub fn used(&self) -> impl Iterator<Item = &WeightedPoint> {
        self.edges.iter().filter(|edge| edge.used)
    }

    /// Cost of the prior of the scale.
    pub fn prior_cost(&self) -> f64 {
        0.5 * (self.placement.scale.ln() / self.scale_sigma()).powi(2)
    }
}

impl PoseGraph {
    /// Robust variance of the residuals of all absolute edges in units of the stated one; 0 without
    /// edges.
    pub(super) fn spread_of_points(&self) -> f64 {
        let Some(survey) = &self.survey else { return 0.0 };
        let mut squares: Vec<f64> =
            survey.edges.iter().map(|edge| edge.squared(&self.nodes[edge.node], &survey.placement)).collect();
        robust_variance::<2>(&mut squares).unwrap_or(0.0)
    }

    /// Scale of the loss of absolute edges, in standard deviations: three times their robust scale,
    /// at least three.
    pub(super) fn loss_scale_of_points(&self) -> f64 {
        3.0 * self.spread_of_points().sqrt().max(1.0)
    }

    /// For every keyframe, whether its connected component needs no fixed keyframe because absolute
    /// edges hold it; `None` if none does.
    pub(super) fn held_by_survey(&self) -> Option<Vec<bool>> {
        let survey = self.survey.as_ref().filter(|survey| survey.scale == PlacementScale::Adopted)?;
        let mut held = vec![false; self.nodes.len()];
        survey.used().for_each(|edge| held[edge.node] = true);
        Some(held)
    }
}
