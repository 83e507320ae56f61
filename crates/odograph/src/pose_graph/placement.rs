//! The placement of the graph in the survey frame of its absolute edges, estimated together with
//! the keyframes. Derivation: `docs/math/pose-graph.md`, "Absolute edges".

use super::absolute::{AbsoluteEdge, PlacementScale, Survey, WeightedPoint};
use super::descent::Descent;
use super::pieces::Pieces;
use super::{Node, PoseGraph};
use crate::geometry::pose_index::{X, Y};
use crate::geometry::{GroundPoint, PlaneTransform, Sim2};
use crate::motion::Random;
use nalgebra::Vector2;
use std::f64::consts::PI;
use std::fmt;

/// Result of an absolute edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AbsoluteUse {
    /// Whether it was used; otherwise it contradicts the others.
    pub used: bool,
    /// Residual: surveyed minus estimated position, metres in the survey frame.
    pub off_m: Vector2<f64>,
}

/// The placement of a graph in the survey frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// From the graph to the survey frame. The scale is the length there of a metre of the graph; 1
    /// unless the places show another.
    pub survey_from_graph: Sim2,
    /// Standard deviation of the scale; 0 where it is held.
    pub scale_sigma: f64,
    /// Robust variance of the residuals of all edges in units of the stated one.
    pub spread: f64,
    /// What became of each edge.
    pub uses: Vec<AbsoluteUse>,
}

/// Why a graph has no placement in the survey frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unplaceable {
    /// Fewer than two different places, and none with a direction.
    TooFew,
    /// Less than half of the edges agree.
    Contradiction {
        /// Number of edges that agree.
        agree: usize,
        /// Number of all.
        of: usize,
    },
    /// The places lie too close together for a direction; its standard deviation, radians.
    NoHeading(f64),
}

impl fmt::Display for Unplaceable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooFew => {
                f.write_str("fewer than two of its places were seen; two are needed, or one with a heading")
            }
            Self::Contradiction { agree, of } => {
                write!(f, "only {agree} of {of} observations of its places agree with the path")
            }
            Self::NoHeading(sigma_rad) => write!(
                f,
                "its places that were seen leave the direction uncertain by {:.0}°; they must lie further apart",
                sigma_rad.to_degrees()
            ),
        }
    }
}

/// A scale is shown if it is this many variances from 1 (squared); noise does so in one of a
/// million graphs.
const SCALE_SHOWN: f64 = 25.0;
/// Largest standard deviation of the placement's heading, radians (10°): a placement that is less
/// certain is refused.
const HEADING_KNOWN_RAD: f64 = 10.0 * PI / 180.0;
/// Maximum number of rounds in which edges are rejected; they end when a round rejects none.
const ROUNDS: usize = 10;
/// Number of placements by pairs of edges that are compared, and of the edges that judge them: more
/// find a placement among more outliers, and the time grows with the product.
const SAMPLES: usize = 400;
const JUDGES: usize = 400;
/// Drift of the graph that a sampled placement tolerates, as a share of the distance from the
/// middle. Larger still finds the placement of a path that has drifted far, smaller rejects
/// outliers better.
const BEND_TOLERANCE: f64 = 0.02;
/// Squared residual, in variances, from which an edge counts as an outlier of a sampled placement:
/// four standard deviations.
const SAMPLE_GATE_SQUARED: f64 = 16.0;
/// Largest |ln scale| of a sampled placement: a scale of 0.82 to 1.22, wider than any error of a
/// measured height.
const MAX_LN_SCALE: f64 = 0.2;

impl PoseGraph {
    /// Adds absolute edges and optimises keyframes and placement together, in rounds of at most
    /// `steps` steps. Edges that contradict the others are left out. `start` is an approximate
    /// placement; without it one is found by sampling. Edges on unknown keyframes and those whose
    /// covariance is not positive definite count as contradicting.
    ///
    /// # Errors
    /// The reason why there is no placement; the graph is then as before.
    pub fn place(
        &mut self,
        edges: &[AbsoluteEdge],
        start: Option<Sim2>,
        steps: usize,
    ) -> Result<Placed, Unplaceable> {
        let before = self.clone();
        let placed = self.placed(edges, start, steps);
        if placed.is_err() {
            *self = before;
        }
        placed
    }

