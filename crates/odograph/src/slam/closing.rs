//! Closing loops: a new keyframe compared with older ones, and what is believed of what is seen.

use super::Mapper;
use super::candidates::{self, Strength};
use super::closure::{self, LoopClosure};
use super::images::KeyframeStore;
use super::recognition::recognise;
use crate::error::Result;
use crate::geometry::WithCovariance;
use crate::mapping::plane_motion::{inverse, laid_from, similarity};
use crate::mapping::{KeyframeId, MapEdge};
use crate::odometry::matching::{Pictured, Sought};
use nalgebra::{Matrix4, Vector4};

/// Two sightings speak for each other only when they are of different ground: so many views apart at least.
const APART_VIEWS: f64 = 0.3;

/// Sightings that found no second are forgotten beyond this number, the oldest first.
const MOST_PENDING: usize = 16;

/// Two keyframes are tied by at most so many loops. The noise of their own two images is in every one of them, so that more would add little; and who
/// goes the same round all day has a graph that does not grow.
const MOST_SIGHTINGS: usize = 4;

/// Whether to try again what takes long: after every time in a row that it led to nothing, twice as many occasions are let go by.
#[derive(Debug, Default)]
pub(super) struct Patience {
    failures: u32,
    let_go_by: u32,
}

/// At most so many occasions are let go by, about: two to the power of this.
const MOST_DOUBLINGS: u32 = 5;

impl Patience {
    /// Whether this is an occasion to try.
    fn is_worth_it(&mut self) -> bool {
        let rest = self.let_go_by.checked_sub(1);
        self.let_go_by = rest.unwrap_or(0);
        rest.is_none()
    }

    /// What came of it.
    fn learn(&mut self, succeeded: bool) {
        self.failures = if succeeded { 0 } else { (self.failures + 1).min(MOST_DOUBLINGS) };
        self.let_go_by = (1 << self.failures) - 1;
    }
}

impl Mapper {
    /// Compares a new keyframe with the older ones that it may show again: those that are near, and where that is not sure, those that look like it.
    pub(super) fn close_loops(
        &mut self,
        new: KeyframeId,
        mut sought: Sought,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        // Both that ask for them walk the same ways.
        let Some(mut reach) = self.graph.reach(new) else { return Ok(()) };
        let near = {
            let compared = |id: KeyframeId| id == new || self.own_loops || !self.is_new(id);
            let known = |id: KeyframeId| {
                self.keyframe(id).filter(|_| compared(id)).map(|keyframe| keyframe.odometry_pose)
            };
            candidates::candidates(&self.graph, &mut reach, new, &known, &self.matcher, &self.config)
        };
        let sure = near.iter().filter(|candidate| candidate.prior.strength == Strength::Sure);
        for candidate in sure.take(self.config.comparisons) {
            let Some(mut pictured) = self.pictured(candidate.id, images)? else { continue };
            let closure =
                closure::look(&self.matcher, &mut sought, &mut pictured, candidate, new, &self.config);
            if let Some(closure) = closure {
                return self.accept(closure, images);
            }
        }
        let recognised = {
            let Some(keyframe) = self.keyframe(new) else { return Ok(()) };
            let here = (new, &keyframe.odometry_pose);
            let least = self.config.least_edges;
            recognise(
                &self.places,
                &keyframe.signature,
                &self.graph,
                Some(&mut reach),
                here,
                least,
                &self.matcher,
            )
        };
        for place in recognised.iter().take(self.config.comparisons) {
            let Some(pictured) = self.pictured(place.id, images)? else { continue };
            let closure =
                closure::look_recognised(&self.matcher, &sought, &pictured, place, new, &self.config);
            match closure {
                Some(closure) if place.stands_alone() => return self.accept(closure, images),
                Some(closure) => return self.support(closure, images),
                None => {}
            }
        }
        // The whole pictures compared take longest: only where place is nearly known and appearance did not tell.
        let doubtful = near.iter().find(|candidate| candidate.prior.strength == Strength::Doubtful);
        if let Some(candidate) = doubtful.filter(|_| self.patience.is_worth_it())
            && let Some(mut pictured) = self.pictured(candidate.id, images)?
        {
            let closure =
                closure::look(&self.matcher, &mut sought, &mut pictured, candidate, new, &self.config);
            self.patience.learn(closure.is_some());
            if let Some(closure) = closure {
                self.accept(closure, images)?;
            }
        }
        Ok(())
    }

