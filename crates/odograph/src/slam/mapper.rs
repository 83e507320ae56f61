//! The mapper inserts keyframes into the map, closes loops and optimises the pose graph.

use super::backoff::Backoff;
use super::session_scale::{PlaceScale, SessionScale};
use crate::camera::{Camera, Rig};
use crate::error::Result;
use crate::fixed_pattern::ImageMask;
use crate::geometry::pose_index::{HEIGHT, ROLL};
use crate::geometry::{PlaneTransform, Se2, propagated};
use crate::ground_map::{GroundMap, KeyframeImage, KeyframeStore, MapKeyframe, MountedCamera};
use crate::image::RgbImage;
use crate::keyframe::{EdgeKind, GroundInView, KeyframeId, MapEdge};
use crate::landmark::MarkerRecord;
use crate::loop_closure::matching::{CameraIndex, CameraPose, Matcher};
use crate::loop_closure::{LoopClosure, LoopClosureConfig};
use crate::motion::MotionModel;
use crate::odometry::{KeyframeEvent, NewKeyframe, OdometryConfig};
use crate::place_recognition::{PlaceIndex, PlacesConfig, Signature};
use crate::pose_graph::{Heights, PoseGraph};
use nalgebra::Matrix6;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Builds the map of keyframes. The result depends only on the input.
#[derive(Debug)]
pub struct Mapper {
    pub(super) config: LoopClosureConfig,
    heights: Heights,
    pub(super) matcher: Matcher,
    pub(super) graph: PoseGraph,
    pub(super) places: PlaceIndex,
    pub(super) places_config: PlacesConfig,
    pub(super) map: GroundMap,
    /// Index of each keyframe in the map.
    index: BTreeMap<KeyframeId, usize>,
    pub(super) closures: Vec<LoopClosure>,
    /// Matches that wait for a second one to confirm them.
    pub(super) pending: Vec<LoopClosure>,
    /// Scales where sessions recognised the same ground: new keyframe, older keyframe, and the
    /// metres of the older over those of the new one.
    pub(super) scales: Vec<(KeyframeId, KeyframeId, PlaceScale)>,
    /// For registrations of whole images.
    pub(super) backoff: Backoff,
    /// Loop closures since the last optimisation.
    pub(super) unsettled: usize,
    /// The session being mapped, and the number of its first keyframe.
    session: u32,
    first: u64,
    /// Which keyframes a new one is compared with.
    pub(super) compared: ComparedKeyframes,
    /// The cameras of the sessions, where they are not the first.
    pub(super) cameras: BTreeMap<u32, CameraIndex>,
    /// Covariances of keyframes of this run by systematic errors, which loops do not show.
    systematic: BTreeMap<KeyframeId, Matrix6<f64>>,
    /// The ground that keyframes of this run see, where it is not the plane z = 0.
    grounds: BTreeMap<KeyframeId, GroundInView>,
    /// Whether loop closure is suspended to keep up with the camera.
    is_suspended: bool,
    /// The markers that the session has seen.
    pub(super) landmarks: MarkerRecord,
    /// Whether the map is in the survey frame of its control points.
    pub(super) is_surveyed: bool,
}

/// Which keyframes a new one is compared with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ComparedKeyframes {
    /// All older ones.
    All,
    /// Those of earlier sessions: while another map is merged, whose edges are known.
    Earlier,
    /// Those of other sessions: of each session the edges are known.
    OtherSessions,
}

/// Maximum number of steps of an optimisation while mapping; the next one continues it. More
/// converge sooner and hold up the keyframes behind.
const STEPS_ON_THE_WAY: usize = 2;

/// Maximum number of steps of the final optimisation: bounds the time where it does not converge.
pub(super) const STEPS_AT_THE_END: usize = 60;

/// A loop closure with a squared residual above this (three standard deviations) triggers an
/// optimisation at once; smaller ones wait for the next.
const MISFIT: f64 = 9.0;

