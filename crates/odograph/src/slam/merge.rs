//! Maps that exist already: two that overlap joined, and one optimised anew.

use super::images::KeyframeStore;
use super::{Mapper, SlamConfig};
use crate::error::{Error, Result};
use crate::mapping::{EdgeKind, GroundMap, KeyframeId, KeyframeImages};
use crate::odometry::{KeyframeEvent, NewKeyframe, OdometryConfig};

/// What became of a map that was joined to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Merged {
    /// How many keyframes were added.
    pub keyframes: usize,
    /// How many loops tie the two.
    pub ties: usize,
}

/// Joins `other` to the map that `mapper` continues ([`Mapper::continuing`]), as one session of it: its keyframes are laid, recognised and tied as if they had
/// just been made. The mapper is finished thereafter.
///
/// Fails where the cameras differ, where an image cannot be read or kept, and where no ground is recognised in both: then what was kept in
/// `images` is of no use, and whoever called takes it away.
pub fn merge(
    mapper: &mut Mapper,
    images: &mut dyn KeyframeStore,
    other: &GroundMap,
    other_images: &mut dyn KeyframeImages,
) -> Result<Merged> {
    if other.camera != mapper.map().camera {
        return Err(Error::input("the two maps were made with different cameras and cannot be joined"));
    }
    for (at, keyframe) in other.keyframes.iter().enumerate() {
        let tie = other.edges.iter().find(|edge| edge.to == keyframe.id && edge.kind != EdgeKind::Loop);
        // Ways between the other map's sessions are its loops.
        let tie = tie.or_else(|| {
            let known = |id: KeyframeId| other.keyframes[..at].iter().any(|before| before.id == id);
            other.edges.iter().find(|edge| edge.to == keyframe.id && known(edge.from))
        });
        let image = other_images.load(keyframe.id)?;
        let new = NewKeyframe {
            id: keyframe.id,
            frame: keyframe.frame,
            time_s: keyframe.time_s,
            segment: keyframe.segment,
            // One frame of reference for all of its sessions: that of the other map.
            pose: keyframe.pose,
            covariance: keyframe.covariance,
            tie: tie.copied(),
            image: image.gray,
        };
        mapper.take(KeyframeEvent::Made(Box::new(new)), image.color, images)?;
    }
    let told = |edge: &&crate::mapping::MapEdge| edge.kind == EdgeKind::Loop;
    for edge in other.edges.iter().filter(told) {
        mapper.take(KeyframeEvent::Revisited(*edge), None, images)?;
    }
    if !mapper.is_recognised() {
        return Err(Error::input("no ground was recognised in both maps; they cannot be joined"));
    }
    mapper.finish();
    let session = mapper.session();
    let of_other = |id: KeyframeId| mapper.map().keyframes.iter().any(|k| k.id == id && k.session == session);
    let ties = mapper
        .closures()
        .iter()
        .filter(|closure| of_other(closure.edge.from) != of_other(closure.edge.to))
        .count();
    Ok(Merged { keyframes: other.keyframes.len(), ties })
}

/// Puts the keyframes of a map where all of its edges agree best, with their covariances.
pub fn optimize(map: &GroundMap, odometry: &OdometryConfig) -> GroundMap {
    let mut mapper =
        Mapper::continuing(map.clone(), odometry, SlamConfig::default(), u32::MAX, KeyframeId(u64::MAX / 2));
    mapper.finish();
    mapper.into_map()
}
