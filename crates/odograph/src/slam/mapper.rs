//! The mapper: keyframes go in as they are made, loops are found, and the map is kept straight.

use super::SlamConfig;
use super::closing::Patience;
use super::closure::LoopClosure;
use super::images::KeyframeStore;
use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::geometry::pose_index::{HEIGHT, ROLL};
use crate::geometry::{GroundPose, propagated};
use crate::image::RgbImage;
use crate::mapping::graph::{Heights, PoseGraph};
use crate::mapping::places::{PlaceIndex, PlacesConfig, Signature};
use crate::mapping::{EdgeKind, GroundMap, KeyframeId, KeyframeImage, MapEdge, MapKeyframe};
use crate::motion::MotionModel;
use crate::odometry::matching::Matcher;
use crate::odometry::{KeyframeEvent, NewKeyframe, OdometryConfig};
use nalgebra::Matrix6;
use std::collections::BTreeMap;

/// Makes the map of keyframes. What comes out depends on what goes in alone.
#[derive(Debug)]
pub struct Mapper {
    pub(super) config: SlamConfig,
    heights: Heights,
    pub(super) matcher: Matcher,
    pub(super) graph: PoseGraph,
    pub(super) places: PlaceIndex,
    pub(super) places_config: PlacesConfig,
    pub(super) map: GroundMap,
    /// Where in the map each keyframe is.
    index: BTreeMap<KeyframeId, usize>,
    pub(super) closures: Vec<LoopClosure>,
    /// Sightings for which one is not enough.
    pub(super) pending: Vec<LoopClosure>,
    /// With comparing whole pictures.
    pub(super) patience: Patience,
    /// Loops since the last optimisation.
    pub(super) unsettled: usize,
    /// The run that is being mapped, and what its keyframes' numbers begin with.
    session: u32,
    first: u64,
    /// Whether keyframes of the run are compared with each other: not where all that ties them is known.
    pub(super) own_loops: bool,
    /// Whether there is no time to look for loops.
    hurried: bool,
}

/// An optimisation while running takes at most so many steps: what is left, the next brings.
const STEPS_ON_THE_WAY: usize = 2;

/// At the end there is time.
const STEPS_AT_THE_END: usize = 60;

/// A loop that misses by more than this many variances is worth an optimisation at once.
const MISFIT: f64 = 9.0;

impl Mapper {
    /// A mapper without a map yet.
    pub fn new(camera: &Camera, rig: Rig, odometry: &OdometryConfig, config: SlamConfig) -> Self {
        let heights = match odometry.motion.model {
            MotionModel::Similarity | MotionModel::Free => Heights::Free,
            _ => Heights::Held,
        };
        let height_m = rig.first_pose().height_m;
        let places_config = PlacesConfig::new(camera, height_m);
        Self {
            heights,
            matcher: Matcher::new(camera, odometry),
            graph: PoseGraph::new(heights, height_m),
            places: PlaceIndex::new(&places_config),
            places_config,
            session: 0,
            first: 0,
            own_loops: true,
            hurried: false,
            map: GroundMap { camera: camera.clone(), rig, keyframes: Vec::new(), edges: Vec::new() },
            index: BTreeMap::new(),
            closures: Vec::new(),
            pending: Vec::new(),
            patience: Patience::default(),
            unsettled: 0,
            // A mean vector knows no heading, so nothing that it comes back to fits.
            config: SlamConfig {
                loops: config.loops && odometry.motion.model != MotionModel::Mean,
                ..config
            },
        }
    }

    /// A mapper that continues a map, whose keyframes' images are where those of the new ones will be. The new session's keyframes are numbered
    /// from `first`, and it is run number `session`; its poses are in the frame of the map as soon as it is recognised ([`Mapper::is_recognised`]).
    pub fn continuing(
        map: GroundMap,
        odometry: &OdometryConfig,
        config: SlamConfig,
        session: u32,
        first: KeyframeId,
    ) -> Self {
        let mut mapper = Self::new(&map.camera.clone(), map.rig, odometry, config);
        mapper.session = session;
        mapper.first = first.0;
        for (at, keyframe) in map.keyframes.iter().enumerate() {
            mapper.index.insert(keyframe.id, at);
            mapper.places.insert(keyframe.id, &keyframe.signature);
        }
        mapper.map = map;
        mapper.rebuild();
        mapper
    }

