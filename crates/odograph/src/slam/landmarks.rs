//! Markers in the map: sightings of the same number close loops, and surveyed ones place the map in
//! the survey frame.

use super::Mapper;
use super::mapper::STEPS_AT_THE_END;
use crate::error::Result;
use crate::geometry::{Se2, Sim2, wrap_angle};
use crate::ground_map::KeyframeStore;
use crate::keyframe::relative_pose::{compose, inverse};
use crate::keyframe::{KeyframeId, MapEdge};
use crate::landmark::{ControlPoint, MarkerSighting, PlacedSighting};
use crate::pose_graph::{AbsoluteEdge, AbsoluteUse, Heights, Placed, Unplaceable};
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// A place of a marker in the map.
#[derive(Debug, Clone, PartialEq)]
pub struct Landmark {
    /// Number of the marker.
    pub number: u32,
    /// Where it is in the map frame: its centre, and the direction of its top as printed.
    pub pose: Se2,
    /// Root mean square distance of its sightings from there, metres.
    pub spread_m: f64,
    /// Number of its sightings.
    pub sightings: usize,
    /// How many times the camera came to it.
    pub visits: usize,
    /// Mean side of its black square as seen, metres.
    pub side_m: f64,
    /// Whether another place has the same number and more sightings.
    pub is_double: bool,
    /// What became of its control point: its distance from there, and how many of its sightings
    /// were used; `None` if it has none.
    pub control: Option<ControlUse>,
}

/// What became of the control point of a landmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlUse {
    /// Median distance of its sightings from the control point, metres.
    pub off_m: f64,
    /// Sightings that were used; the others contradict.
    pub used: usize,
}

/// The map in the survey frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Surveyed {
    /// From the frame that the map had before, that of its first keyframe.
    pub survey_from_map: Sim2,
    /// Standard deviation of its scale; 0 where the control points show none, and it is 1.
    pub scale_sigma: f64,
    /// What became of each sighting of a surveyed marker.
    uses: BTreeMap<usize, AbsoluteUse>,
}

/// Number of keyframes without a marker after which the next sighting is a new visit.
const AWAY: u64 = 8;
/// Gate of the squared residual of an edge between sightings: one in a thousand true ones exceeds
/// it (chi-square, three degrees of freedom).
const GATE_SQUARED: f64 = 16.3;
/// A path between two sightings is tested with this multiple of its standard deviations plus a
/// constant, metres and radians: the test is to reject another marker of the same number, not a
/// drift of the path.
const PATH_FACTOR: f64 = 3.0;
const PATH_OFF: (f64, f64) = (0.02, 0.02);

impl Mapper {
    /// Remembers the markers that earlier sessions of the map have seen, in order of time: those of
    /// the new session are tied to them. To be called before the first keyframe of the session.
    pub fn remember_sightings(&mut self, sightings: Vec<PlacedSighting>) {
        self.landmarks.sightings = sightings;
    }

    /// The sightings of the session, in order of time.
    pub fn own_sightings(&self) -> &[PlacedSighting] {
        let of = &self.landmarks.sightings;
        let earlier = of.iter().take_while(|at| !self.is_new(at.sighting.keyframe)).count();
        &of[earlier..]
    }

    /// Adds edges from the newest keyframe of the run to those that have shown the same markers.
    /// Fails if an edge cannot be stored.
    pub fn add_sightings(
        &mut self,
        sightings: &[MarkerSighting],
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        for sighting in sightings {
            let keyframe = self.number_in_map(sighting.keyframe);
            if self.keyframe(keyframe).is_some() {
                self.add_sighting(MarkerSighting { keyframe, ..*sighting }, images)?;
            }
        }
        self.settle_where_due();
        Ok(())
    }

    fn add_sighting(&mut self, sighting: MarkerSighting, images: &mut dyn KeyframeStore) -> Result<()> {
        let same = |at: &&PlacedSighting| at.sighting.number == sighting.number;
        let known = self.landmarks.sightings.iter().filter(same);
        let places = known.clone().map(|at| at.place + 1).max().unwrap_or(0);
        for place in 0..places {
            let of_place: Vec<PlacedSighting> =
                known.clone().filter(|at| at.place == place).copied().collect();
            let Some(last) = of_place.last() else { continue };
            let first_visit = of_place.iter().filter(|at| at.visit == 0).count();
            let returns = last.sighting.keyframe.0 + AWAY < sighting.keyframe.0
                || self.session_of(last.sighting.keyframe) != self.session_of(sighting.keyframe);
            let visit = last.visit + usize::from(returns);
            let of_visit = of_place.iter().filter(|at| at.visit == visit).count();
            let to = if visit == 0 { *last } else { of_place[of_visit % first_visit.max(1)] };
            let Some(edge) = self.marker_edge(&to.sighting, &sighting) else { continue };
            if !self.is_consistent(&edge) {
                continue;
            }
            let placement = PlacedSighting { sighting, place, visit };
            self.landmarks.sightings.push(placement);
            // The ground around a marker relates neighbouring keyframes more accurately.
            // Of a map that is merged the edges are known.
            let is_known = !self.compares(sighting.keyframe, to.sighting.keyframe);
            return if visit == 0 || is_known { Ok(()) } else { self.close_loop(edge, images) };
        }
        self.landmarks.sightings.push(PlacedSighting { sighting, place: places, visit: 0 });
        Ok(())
    }