    fn placed(
        &mut self,
        edges: &[AbsoluteEdge],
        start: Option<Sim2>,
        steps: usize,
    ) -> Result<Placed, Unplaceable> {
        let start = start.or_else(|| self.sampled_placement(edges)).ok_or(Unplaceable::TooFew)?;
        let mut weighted = Vec::with_capacity(edges.len());
        let mut index = vec![None; edges.len()];
        for (edge, index) in edges.iter().zip(&mut index) {
            let node = self.index.get(&edge.keyframe).copied();
            let of = node.and_then(|node| WeightedPoint::new(node, &self.nodes[node], edge, &start));
            *index = of.is_some().then_some(weighted.len());
            weighted.extend(of);
        }
        self.survey = Some(Survey { edges: weighted, placement: start, scale: PlacementScale::Free });
        let Some(mut descent) = self.descent(Pieces::single(self), true) else {
            return Err(Unplaceable::TooFew);
        };
        self.settle(&mut descent, steps)?;
        let variance = self.spread_of_points().max(1.0);
        let of_scale = self.placement_variances(&mut descent).map(|of| of.ln_scale);
        let scale_variance = variance * of_scale.unwrap_or(f64::INFINITY);
        let ln_scale = self.placement().scale.ln();
        let is_shown = ln_scale * ln_scale > SCALE_SHOWN * scale_variance;
        if !is_shown {
            self.hold_scale();
            self.settle(&mut descent, steps)?;
        }
        let scales = self.loss_scales();
        if !self.mount_turns && self.shows_turn(&mut descent, scales) {
            self.mount_turns = true;
            self.settle(&mut descent, steps)?;
        }
        let of_heading = self.placement_variances(&mut descent).map(|of| of.heading);
        let heading_sigma_rad = of_heading.unwrap_or(PI * PI).sqrt();
        if heading_sigma_rad >= HEADING_KNOWN_RAD {
            return Err(Unplaceable::NoHeading(heading_sigma_rad.min(PI)));
        }
        if let Some(survey) = self.survey.as_mut().filter(|_| !is_shown) {
            survey.placement.scale = 1.0; // but for rounding it is
        }
        let survey_from_graph = self.placement();
        let of = |at: &Option<usize>| {
            let weighted = at.and_then(|at| self.survey.as_ref()?.edges.get(at));
            weighted.map_or(AbsoluteUse { used: false, off_m: Vector2::repeat(f64::INFINITY) }, |edge| {
                let (there_m, _) = edge.predicted(&self.nodes[edge.node], &survey_from_graph);
                AbsoluteUse { used: edge.used, off_m: edge.place_m - there_m }
            })
        };
        let uses = index.iter().map(of).collect();
        let scale_sigma = if is_shown { scale_variance.sqrt() } else { 0.0 };
        Ok(Placed { survey_from_graph, scale_sigma, spread: self.spread_of_points(), uses })
    }

    /// Optimises, leaves out the edges that contradict, and repeats until these stay the same.
    fn settle(&mut self, descent: &mut Descent, steps: usize) -> Result<(), Unplaceable> {
        for _ in 0..ROUNDS {
            // The second time with the loss that fits what is left of the residuals.
            for _ in 0..2 {
                let scales = self.loss_scales();
                self.descend(descent, scales, steps);
            }
            let variance = self.spread_of_points().max(1.0);
            let Some(survey) = &mut self.survey else { return Err(Unplaceable::TooFew) };
            let placement = survey.placement;
            let mut changes = false;
            for edge in &mut survey.edges {
                let agrees = edge.squared(&self.nodes[edge.node], &placement) <= edge.gate * variance;
                changes |= agrees != edge.used;
                edge.used = agrees;
            }
            let (agree, of) = (survey.used().count(), survey.edges.len());
            if agree == 0 || 2 * agree < of {
                return Err(Unplaceable::Contradiction { agree, of });
            }
            if !changes {
                break;
            }
        }
        Ok(())
    }

    /// The placement; the identity without absolute edges.
    fn placement(&self) -> Sim2 {
        self.survey.as_ref().map_or(Sim2::IDENTITY, |survey| survey.placement)
    }

    /// Sets the scale of the placement to 1, about the middle of the places.
    fn hold_scale(&mut self) {
        let Some(survey) = &mut self.survey else { return };
        let count = survey.used().count().max(1) as f64;
        let middle_m = survey.used().map(|edge| edge.place_m).sum::<Vector2<f64>>() / count;
        let middle = survey.placement.inverse().apply(GroundPoint::new(middle_m.x, middle_m.y));
        survey.placement.scale = 1.0;
        let moved = survey.placement.apply(middle);
        survey.placement.x_m += middle_m.x - moved.x_m;
        survey.placement.y_m += middle_m.y - moved.y_m;
        survey.scale = PlacementScale::Held;
    }

    /// Makes the survey frame the frame of the graph: transforms all keyframes by the placement,
    /// and their heights by its scale. The covariances are then those in the survey frame.
    pub fn adopt_survey_frame(&mut self) {
        let placement = self.placement();
        self.transform(&placement);
        if let Some(survey) = &mut self.survey {
            (survey.placement, survey.scale) = (Sim2::IDENTITY, PlacementScale::Adopted);
        }
    }

