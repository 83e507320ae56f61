//! The mapper: keyframes go in as they are made, loops are found, and the map is kept straight.

use super::SlamConfig;
use super::candidates::{self, Strength};
use super::closure::{self, LoopClosure};
use super::images::KeyframeStore;
use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::geometry::GroundPose;
use crate::mapping::graph::{Heights, PoseGraph};
use crate::mapping::places::Signature;
use crate::mapping::plane_motion::{laid_from, seen_from};
use crate::mapping::{EdgeKind, GroundMap, KeyframeId, KeyframeImage, MapEdge, MapKeyframe};
use crate::motion::MotionModel;
use crate::odometry::matching::{Matcher, Sought};
use crate::odometry::{KeyframeEvent, NewKeyframe, OdometryConfig};
use nalgebra::Matrix6;
use std::collections::BTreeMap;

/// Makes the map of keyframes. What comes out depends on what goes in alone.
#[derive(Debug)]
pub struct Mapper {
    config: SlamConfig,
    matcher: Matcher,
    graph: PoseGraph,
    map: GroundMap,
    /// Where in the map each keyframe is.
    index: BTreeMap<KeyframeId, usize>,
    closures: Vec<LoopClosure>,
    /// Sightings for which one is not enough.
    pending: Vec<LoopClosure>,
    /// Loops since the last optimisation.
    unsettled: usize,
}

/// An optimisation while running takes at most so many steps: what is left, the next brings.
const STEPS_ON_THE_WAY: usize = 2;

/// At the end there is time.
const STEPS_AT_THE_END: usize = 60;

/// A loop that misses by more than this many variances is worth an optimisation at once.
const MISFIT: f64 = 9.0;

/// Two sightings speak for each other only when they are of different ground: so many views apart at least.
const APART_VIEWS: f64 = 0.3;

/// Sightings that found no second are forgotten beyond this number, the oldest first.
const MOST_PENDING: usize = 16;

impl Mapper {
    /// A mapper without a map yet.
    pub fn new(camera: &Camera, rig: Rig, odometry: &OdometryConfig, config: SlamConfig) -> Self {
        let heights = match odometry.motion.model {
            MotionModel::Similarity | MotionModel::Free => Heights::Free,
            _ => Heights::Held,
        };
        Self {
            matcher: Matcher::new(camera, odometry),
            graph: PoseGraph::new(heights, rig.first_pose().height_m),
            map: GroundMap { camera: camera.clone(), rig, keyframes: Vec::new(), edges: Vec::new() },
            index: BTreeMap::new(),
            closures: Vec::new(),
            pending: Vec::new(),
            unsettled: 0,
            // A mean vector knows no heading, so nothing that it comes back to fits.
            config: SlamConfig {
                loops: config.loops && odometry.motion.model != MotionModel::Mean,
                ..config
            },
        }
    }

    /// Takes what happened to a keyframe. Fails where an image cannot be kept or read.
    pub fn take(&mut self, event: KeyframeEvent, images: &mut dyn KeyframeStore) -> Result<()> {
        match event {
            KeyframeEvent::Made(new) => {
                let id = self.insert(&new);
                let gray = new.image;
                if self.config.loops {
                    let sought = self.matcher.sought(gray.clone(), &new.pose);
                    images.keep(id, KeyframeImage { gray, color: None })?;
                    self.close_loops(id, sought, images)?;
                }
            }
            KeyframeEvent::Revisited(edge) if self.config.loops => self.add(edge),
            KeyframeEvent::Revisited(_) => {}
        }
        if self.unsettled > 0 && self.is_due() {
            self.settle(STEPS_ON_THE_WAY);
        }
        Ok(())
    }

    /// Ends the session: every pose is where all edges agree best, with its covariance.
    pub fn finish(&mut self) {
        self.settle(STEPS_AT_THE_END);
        if !self.is_straightened() {
            return;
        }
        let covariances = self.graph.covariances();
        let found: BTreeMap<KeyframeId, _> = self.graph.poses().map(|(id, _)| id).zip(covariances).collect();
        for keyframe in &mut self.map.keyframes {
            let Some(covariance) = found.get(&keyframe.id) else { continue };
            let height_m = keyframe.pose.height_m;
            let tilt = keyframe.covariance.fixed_view::<2, 2>(4, 4).into_owned();
            let height_variance = keyframe.covariance[(3, 3)];
            let mut whole = Matrix6::zeros();
            let mut by_height = nalgebra::Matrix4::identity();
            by_height[(3, 3)] = height_m;
            whole.fixed_view_mut::<4, 4>(0, 0).copy_from(&(by_height * covariance * by_height));
            if whole[(3, 3)] == 0.0 {
                whole[(3, 3)] = height_variance; // held by the rig, or what odometry knows of it
            }
            whole.fixed_view_mut::<2, 2>(4, 4).copy_from(&tilt);
            keyframe.covariance = whole;
        }
    }

    /// The map as it is.
    pub fn map(&self) -> &GroundMap {
        &self.map
    }

    /// The loops that were closed, in order; those that odometry closed by itself are not among them.
    pub fn closures(&self) -> &[LoopClosure] {
        &self.closures
    }

    /// Whether loops have moved anything: without them the map frame is the odometry frame.
    pub fn is_straightened(&self) -> bool {
        self.map.edges.iter().any(|edge| edge.kind == EdgeKind::Loop)
    }

    /// The turn per metre ahead and to the left that the loops have shown the mount to make, radians.
    pub fn turn_per_m(&self) -> (f64, f64) {
        self.graph.turn_per_m()
    }

