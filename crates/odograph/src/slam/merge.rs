//! Operations on finished maps: merging two that overlap, and optimising one.

use super::Mapper;
use super::mapper::ComparedKeyframes;
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::ground_map::{GroundMap, KeyframeImages, KeyframeStore, MapKeyframe, MountedCamera};
use crate::keyframe::{KeyframeId, MapEdge};
use crate::landmark::MarkerSighting;
use crate::loop_closure::LoopClosureConfig;
use crate::odometry::{NewKeyframe, OdometryConfig};
use std::collections::BTreeSet;

/// Result of merging a map into another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Merged {
    /// Number of keyframes added.
    pub keyframes: usize,
    /// Number of loop closures between the two maps.
    pub loops: usize,
    /// Number of edges between the two maps by markers that both have seen. Where this and `loops`
    /// are 0 their relative pose is unknown.
    pub markers: usize,
}

/// Merges `other` into the map that `mapper` continues ([`Mapper::continuing`]). Its keyframes are
/// inserted at the poses of its own edges and searched for in the map; as soon as two matches
/// agree, all of it moves to where they imply, and every further loop closure refines it. New
/// keyframes are numbered after the map's; session numbers are kept and should not be in use in the
/// map. This finishes the mapper.
///
/// `sightings` are the markers of `other`, with its numbers of keyframes. They are tied to those
/// that the mapper remembers ([`Mapper::remember_sightings`]), and are afterwards its own
/// ([`Mapper::own_sightings`]).
///
/// Fails if `other` has keyframes of a camera that the map has not, or an image cannot be loaded or
/// stored. After an error, and if no loop closure connects the two, what was stored in `images` is
/// useless and the caller must remove it.
pub fn merge(
    mapper: &mut Mapper,
    images: &mut dyn KeyframeStore,
    other: &GroundMap,
    other_images: &mut dyn KeyframeImages,
    sightings: &[MarkerSighting],
) -> Result<Merged> {
    let sessions: BTreeSet<u32> = other.keyframes.iter().map(|keyframe| keyframe.session).collect();
    let here = mapper.map();
    let is_here = |camera: &Camera| {
        *camera == here.camera || here.other_cameras.values().any(|other| other.camera == *camera)
    };
    if !sessions.iter().all(|session| is_here(other.camera_of(*session))) {
        return Err(Error::input("the two maps were made with different cameras and cannot be joined"));
    }
    for session in sessions {
        let (camera, rig) = (other.camera_of(session).clone(), *other.rig_of(session));
        mapper.begin_session(session, &MountedCamera { camera, rig });
    }
    mapper.compared = ComparedKeyframes::Earlier;
    let mut inserted = BTreeSet::new();
    for keyframe in &other.keyframes {
        inserted.insert(keyframe.id);
        let at_it = |edge: &&MapEdge| edge.from == keyframe.id || edge.to == keyframe.id;
        let edges = other.edges.iter().filter(at_it);
        let edges = edges.filter(|edge| inserted.contains(&edge.from) && inserted.contains(&edge.to));
        let edges: Vec<MapEdge> = edges.map(|edge| mapper.renumbered(*edge)).collect();
        let image = other_images.load(keyframe.id)?;
        let new = NewKeyframe {
            id: keyframe.id,
            frame: keyframe.frame,
            time_s: keyframe.time_s,
            segment: keyframe.segment,
            // All its sessions share one frame of reference: that of the other map.
            pose: keyframe.pose,
            covariance: keyframe.covariance,
            systematic: nalgebra::Matrix6::zeros(),
            tie: None,
            image: image.gray,
            mask: other.masks.get(&keyframe.session).cloned(),
            ground: None,
        };
        mapper.made(new, keyframe.session, &edges, image.color, images)?;
        // Its height is now that of the other map.
        let metres = keyframe.pose.height_m / keyframe.odometry_pose.height_m;
        let seen: Vec<MarkerSighting> = sightings
            .iter()
            .filter(|sighting| sighting.keyframe == keyframe.id)
            .map(|sighting| sighting.rescaled(metres))
            .collect();
        mapper.add_sightings(&seen, images)?;
        mapper.settle_where_due();
    }
    mapper.compared = ComparedKeyframes::All;
    mapper.finish();
    let (loops, markers) = (mapper.closures().len(), mapper.marker_edges());
    Ok(Merged { keyframes: other.keyframes.len(), loops, markers })
}

/// Optimises the poses of a map and computes their covariances.
pub fn optimize(map: &GroundMap, odometry: &OdometryConfig) -> GroundMap {
    let without_signatures = GroundMap {
        keyframes: map
            .keyframes
            .iter()
            // No places are looked up, so none must be indexed.
            .map(|keyframe| MapKeyframe { signature: Default::default(), ..keyframe.clone() })
            .collect(),
        ..map.clone()
    };
    let beyond = KeyframeId(map.keyframes.iter().map(|keyframe| keyframe.id.0 + 1).max().unwrap_or(0));
    let config = LoopClosureConfig::default();
    let mut mapper = Mapper::continuing(without_signatures, odometry, config, u32::MAX, beyond);
    mapper.finish();
    let mut straight = mapper.into_map();
    for (now, before) in straight.keyframes.iter_mut().zip(&map.keyframes) {
        now.signature = before.signature.clone();
    }
    straight
}
