//! Mapping of several robots at once: each keyframe with its edges and its camera as its robot has
//! them, compared with the keyframes of all other sessions.

use super::Mapper;
use super::mapper::ComparedKeyframes;
use super::session_scale::{PlaceScale, SessionScale};
use crate::error::Result;
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::geometry::{PlaneTransform, Se2, Sim2, propagated};
use crate::ground_map::{GroundMap, KeyframeStore, MountedCamera};
use crate::image::RgbImage;
use crate::keyframe::{EdgeKind, KeyframeId, MapEdge};
use crate::loop_closure::LoopClosureConfig;
use crate::odometry::{NewKeyframe, OdometryConfig};
use nalgebra::Matrix3;
use std::collections::{BTreeMap, BTreeSet};

/// Number of recognised places from which the scales of two robots are compared: more make the
/// median safer, fewer report a wrong height sooner.
const MIN_PLACES: usize = 5;
/// Number of recognised places kept for each session, the newest: bounds memory.
const MAX_PLACES: usize = 256;

/// Where the odometry frame of a session lies in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OdometryPlacement {
    /// The transform at the last keyframe of the session.
    pub map_from_odometry: Sim2,
    /// Covariance of the keyframe's x, y and heading in the map, relative to the map's first
    /// keyframe, metres and radians: along the path of least covariance, which is an upper bound.
    pub covariance: Matrix3<f64>,
    /// That keyframe.
    pub keyframe: KeyframeId,
}

/// Builds one map of the sessions of several robots. The result depends only on the order in which
/// keyframes are added.
#[derive(Debug)]
pub struct FleetMapper {
    mapper: Mapper,
    odometry: OdometryConfig,
    /// Scales at recognised places, by session.
    scales: BTreeMap<u32, Vec<PlaceScale>>,
}

impl FleetMapper {
    /// Continues a map, which may be empty. Images of its keyframes must be in the
    /// store that is given with new ones.
    pub fn new(map: GroundMap, odometry: &OdometryConfig) -> Self {
        let config = LoopClosureConfig::default();
        // Keyframes have the numbers of the map.
        let mut mapper = Mapper::continuing(map, odometry, config, u32::MAX, KeyframeId(0));
        mapper.compared = ComparedKeyframes::OtherSessions;
        Self { mapper, odometry: *odometry, scales: BTreeMap::new() }
    }

    /// Registers a session with its camera, before its first keyframe.
    pub fn begin_session(&mut self, session: u32, mounted: &MountedCamera) {
        self.mapper.begin_session(session, mounted);
    }

    /// Adds a keyframe of a session with its edges to earlier keyframes; all have the numbers of
    /// the map, and the keyframe's own edges to others of its session are among them. Fails if an
    /// image cannot be stored or loaded.
    pub fn add(
        &mut self,
        new: NewKeyframe,
        session: u32,
        edges: &[MapEdge],
        color: Option<RgbImage>,
        images: &mut dyn KeyframeStore,
    ) -> Result<()> {
        // The pose of a new keyframe follows from its first edge: that of odometry.
        let own = edges.iter().filter(|edge| edge.from == new.id || edge.to == new.id);
        let (own, others): (Vec<MapEdge>, Vec<MapEdge>) = {
            let mut own: Vec<MapEdge> = own.copied().collect();
            own.sort_by_key(|edge| edge.kind == EdgeKind::Loop);
            (own, edges.iter().filter(|edge| edge.from != new.id && edge.to != new.id).copied().collect())
        };
        self.mapper.made(new, session, &own, color, images)?;
        self.add_edges(&others, images)?;
        self.take_scales();
        self.mapper.settle_where_due();
        Ok(())
    }

    /// Adds edges between keyframes of the map, except those that it has. Fails if one cannot be
    /// stored.
    pub fn add_edges(&mut self, edges: &[MapEdge], images: &mut dyn KeyframeStore) -> Result<()> {
        for edge in edges {
            let known = self.mapper.map.edges.iter().rev().any(|known| known == edge);
            if !known {
                self.mapper.add(*edge, images)?;
            }
        }
        Ok(())
    }

    /// Optimises all poses and computes their covariances.
    pub fn finish(&mut self) {
        self.mapper.finish();
    }

    /// The current map.
    pub fn map(&self) -> &GroundMap {
        &self.mapper.map
    }

    /// The same without the keyframes of some sessions: the others stay where they are.
    pub fn without(self, sessions: &BTreeSet<u32>) -> Self {
        let mut map = self.mapper.into_map();
        let gone: BTreeSet<KeyframeId> = map
            .keyframes
            .iter()
            .filter(|keyframe| sessions.contains(&keyframe.session))
            .map(|keyframe| keyframe.id)
            .collect();
        map.keyframes.retain(|keyframe| !gone.contains(&keyframe.id));
        map.masks.retain(|session, _| !sessions.contains(session));
        map.edges.retain(|edge| !gone.contains(&edge.from) && !gone.contains(&edge.to));
        let mut scales = self.scales;
        scales.retain(|session, _| !sessions.contains(session));
        Self { scales, ..Self::new(map, &self.odometry) }
    }

    /// Whether a session is connected to the first keyframe of the map; false without keyframes.
    pub fn is_connected(&self, session: u32) -> bool {
        let keyframes = &self.mapper.map.keyframes;
        let last = keyframes.iter().rev().find(|keyframe| keyframe.session == session);
        let (Some(first), Some(last)) = (keyframes.first(), last) else { return false };
        first.id == last.id || self.mapper.graph.are_connected(first.id, last.id)
    }

    /// Where the odometry frame of a session lies at its last keyframe; `None` as long as it is not
    /// connected to the first keyframe of the map.
    pub fn placement(&self, session: u32) -> Option<OdometryPlacement> {
        let keyframes = &self.mapper.map.keyframes;
        let last = keyframes.iter().rev().find(|keyframe| keyframe.session == session)?;
        let first = keyframes.first()?;
        let covariance = if first.id == last.id {
            Matrix3::zeros()
        } else {
            let reached = self.mapper.graph.reach(first.id)?.to(last.id)?;
            let seen = reached.covariance.fixed_view::<3, 3>(X, X).into_owned();
            propagated(&Se2::rotation(first.pose.heading_rad).product_by_right(), &seen)
        };
        let map_from_odometry = last.map_from_odometry();
        let finite = covariance.iter().all(|value| value.is_finite())
            && [X, Y, HEADING].iter().all(|&k| covariance[(k, k)] >= 0.0);
        finite.then_some(OdometryPlacement { map_from_odometry, covariance, keyframe: last.id })
    }

    /// Scale of a session relative to earlier ones; `None` if it has recognised too few of their
    /// places.
    pub fn scale(&self, session: u32) -> Option<SessionScale> {
        SessionScale::of(self.scales.get(&session)?).filter(|scale| scale.places >= MIN_PLACES)
    }

    /// Attributes ratios of scales to the later of two sessions: the map is taken to be right.
    fn take_scales(&mut self) {
        for (new, old, scale) in std::mem::take(&mut self.mapper.scales) {
            let session = |id| self.mapper.keyframe(id).map(|keyframe| keyframe.session);
            let (Some(new), Some(old)) = (session(new), session(old)) else { continue };
            let of_later = if new > old { scale } else { scale.inverse() };
            let known = self.scales.entry(new.max(old)).or_default();
            known.push(of_later);
            if known.len() > MAX_PLACES {
                known.remove(0);
            }
        }
    }
}