    /// Where a pose that was measured against a keyframe is in the map as known now; `None` where there is no such keyframe.
    pub fn in_map(&self, keyframe: KeyframeId, odometry: &GroundPose) -> Option<GroundPose> {
        let keyframe = self.keyframe(keyframe)?;
        if keyframe.pose == keyframe.odometry_pose {
            return Some(*odometry);
        }
        let scale = keyframe.pose.height_m / keyframe.odometry_pose.height_m;
        let laid = laid_from(&keyframe.pose, &seen_from(&keyframe.odometry_pose, odometry), scale);
        let turned = keyframe.pose.heading_rad - keyframe.odometry_pose.heading_rad;
        Some(GroundPose {
            // Whole turns are kept.
            heading_rad: odometry.heading_rad + turned,
            roll_rad: odometry.roll_rad,
            pitch_rad: odometry.pitch_rad,
            ..laid
        })
    }

    pub(super) fn keyframe(&self, id: KeyframeId) -> Option<&MapKeyframe> {
        self.index.get(&id).map(|&at| &self.map.keyframes[at])
    }

    /// Lays a new keyframe in the map, where the one it was measured against has it.
    fn insert(&mut self, new: &NewKeyframe) -> KeyframeId {
        let id = new.id;
        let pose = match &new.tie {
            Some(tie) if self.is_straightened() => self.in_map(tie.from, &new.pose).unwrap_or(new.pose),
            _ => new.pose,
        };
        self.graph.insert(id, pose, new.pose.height_m);
        self.index.insert(id, self.map.keyframes.len());
        self.map.keyframes.push(MapKeyframe {
            id,
            session: 0,
            segment: new.segment,
            frame: new.frame,
            time_s: new.time_s,
            odometry_pose: new.pose,
            pose,
            covariance: new.covariance,
            signature: Signature::default(),
        });
        if let Some(tie) = new.tie {
            self.graph.tie(&tie);
            self.map.edges.push(tie);
        }
        id
    }

    /// Compares a new keyframe with the older ones that it may show again.
    fn close_loops(
        &mut self,
        new: KeyframeId,
        mut sought: Sought,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        let found = {
            let known = |id: KeyframeId| self.keyframe(id).map(|keyframe| keyframe.odometry_pose);
            candidates::candidates(&self.graph, new, &known, &self.matcher, &self.config)
        };
        for candidate in found.into_iter().take(self.config.comparisons) {
            let Some(pose) = self.keyframe(candidate.id).map(|old| old.odometry_pose) else { continue };
            let mut pictured = self.matcher.pictured(images.load(candidate.id)?.gray, &pose);
            let closure =
                closure::look(&self.matcher, &mut sought, &mut pictured, &candidate, new, &self.config);
            let Some(closure) = closure else { continue };
            if candidate.prior.strength == Strength::Weak {
                self.support(closure);
            } else {
                self.accept(closure);
                break;
            }
        }
        Ok(())
    }

    /// Accepts a sighting that alone is not enough together with one before that speaks for the same.
    fn support(&mut self, closure: LoopClosure) {
        let second = self.pending.iter().position(|other| self.agree(other, &closure));
        match second {
            Some(at) => {
                let first = self.pending.remove(at);
                self.accept(first);
                self.settle(STEPS_ON_THE_WAY);
                self.accept(closure);
            }
            None => {
                self.pending.push(closure);
                if self.pending.len() > MOST_PENDING {
                    self.pending.remove(0);
                }
            }
        }
    }

    /// Whether two sightings of different ground say the same about the map: with the first in it, the second is where it should be.
    fn agree(&self, first: &LoopClosure, second: &LoopClosure) -> bool {
        let places = [first.edge.from, second.edge.from].map(|id| self.keyframe(id).map(|k| k.odometry_pose));
        let [Some(a), Some(b)] = places else { return false };
        if (a.x_m - b.x_m).hypot(a.y_m - b.y_m) < APART_VIEWS * self.matcher.view_m(&a) {
            return false;
        }
        let mut graph = self.graph.clone();
        if !graph.tie(&first.edge) {
            return false;
        }
        graph.optimize(STEPS_AT_THE_END);
        let Some(mut reach) = graph.reach(second.edge.from) else { return false };
        reach
            .find(|reached| reached.id == second.edge.to)
            .is_some_and(|reached| closure::agrees(&second.edge, &reached, self.matcher.view_m(&b)))
    }

    fn accept(&mut self, closure: LoopClosure) {
        self.add(closure.edge);
        self.closures.push(closure);
    }

    fn add(&mut self, edge: MapEdge) {
        if self.graph.tie(&edge) {
            self.map.edges.push(edge);
            self.unsettled += 1;
        }
    }

    /// Whether the loops since the last optimisation are worth one: where they show the path to be bent, and otherwise in proportion to the map.
    fn is_due(&self) -> bool {
        let last = self.map.edges.iter().rev().filter(|edge| edge.kind == EdgeKind::Loop);
        let bent = last.take(1).any(|edge| self.graph.misfit(edge).is_some_and(|misfit| misfit > MISFIT));
        bent || 20 * self.unsettled > self.map.keyframes.len()
    }

    /// Optimises, and takes the poses over into the map.
    fn settle(&mut self, steps: usize) {
        if !self.is_straightened() {
            return;
        }
        self.graph.optimize(steps);
        self.unsettled = 0;
        for keyframe in &mut self.map.keyframes {
            if let Some(pose) = self.graph.pose(keyframe.id) {
                keyframe.pose = pose;
            }
        }
    }
}