    /// From now on keyframes are taken without looking whether they show ground that was seen before, until there is time again: for who must
    /// keep up with a camera. What was not looked for is not made up for.
    pub fn hurry(&mut self, hurried: bool) {
        self.hurried = hurried;
    }

    /// Whether the session's keyframes are tied to the map that it continues; always where it continues none.
    pub fn is_recognised(&self) -> bool {
        let new = self.map.keyframes.iter().find(|keyframe| self.is_new(keyframe.id));
        match (self.map.keyframes.first(), new) {
            (Some(old), Some(new)) => old.id == new.id || self.graph.are_connected(old.id, new.id),
            _ => true,
        }
    }

    /// Whether a keyframe of the session is tied to the map that it continues. Nothing is where none is continued.
    pub fn is_tied_to_old(&self, keyframe: KeyframeId) -> bool {
        let Some(mut reach) = self.graph.reach(keyframe).filter(|_| self.is_new(keyframe)) else {
            return false;
        };
        let mut old = self.map.keyframes.iter().filter(|old| !self.is_new(old.id));
        old.any(|old| reach.to(old.id).is_some())
    }

    /// The run that is being mapped, from 0.
    pub fn session(&self) -> u32 {
        self.session
    }

    /// Takes what happened to a keyframe. Fails where an image cannot be kept or read.
    ///
    /// `color` is the picture of a new keyframe's frame, where the source has colour and that frame is at hand.
    pub fn take(
        &mut self,
        event: KeyframeEvent,
        color: Option<RgbImage>,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        match event {
            KeyframeEvent::Made(new) => {
                let ties: Vec<MapEdge> = new.tie.map(|tie| self.renumbered(tie)).into_iter().collect();
                self.made(*new, self.session, &ties, color, images)?;
            }
            KeyframeEvent::Revisited(edge) if self.looks_for_loops() => {
                let edge = self.renumbered(edge);
                self.add(edge, images)?;
            }
            KeyframeEvent::Revisited(_) => {}
        }
        self.settle_where_due();
        Ok(())
    }

    /// Takes a new keyframe of a session, with the edges to the keyframes of the map that are known to it.
    pub(super) fn made(
        &mut self,
        new: NewKeyframe,
        session: u32,
        ties: &[MapEdge],
        color: Option<RgbImage>,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        self.matcher.set_mask(new.mask.clone());
        let sought = self.matcher.sought(new.image.clone(), &new.pose);
        let signature = sought.signature(&self.map.camera, &self.places_config);
        let id = self.insert(&new, session, ties, signature);
        if let Some(keyframe) = self.keyframe(id) {
            images.keep(keyframe, KeyframeImage { gray: new.image, color }, ties)?;
        }
        if self.looks_for_loops() {
            self.close_loops(id, sought, images)?;
        }
        if let Some(keyframe) = self.index.get(&id).map(|&at| &self.map.keyframes[at])
            && self.own_loops
        {
            self.places.insert(id, &keyframe.signature);
        }
        Ok(())
    }

    fn looks_for_loops(&self) -> bool {
        self.config.loops && !self.hurried
    }

    /// Whether a keyframe is of the run that is being mapped.
    pub(super) fn is_new(&self, id: KeyframeId) -> bool {
        id.0 >= self.first
    }

    /// Ends the session: every pose is where all edges agree best, with its covariance.
    pub fn finish(&mut self) {
        self.graph.doubt_mount();
        if !self.is_straightened() {
            return;
        }
        self.graph.optimize(STEPS_AT_THE_END);
        self.take_over_poses();
        let covariances = self.graph.covariances();
        let found: BTreeMap<KeyframeId, _> = self.graph.poses().map(|(id, _)| id).zip(covariances).collect();
        for keyframe in &mut self.map.keyframes {
            let Some(covariance) = found.get(&keyframe.id) else { continue };
            let height_m = keyframe.pose.height_m;
            let tilt = keyframe.covariance.fixed_view::<2, 2>(ROLL, ROLL).into_owned();
            let height_variance = keyframe.covariance[(HEIGHT, HEIGHT)];
            let mut whole = Matrix6::zeros();
            let mut by_height = nalgebra::Matrix4::identity();
            by_height[(HEIGHT, HEIGHT)] = height_m;
            whole.fixed_view_mut::<4, 4>(0, 0).copy_from(&propagated(&by_height, &covariance));
            if whole[(HEIGHT, HEIGHT)] == 0.0 {
                whole[(HEIGHT, HEIGHT)] = height_variance; // held by the rig, or what odometry knows of it
            }
            whole.fixed_view_mut::<2, 2>(ROLL, ROLL).copy_from(&tilt);
            keyframe.covariance = whole;
        }
    }