    /// Makes the metre of the survey frame that of the graph, about its origin.
    pub fn adopt_survey_scale(&mut self) {
        let scale = self.placement().scale;
        self.transform(&Sim2::about_origin(0.0, scale));
        if let Some(survey) = &mut self.survey {
            (survey.placement.scale, survey.scale) = (1.0, PlacementScale::Held);
        }
    }

    fn transform(&mut self, by: &Sim2) {
        for node in &mut self.nodes {
            node.pose = by.apply_to_pose(&node.pose);
        }
    }

    /// The placement by a pair of edges, or by one with a direction, that most edges agree with.
    fn sampled_placement(&self, edges: &[AbsoluteEdge]) -> Option<Sim2> {
        let known: Vec<SurveyedPoint> = edges
            .iter()
            .filter_map(|edge| SurveyedPoint::new(&self.nodes[*self.index.get(&edge.keyframe)?], edge))
            .collect();
        let pairs = known.len() * known.len().saturating_sub(1) / 2;
        let mut random = Random::new(known.len() as u64);
        let mut chosen: Vec<(usize, usize)> = Vec::new();
        if pairs <= SAMPLES {
            chosen.extend((0..known.len()).flat_map(|b| (0..b).map(move |a| (a, b))));
        } else {
            chosen.extend((0..SAMPLES).map(|_| (random.below(known.len()), random.below(known.len()))));
        }
        let by_pairs = chosen.into_iter().filter_map(|(a, b)| known[a].placement_with(&known[b]));
        let by_directions = known.iter().take(SAMPLES).filter_map(SurveyedPoint::placement);
        let step = known.len().div_ceil(JUDGES).max(1);
        let cost = |placement: &Sim2| -> f64 {
            known.iter().step_by(step).map(|judge| judge.sample_cost(placement)).sum()
        };
        let judged = by_pairs.chain(by_directions).map(|placement| (cost(&placement), placement));
        judged.min_by(|(a, _), (b, _)| a.total_cmp(b)).map(|(_, placement)| placement)
    }
}

/// A point of the graph and its surveyed position.
struct SurveyedPoint {
    point_m: Vector2<f64>,
    direction_rad: f64,
    place_m: Vector2<f64>,
    heading_rad: Option<f64>,
    variance_m2: f64,
}

impl SurveyedPoint {
    fn new(node: &Node, edge: &AbsoluteEdge) -> Option<Self> {
        let world_from_node = node.world_from_node();
        let point = world_from_node.apply(GroundPoint::new(edge.point_m.x, edge.point_m.y));
        let variance_m2 =
            0.5 * (edge.place_covariance_m2.trace() + edge.covariance[(X, X)] + edge.covariance[(Y, Y)]);
        let found = Self {
            point_m: Vector2::new(point.x_m, point.y_m),
            direction_rad: world_from_node.heading_rad + edge.direction_rad,
            place_m: edge.place_m,
            heading_rad: edge.heading.map(|(heading_rad, _)| heading_rad),
            variance_m2,
        };
        let finite = found.point_m.iter().chain(&found.place_m).all(|value| value.is_finite());
        (finite && variance_m2 > 0.0).then_some(found)
    }

    /// The placement under which this point is at its place, turned by `heading_rad` and scaled.
    fn through(&self, heading_rad: f64, scale: f64) -> Sim2 {
        let turned = Sim2::about_origin(heading_rad, scale);
        let (x_m, y_m) = turned.rotate(self.point_m.x, self.point_m.y);
        Sim2 { x_m: self.place_m.x - x_m, y_m: self.place_m.y - y_m, ..turned }
    }

    fn placement_with(&self, other: &Self) -> Option<Sim2> {
        let (in_graph, in_survey) = (other.point_m - self.point_m, other.place_m - self.place_m);
        let scale = in_survey.norm() / in_graph.norm();
        let heading_rad = in_survey.y.atan2(in_survey.x) - in_graph.y.atan2(in_graph.x);
        (scale.is_finite() && scale > 0.0 && scale.ln().abs() < MAX_LN_SCALE)
            .then(|| self.through(heading_rad, scale))
    }

    fn placement(&self) -> Option<Sim2> {
        self.heading_rad.map(|heading_rad| self.through(heading_rad - self.direction_rad, 1.0))
    }

    fn sample_cost(&self, placement: &Sim2) -> f64 {
        let there = placement.apply(GroundPoint::new(self.point_m.x, self.point_m.y));
        let off_m = Vector2::new(there.x_m, there.y_m) - self.place_m;
        let bent_m = BEND_TOLERANCE * self.point_m.norm();
        (off_m.norm_squared() / (self.variance_m2 + bent_m * bent_m)).min(SAMPLE_GATE_SQUARED)
    }
}