impl Mapper {
    /// A mapper with an empty map.
    pub fn new(camera: &Camera, rig: Rig, odometry: &OdometryConfig, config: LoopClosureConfig) -> Self {
        let heights = if odometry.motion.model.scale_is_free() { Heights::Free } else { Heights::Held };
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
            compared: ComparedKeyframes::All,
            cameras: BTreeMap::new(),
            systematic: BTreeMap::new(),
            grounds: BTreeMap::new(),
            is_suspended: false,
            landmarks: MarkerRecord::default(),
            is_surveyed: false,
            map: GroundMap {
                camera: camera.clone(),
                rig,
                other_cameras: BTreeMap::new(),
                masks: BTreeMap::new(),
                keyframes: Vec::new(),
                edges: Vec::new(),
            },
            index: BTreeMap::new(),
            closures: Vec::new(),
            pending: Vec::new(),
            scales: Vec::new(),
            backoff: Backoff::default(),
            unsettled: 0,
            // A mean flow vector has no heading, so its loops cannot close.
            config: LoopClosureConfig {
                loops: config.loops && odometry.motion.model != MotionModel::Mean,
                ..config
            },
        }
    }

    /// A mapper that continues a map. The images of the old keyframes must be where the new ones
    /// will be stored. The new session has the number `session`, its keyframes are numbered from
    /// `first`, and its poses are in the frame of the map as soon as it is recognised
    /// ([`Mapper::is_recognised`]).
    pub fn continuing(
        map: GroundMap,
        odometry: &OdometryConfig,
        config: LoopClosureConfig,
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
        for (&session, other) in &map.other_cameras {
            let camera = mapper.matcher.index_of(&other.camera);
            mapper.cameras.insert(session, camera);
        }
        mapper.map = map;
        mapper.rebuild();
        mapper
    }

    /// Suspends (`true`) or resumes (`false`) the search for loop closures, to keep up with a live
    /// camera. Keyframes inserted meanwhile are not searched later.
    pub fn suspend_loop_search(&mut self, is_suspended: bool) {
        self.is_suspended = is_suspended;
    }

    /// Whether the session is connected to the map that it continues; true if it continues none.
    pub fn is_recognised(&self) -> bool {
        let new = self.map.keyframes.iter().find(|keyframe| self.is_new(keyframe.id));
        match (self.map.keyframes.first(), new) {
            (Some(old), Some(new)) => old.id == new.id || self.graph.are_connected(old.id, new.id),
            _ => true,
        }
    }

    /// Whether a keyframe of the session is connected to the map that it continues; false if it
    /// continues none.
    pub fn is_tied_to_old(&self, keyframe: KeyframeId) -> bool {
        let Some(mut reach) = self.graph.reach(keyframe).filter(|_| self.is_new(keyframe)) else {
            return false;
        };
        let mut old = self.map.keyframes.iter().filter(|old| !self.is_new(old.id));
        old.any(|old| reach.to(old.id).is_some())
    }

    /// Number of the session being mapped, from 0.
    pub fn session(&self) -> u32 {
        self.session
    }

    /// Processes a keyframe event. Fails if an image cannot be stored or loaded.
    ///
    /// `color` is the colour image of a new keyframe's frame, if available.
    pub fn take(
        &mut self,
        event: KeyframeEvent,
        color: Option<RgbImage>,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        match event {
            KeyframeEvent::Made(new) => {
                let edges: Vec<MapEdge> = new.tie.map(|tie| self.renumbered(tie)).into_iter().collect();
                self.made(*new, self.session, &edges, color, images)?;
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

    /// Registers a session with its camera, before its first keyframe.
    pub(super) fn begin_session(&mut self, session: u32, mounted: &MountedCamera) {
        if mounted.camera != self.map.camera || mounted.rig != self.map.rig {
            self.map.other_cameras.insert(session, mounted.clone());
        }
        let camera = self.matcher.index_of(&mounted.camera);
        self.cameras.insert(session, camera);
    }

    /// Inserts a new keyframe of a session, with its known edges to keyframes of the map.
    pub(super) fn made(
        &mut self,
        new: NewKeyframe,
        session: u32,
        edges: &[MapEdge],
        color: Option<RgbImage>,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        self.set_mask(session, new.mask.clone());
        let camera = self.cameras.get(&session).copied().unwrap_or_default();
        let at = CameraPose { camera, pose: new.pose, ground: new.ground };
        let query = self.matcher.query(new.image.clone(), &at, new.mask.as_ref());
        let signature = self.matcher.signature(&query, &self.places_config);
        let id = self.insert(&new, session, edges, signature);
        if let Some(keyframe) = self.keyframe(id) {
            images.keep(keyframe, KeyframeImage { gray: new.image, color }, edges)?;
        }
        if self.looks_for_loops() {
            self.close_loops(id, query, images)?;
        }
        if let Some(keyframe) = self.index.get(&id).map(|&at| &self.map.keyframes[at])
            && self.compared != ComparedKeyframes::Earlier
        {
            self.places.insert(id, &keyframe.signature);
        }
        Ok(())
    }

    /// Sets what of a session's images is not ground: of those that it has and of those to come.
    fn set_mask(&mut self, session: u32, mask: Option<Arc<ImageMask>>) {
        match mask {
            Some(mask) => self.map.masks.insert(session, mask),
            None => self.map.masks.remove(&session),
        };
    }

    /// Number of the session's first keyframe.
    pub(super) fn first_keyframe(&self) -> KeyframeId {
        KeyframeId(self.first)
    }

    pub(super) fn heights(&self) -> Heights {
        self.heights
    }

    fn looks_for_loops(&self) -> bool {
        self.config.loops && !self.is_suspended
    }

    /// Whether a keyframe belongs to the session being mapped.
    pub(super) fn is_new(&self, id: KeyframeId) -> bool {
        id.0 >= self.first
    }

    /// Ends the session: optimises all poses and computes their covariances.
    pub fn finish(&mut self) {
        self.graph.reset_mount();
        if !self.is_corrected() {
            return;
        }
        self.graph.optimize(STEPS_AT_THE_END);
        self.take_over_graph();
    }

    /// Copies poses and covariances of the optimised graph into the map.
    pub(super) fn take_over_graph(&mut self) {
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
            whole.fixed_view_mut::<4, 4>(0, 0).copy_from(&propagated(&by_height, covariance));
            if whole[(HEIGHT, HEIGHT)] == 0.0 {
                whole[(HEIGHT, HEIGHT)] = height_variance; // of the rig, or of odometry
            }
            whole.fixed_view_mut::<2, 2>(ROLL, ROLL).copy_from(&tilt);
            // Surveyed points show systematic errors.
            if let Some(systematic) = self.systematic.get(&keyframe.id).filter(|_| !self.is_surveyed) {
                let turn = Se2::rotation(keyframe.pose.heading_rad - keyframe.odometry_pose.heading_rad);
                let systematic = systematic.fixed_view::<3, 3>(0, 0).into_owned();
                let mut plane = whole.fixed_view_mut::<3, 3>(0, 0);
                plane += propagated(&turn.product_by_right(), &systematic);
            }
            keyframe.covariance = whole;
        }
    }

    /// The map without the mapper.
    pub fn into_map(self) -> GroundMap {
        self.map
    }

    /// The current map.
    pub fn map(&self) -> &GroundMap {
        &self.map
    }

    /// The accepted loop closures in order, without those that odometry found by itself.
    pub fn closures(&self) -> &[LoopClosure] {
        &self.closures
    }

    /// Whether there are loop closures or the map was surveyed: without them the map frame is the
    /// odometry frame.
    pub fn is_corrected(&self) -> bool {
        self.is_surveyed || self.map.edges.iter().any(|edge| edge.kind == EdgeKind::Loop)
    }

    /// The mount's rotation per metre forward and per metre to the left as estimated from the loop
    /// closures, radians.
    pub fn turn_per_m(&self) -> (f64, f64) {
        self.graph.turn_per_m()
    }

    /// Scale of the session relative to the earlier ones of the map that it continues; `None` if
    /// no place that it has recognised shows one.
    pub fn scale_in_map(&self) -> Option<SessionScale> {
        let places: Vec<PlaceScale> = self.scales.iter().map(|(.., scale)| *scale).collect();
        SessionScale::of(&places)
    }

    /// The number in the map of a keyframe by that in the session.
    pub(super) fn number_in_map(&self, id: KeyframeId) -> KeyframeId {
        KeyframeId(self.first + id.0)
    }

    /// A keyframe by its number in the session.
    pub(super) fn of_run(&self, id: KeyframeId) -> Option<&MapKeyframe> {
        self.keyframe(self.number_in_map(id))
    }

    pub(super) fn of_run_mut(&mut self, id: KeyframeId) -> Option<&mut MapKeyframe> {
        let at = self.index.get(&self.number_in_map(id))?;
        self.map.keyframes.get_mut(*at)
    }

    /// An edge between keyframes of the session, with their numbers in the map.
    pub(super) fn renumbered(&self, edge: MapEdge) -> MapEdge {
        let [from, to] = [edge.from, edge.to].map(|id| self.number_in_map(id));
        MapEdge { from, to, ..edge }
    }

    /// Rebuilds the graph from the map.
    pub(super) fn rebuild(&mut self) {
        self.graph = PoseGraph::new(self.heights, self.map.rig.first_pose().height_m);
        for keyframe in &self.map.keyframes {
            self.graph.insert(keyframe.id, keyframe.pose, keyframe.odometry_pose.height_m);
        }
        for edge in &self.map.edges {
            self.graph.add_edge(edge);
        }
    }

    /// Whether a new keyframe may be compared with an older one.
    pub(super) fn compares(&self, new: KeyframeId, old: KeyframeId) -> bool {
        match self.compared {
            ComparedKeyframes::All => true,
            ComparedKeyframes::Earlier => !self.is_new(old),
            ComparedKeyframes::OtherSessions => {
                let session = |id| self.keyframe(id).map(|keyframe| keyframe.session);
                session(new) != session(old)
            }
        }
    }

    /// Camera, height, roll and pitch with which a keyframe was taken.
    pub(super) fn seen_from(&self, id: KeyframeId) -> Option<CameraPose> {
        let MapKeyframe { session, odometry_pose: pose, .. } = *self.keyframe(id)?;
        let camera = self.cameras.get(&session).copied().unwrap_or_default();
        Some(CameraPose { camera, pose, ground: self.grounds.get(&id).copied() })
    }

    pub(super) fn keyframe(&self, id: KeyframeId) -> Option<&MapKeyframe> {
        self.index.get(&id).map(|&at| &self.map.keyframes[at])
    }

    /// Inserts a new keyframe at the pose that its first edge implies.
    fn insert(
        &mut self,
        new: &NewKeyframe,
        session: u32,
        edges: &[MapEdge],
        signature: Signature,
    ) -> KeyframeId {
        let id = self.number_in_map(new.id);
        let known = edges.first().map(|edge| if edge.from == id { edge.to } else { edge.from });
        let pose = match known.and_then(|known| self.keyframe(known)) {
            Some(known) if self.is_corrected() => known.map_from_odometry().apply_to_pose(&new.pose),
            _ => new.pose,
        };
        self.graph.insert(id, pose, new.pose.height_m);
        self.index.insert(id, self.map.keyframes.len());
        // The many keyframes of a fleet have neither.
        if new.systematic != Matrix6::zeros() {
            self.systematic.insert(id, new.systematic);
        }
        if let Some(ground) = new.ground {
            self.grounds.insert(id, ground);
        }
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
        for edge in edges {
            self.graph.add_edge(edge);
            self.map.edges.push(*edge);
        }
        id
    }

    /// Whether to optimise now: a loop closure shows the path to be wrong, or there are many new
    /// ones for the size of the map.
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

    /// Approximately optimises the map after new loop closures, in bounded time.
    pub(super) fn relax(&mut self) {
        let last = self.map.edges.iter().rev().filter(|edge| edge.kind == EdgeKind::Loop);
        let loops: Vec<MapEdge> = last.take(self.unsettled).copied().collect();
        self.graph.relax(&loops, STEPS_ON_THE_WAY);
        self.take_over_poses();
    }

    /// Copies the poses of the graph into the map.
    fn take_over_poses(&mut self) {
        self.unsettled = 0;
        // Both have the keyframes in order of insertion.
        for (keyframe, (id, pose)) in self.map.keyframes.iter_mut().zip(self.graph.poses()) {
            debug_assert_eq!(keyframe.id, id);
            keyframe.pose = pose;
        }
    }
}