    fn session_of(&self, keyframe: KeyframeId) -> Option<u32> {
        self.keyframe(keyframe).map(|keyframe| keyframe.session)
    }

    fn marker_edge(&self, from: &MarkerSighting, to: &MarkerSighting) -> Option<MapEdge> {
        let heights_m = self.measured_m(from.keyframe, to.keyframe)?;
        Some(from.edge_to(to, heights_m, self.heights() == Heights::Held))
    }

    /// Whether an edge is consistent with the path between its keyframes: whether the marker can be
    /// the same.
    fn is_consistent(&self, edge: &MapEdge) -> bool {
        let reached = self.graph.reach(edge.from).and_then(|mut reach| reach.to(edge.to));
        let Some(reached) = reached.filter(|reached| !reached.across_gap) else { return true };
        let off = (edge.motion - reached.motion).xyz();
        let off = Vector3::new(off.x, off.y, wrap_angle(off.z));
        let path = reached.covariance.fixed_view::<3, 3>(0, 0).into_owned() * PATH_FACTOR.powi(2);
        let (off_m, off_rad) = PATH_OFF;
        let besides = Matrix3::from_diagonal(&Vector3::new(off_m * off_m, off_m * off_m, off_rad * off_rad));
        let covariance = path + besides + edge.covariance.fixed_view::<3, 3>(0, 0);
        covariance.try_inverse().is_some_and(|information| off.dot(&(information * off)) <= GATE_SQUARED)
    }

    /// Adds an edge. A part of the map that no measurement connects yet is moved to where the
    /// marker puts it.
    fn close_loop(&mut self, edge: MapEdge, images: &mut dyn KeyframeStore) -> Result<()> {
        let mut is_moved = false;
        if let (Some(from), Some(measured_m)) =
            (self.graph.pose(edge.from), self.measured_m(edge.from, edge.to))
        {
            let seen = compose(&from, &edge.motion, from.height_m / measured_m[0]);
            is_moved = self.graph.move_component(edge.to, &seen, edge.from);
            if !is_moved && let Some(to) = self.graph.pose(edge.to) {
                let back = inverse(&edge.motion, measured_m);
                let seen = compose(&to, &back, to.height_m / measured_m[1]);
                is_moved = self.graph.move_component(edge.from, &seen, edge.to);
            }
        }
        self.landmarks.edges += 1;
        self.add(edge, images)?;
        self.settle_if_moved(is_moved);
        Ok(())
    }

    /// Number of edges between sightings of markers that the session has added.
    pub fn marker_edges(&self) -> usize {
        self.landmarks.edges
    }

    /// Number of sightings of markers by the session.
    pub fn marker_sightings(&self) -> usize {
        self.own_sightings().len()
    }

    /// Rescales the sightings after the metres of their keyframes have changed by these factors.
    pub(super) fn rescale_sightings(&mut self, factor: impl Fn(KeyframeId) -> f64) {
        for at in &mut self.landmarks.sightings {
            at.sighting = at.sighting.rescaled(factor(at.sighting.keyframe));
        }
    }