    /// The map alone.
    pub fn into_map(self) -> GroundMap {
        self.map
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
        Some(self.of_run(keyframe)?.map_from_odometry().apply_to_pose(odometry))
    }

    /// A keyframe by its number in the run.
    pub(super) fn of_run(&self, id: KeyframeId) -> Option<&MapKeyframe> {
        self.keyframe(KeyframeId(self.first + id.0))
    }

    /// An edge between keyframes of the run, with their numbers in the map.
    pub(super) fn renumbered(&self, edge: MapEdge) -> MapEdge {
        let [from, to] = [edge.from, edge.to].map(|id| KeyframeId(self.first + id.0));
        MapEdge { from, to, ..edge }
    }

    /// The graph anew from the map.
    pub(super) fn rebuild(&mut self) {
        self.graph = PoseGraph::new(self.heights, self.map.rig.first_pose().height_m);
        for keyframe in &self.map.keyframes {
            self.graph.insert(keyframe.id, keyframe.pose, keyframe.odometry_pose.height_m);
        }
        for edge in &self.map.edges {
            self.graph.tie(edge);
        }
    }

    pub(super) fn keyframe(&self, id: KeyframeId) -> Option<&MapKeyframe> {
        self.index.get(&id).map(|&at| &self.map.keyframes[at])
    }

    /// Lays a new keyframe in the map, where the first that it is tied to has it.
    fn insert(
        &mut self,
        new: &NewKeyframe,
        session: u32,
        ties: &[MapEdge],
        signature: Signature,
    ) -> KeyframeId {
        let id = KeyframeId(self.first + new.id.0);
        let known = ties.first().map(|tie| if tie.from == id { tie.to } else { tie.from });
        let pose = match known.and_then(|known| self.keyframe(known)) {
            Some(known) if self.is_straightened() => known.map_from_odometry().apply_to_pose(&new.pose),
            _ => new.pose,
        };
        self.graph.insert(id, pose, new.pose.height_m);
        self.index.insert(id, self.map.keyframes.len());
        self.map.keyframes.push(MapKeyframe {
            id,
            session,
            segment: new.segment,
            frame: new.frame,
            time_s: new.time_s,
            odometry_pose: new.pose,
            pose,
            covariance: new.covariance,
            signature,
        });
        for tie in ties {
            self.graph.tie(tie);
            self.map.edges.push(*tie);
        }
        id
    }

    /// Whether the loops since the last optimisation are worth one: where they show the path to be bent, and otherwise in proportion to the map.
    fn is_due(&self) -> bool {
        let last = self.map.edges.iter().rev().filter(|edge| edge.kind == EdgeKind::Loop);
        let bent = last.take(1).any(|edge| self.graph.misfit(edge).is_some_and(|misfit| misfit > MISFIT));
        bent || 20 * self.unsettled > self.map.keyframes.len()
    }

    pub(super) fn settle_where_due(&mut self) {
        if self.unsettled > 0 && self.is_due() {
            self.relax();
        }
    }

    /// Brings the map about to where the loops since the last time want it, in a bounded time.
    pub(super) fn relax(&mut self) {
        let last = self.map.edges.iter().rev().filter(|edge| edge.kind == EdgeKind::Loop);
        let loops: Vec<MapEdge> = last.take(self.unsettled).copied().collect();
        self.graph.relax(&loops, STEPS_ON_THE_WAY);
        self.take_over_poses();
    }

    /// Takes the poses of the graph over into the map.
    fn take_over_poses(&mut self) {
        self.unsettled = 0;
        // Both have the keyframes in the order in which they came.
        for (keyframe, (id, pose)) in self.map.keyframes.iter_mut().zip(self.graph.poses()) {
            debug_assert_eq!(keyframe.id, id);
            keyframe.pose = pose;
        }
    }
}