    fn pictured(&self, id: KeyframeId, images: &mut dyn KeyframeStore) -> Result<Option<Pictured>> {
        let Some(pose) = self.keyframe(id).map(|old| old.odometry_pose) else { return Ok(None) };
        Ok(Some(self.matcher.pictured(images.load(id)?.gray, &pose)))
    }

    /// Accepts a sighting that alone is not enough together with one before that speaks for the same.
    fn support(&mut self, closure: LoopClosure, images: &mut dyn KeyframeStore) -> Result<()> {
        if self.config.sightings < 2 {
            return self.accept(closure, images);
        }
        let second = self.pending.iter().position(|other| self.agree(other, &closure));
        if let Some(at) = second {
            let first = self.pending.remove(at);
            self.accept(first, images)?;
            self.relax();
            return self.accept(closure, images);
        }
        self.pending.push(closure);
        if self.pending.len() > MOST_PENDING {
            self.pending.remove(0);
        }
        Ok(())
    }

    /// Whether two sightings of different ground say the same about the map: with the first in it, the second is where it should be.
    fn agree(&self, first: &LoopClosure, second: &LoopClosure) -> bool {
        let (a, b) = (&first.edge, &second.edge);
        let [Some(here), Some(there)] = [a.from, b.from].map(|id| self.keyframe(id).map(|k| k.odometry_pose))
        else {
            return false;
        };
        let view_m = self.matcher.view_m(&here);
        if (here.x_m - there.x_m).hypot(here.y_m - there.y_m) < APART_VIEWS * view_m {
            return false;
        }
        let known = |from: KeyframeId, to: KeyframeId, motion: &Vector4<f64>, covariance: Matrix4<f64>| {
            let transform = similarity(motion, self.measured_m(from, to)?);
            Some(WithCovariance { transform, covariance })
        };
        let way = |from: KeyframeId, to: KeyframeId| {
            let reached = self.graph.reach(from)?.to(to).filter(|reached| !reached.across_gap)?;
            known(from, to, &reached.motion, reached.covariance)
        };
        let sighting = known(a.from, a.to, &a.motion, a.covariance);
        let (Some(back), Some(sighting), Some(on)) = (way(b.from, a.from), sighting, way(a.to, b.to)) else {
            return false;
        };
        closure::agrees(b, &(back * sighting * on), view_m)
    }

    /// The heights at which two keyframes measure.
    fn measured_m(&self, from: KeyframeId, to: KeyframeId) -> Option<[f64; 2]> {
        let height_m = |id| self.keyframe(id).map(|keyframe| keyframe.odometry_pose.height_m);
        Some([height_m(from)?, height_m(to)?])
    }

    fn accept(&mut self, closure: LoopClosure, images: &mut dyn KeyframeStore) -> Result<()> {
        let edge = closure.edge;
        if let (Some(old), Some(measured_m)) = (self.graph.pose(edge.to), self.measured_m(edge.from, edge.to))
        {
            // A part that nothing measured connects comes to where it is seen.
            let seen = laid_from(&old, &inverse(&edge.motion, measured_m), old.height_m / measured_m[1]);
            self.graph.bring(edge.from, &seen, edge.to);
        }
        self.closures.push(closure);
        self.add(edge, images)
    }

    /// Ties two keyframes, unless they have been seen from each other often enough.
    pub(super) fn add(&mut self, edge: MapEdge, images: &mut dyn KeyframeStore) -> Result<()> {
        let often = self.graph.loops_between(edge.from, edge.to) >= MOST_SIGHTINGS;
        if often || !self.graph.tie(&edge) {
            return Ok(());
        }
        self.map.edges.push(edge);
        self.unsettled += 1;
        images.tie(&edge)
    }
}