    /// Places the map in the survey frame of its control points, at the end of a session after
    /// [`Mapper::finish`]: keyframes are optimised again together with the placement, and all poses
    /// are then in the survey frame, in its metres.
    ///
    /// # Errors
    /// The reason why the map stays in its own frame; it is then not changed.
    pub fn survey(&mut self, control: &[ControlPoint]) -> std::result::Result<Surveyed, Unplaceable> {
        let control: BTreeMap<u32, &ControlPoint> = control.iter().map(|at| (at.number, at)).collect();
        let mut counts: BTreeMap<(u32, usize), usize> = BTreeMap::new();
        for at in &self.landmarks.sightings {
            *counts.entry((at.sighting.number, at.place)).or_default() += 1;
        }
        let (mut edges, mut index) = (Vec::new(), Vec::new());
        for (at, PlacedSighting { sighting, place, .. }) in self.landmarks.sightings.iter().enumerate() {
            let Some(point) = control.get(&sighting.number) else { continue };
            let count = counts.get(&(sighting.number, *place)).copied().unwrap_or(1) as f64;
            let Se2 { x_m, y_m, heading_rad } = sighting.keyframe_from_marker;
            index.push(at);
            edges.push(AbsoluteEdge {
                keyframe: sighting.keyframe,
                point_m: Vector2::new(x_m, y_m),
                direction_rad: heading_rad,
                covariance: sighting.covariance,
                place_m: Vector2::new(point.x_m, point.y_m),
                // All sightings of a marker share the error of its place.
                place_covariance_m2: Matrix2::from_diagonal_element(point.sigma_m.powi(2) * count),
                heading: point
                    .heading_rad
                    .map(|heading_rad| (heading_rad, ControlPoint::HEADING_SIGMA_RAD.powi(2) * count)),
            });
        }
        let Placed { survey_from_graph, scale_sigma, uses, .. } =
            self.graph.place(&edges, None, STEPS_AT_THE_END)?;
        self.graph.adopt_survey_frame();
        self.is_surveyed = true;
        self.take_over_graph();
        let uses = index.into_iter().zip(uses).collect();
        Ok(Surveyed { survey_from_map: survey_from_graph, scale_sigma, uses })
    }

    /// The markers that the session has seen where the final map has them, in order of their
    /// numbers; those of earlier sessions at other places too, where the number is the same.
    pub fn landmarks(&self, surveyed: Option<&Surveyed>) -> Vec<Landmark> {
        let mut of_place: BTreeMap<(u32, usize), Vec<usize>> = BTreeMap::new();
        for (at, PlacedSighting { sighting, place, .. }) in self.landmarks.sightings.iter().enumerate() {
            of_place.entry((sighting.number, *place)).or_default().push(at);
        }
        let seen: BTreeSet<u32> = self.own_sightings().iter().map(|at| at.sighting.number).collect();
        of_place.retain(|(number, _), _| seen.contains(number));
        let mut most: BTreeMap<u32, (usize, usize)> = BTreeMap::new();
        for (&(number, place), sightings) in &of_place {
            let best = most.entry(number).or_insert((0, place));
            if sightings.len() > best.0 {
                *best = (sightings.len(), place);
            }
        }
        let landmark = |(&(number, place), at): (&(u32, usize), &Vec<usize>)| {
            let poses: Vec<Se2> = at.iter().filter_map(|&at| self.in_map_frame(at)).collect();
            let count = poses.len().max(1) as f64;
            let sum = poses.iter().fold(Vector2::zeros(), |sum, pose| sum + Vector2::new(pose.x_m, pose.y_m));
            let centre = sum / count;
            let (sin, cos) = poses.iter().fold((0.0, 0.0), |(sin, cos), pose| {
                (sin + pose.heading_rad.sin(), cos + pose.heading_rad.cos())
            });
            let off_m2 = |pose: &Se2| (Vector2::new(pose.x_m, pose.y_m) - centre).norm_squared();
            let sightings = || at.iter().map(|&at| &self.landmarks.sightings[at]);
            let control = surveyed.and_then(|surveyed| {
                let mut uses: Vec<AbsoluteUse> =
                    at.iter().filter_map(|at| surveyed.uses.get(at).copied()).collect();
                uses.sort_by(|a, b| a.off_m.norm().total_cmp(&b.off_m.norm()));
                let used = uses.iter().filter(|of| of.used).count();
                uses.get(uses.len() / 2).map(|middle| ControlUse { off_m: middle.off_m.norm(), used })
            });
            Landmark {
                number,
                pose: Se2::new(centre.x, centre.y, sin.atan2(cos)),
                spread_m: (poses.iter().map(off_m2).sum::<f64>() / count).sqrt(),
                sightings: at.len(),
                visits: sightings().map(|at| at.visit + 1).max().unwrap_or(0),
                side_m: sightings().map(|at| at.sighting.side_m).sum::<f64>() / at.len().max(1) as f64,
                is_double: most.get(&number).is_some_and(|best| best.1 != place),
                control,
            }
        };
        of_place.iter().map(landmark).collect()
    }

    fn in_map_frame(&self, at: usize) -> Option<Se2> {
        let sighting = &self.landmarks.sightings.get(at)?.sighting;
        Some(sighting.in_map(self.keyframe(sighting.keyframe)?).transform)
    }
}
