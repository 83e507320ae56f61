//! Maps that exist already: two that overlap joined, and one optimised anew.

use super::images::KeyframeStore;
use super::{Mapper, SlamConfig};
use crate::error::{Error, Result};
use crate::mapping::{GroundMap, KeyframeId, KeyframeImages, MapEdge, MapKeyframe};
use crate::odometry::{NewKeyframe, OdometryConfig};
use std::collections::BTreeSet;

/// What became of a map that was joined to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Merged {
    /// How many keyframes were added.
    pub keyframes: usize,
    /// How many loops tie the two. With none it is not known where one lies to the other.
    pub ties: usize,
}

/// Joins `other` to the map that `mapper` continues ([`Mapper::continuing`]). Its keyframes are laid as its own edges have them, and looked for in
/// the map; as soon as two sightings agree, all of it moves to where they put it, and every further one pulls it straight. Numbers of the new keyframes go
/// on from the map's; their sessions' numbers are kept and should be ones that the map has not. The mapper is finished thereafter.
///
/// Fails where the cameras differ, and where an image cannot be read or kept. Where it fails, and where no loop ties the two, what was kept in `images` is of no
/// use, and whoever called takes it away.
pub fn merge(
    mapper: &mut Mapper,
    images: &mut dyn KeyframeStore,
    other: &GroundMap,
    other_images: &mut dyn KeyframeImages,
) -> Result<Merged> {
    if other.camera != mapper.map().camera {
        return Err(Error::input("the two maps were made with different cameras and cannot be joined"));
    }
    mapper.own_loops = false;
    let mut laid = BTreeSet::new();
    for keyframe in &other.keyframes {
        laid.insert(keyframe.id);
        let at_it = |edge: &&MapEdge| edge.from == keyframe.id || edge.to == keyframe.id;
        let ties = other.edges.iter().filter(at_it);
        let ties = ties.filter(|edge| laid.contains(&edge.from) && laid.contains(&edge.to));
        let ties: Vec<MapEdge> = ties.map(|edge| mapper.renumbered(*edge)).collect();
        let image = other_images.load(keyframe.id)?;
        let new = NewKeyframe {
            id: keyframe.id,
            frame: keyframe.frame,
            time_s: keyframe.time_s,
            segment: keyframe.segment,
            // One frame of reference for all of its sessions: that of the other map.
            pose: keyframe.pose,
            covariance: keyframe.covariance,
            tie: None,
            image: image.gray,
            mask: None,
        };
        mapper.made(new, keyframe.session, &ties, image.color, images)?;
        mapper.settle_where_due();
    }
    mapper.own_loops = true;
    mapper.finish();
    Ok(Merged { keyframes: other.keyframes.len(), ties: mapper.closures().len() })
}

/// Puts the keyframes of a map where all of its edges agree best, with their covariances.
pub fn optimize(map: &GroundMap, odometry: &OdometryConfig) -> GroundMap {
    let without_signatures = GroundMap {
        keyframes: map
            .keyframes
            .iter()
            // Nothing is looked up, so nothing has to be found.
            .map(|keyframe| MapKeyframe { signature: Default::default(), ..keyframe.clone() })
            .collect(),
        ..map.clone()
    };
    let beyond = KeyframeId(map.keyframes.iter().map(|keyframe| keyframe.id.0 + 1).max().unwrap_or(0));
    let config = SlamConfig::default();
    let mut mapper = Mapper::continuing(without_signatures, odometry, config, u32::MAX, beyond);
    mapper.finish();
    let mut straight = mapper.into_map();
    for (now, before) in straight.keyframes.iter_mut().zip(&map.keyframes) {
        now.signature = before.signature.clone();
    }
    straight
}
