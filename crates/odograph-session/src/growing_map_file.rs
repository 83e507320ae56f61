//! The map file of a run, which is created with its first keyframe.

use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::fixed_pattern::ImageMask;
use odograph::ground_map::{
    KeyframeImage, KeyframeImages, KeyframeStore, MapKeyframe, MemoryImages, MountedCamera,
};
use odograph::keyframe::{KeyframeId, MapEdge};
use odograph::landmark::PlacedSighting;
use odograph_calibration::MarkerFamily;
use odograph_map::{MapClaim, MapFile, SessionOrigin};
use std::path::PathBuf;
use std::sync::Arc;

/// A map file that is created with its first keyframe: a run without one leaves no file.
pub struct GrowingMapFile {
    pub file: Option<MapFile>,
    /// Whether a map of an earlier run may be replaced; permission was checked with the folder.
    pub replaces: bool,
    /// `None` where the file is not to be written.
    pub claim: Option<MapClaim>,
    pub path: PathBuf,
    pub camera: Camera,
    pub rig: Rig,
    pub source: String,
    /// Origin of the session, where the robot has a name.
    pub origin: Option<SessionOrigin>,
    pub session: u32,
    /// The mask of the session in the file.
    pub mask: Option<Arc<ImageMask>>,
    /// The new keyframes, where the file is not to be written.
    pub kept: Option<MemoryImages>,
}

impl GrowingMapFile {
    fn open(&mut self) -> Result<&mut MapFile> {
        if let (None, Some(claim)) = (&self.file, &self.claim) {
            if self.replaces {
                claim.remove_map()?;
            }
            let mut file = MapFile::create_claimed(claim.clone(), &self.camera, &self.rig)?;
            self.session = self.begin_session(&mut file)?;
            self.file = Some(file);
        }
        match &mut self.file {
            Some(file) => Ok(file),
            None => Err(Error::output("the map file is not open")),
        }
    }

    /// The camera of the run and its mount.
    pub fn mounted(&self) -> MountedCamera {
        MountedCamera { camera: self.camera.clone(), rig: self.rig }
    }

    pub fn begin_session(&self, file: &mut MapFile) -> Result<u32> {
        let mounted = self.mounted();
        match &self.origin {
            // What a robot sends from here is with its own mount.
            Some(origin) => file.begin_session_by(origin, &self.source, Some(&mounted)),
            None if mounted.camera != *file.camera() => file.begin_session_with(&self.source, &mounted),
            None => file.begin_session(&self.source),
        }
    }

    /// Adds sightings of markers by keyframes that are in the file.
    pub fn add_markers(&mut self, family: &MarkerFamily, sightings: &[PlacedSighting]) -> Result<()> {
        match &self.kept {
            Some(_) => Ok(()),
            None => self.open()?.add_markers(&family.name(), family.side_m(), sightings),
        }
    }

    /// Replaces the sightings of the session where they are others than in the file.
    pub fn set_markers(&mut self, family: &MarkerFamily, sightings: &[PlacedSighting]) -> Result<()> {
        let session = self.session;
        let Some(file) = self.file.as_mut().filter(|_| self.kept.is_none()) else { return Ok(()) };
        let there: Vec<PlacedSighting> = file
            .markers()?
            .into_iter()
            .filter(|marker| marker.session == session)
            .map(|marker| marker.placed)
            .collect();
        if there == sightings {
            return Ok(());
        }
        file.set_markers(session, &family.name(), family.side_m(), sightings)
    }

    /// Sets what of the session's images is not ground, where the file has it otherwise.
    pub fn set_mask(&mut self, mask: Option<&Arc<ImageMask>>) -> Result<()> {
        let session = self.session;
        let Some(file) = self.file.as_mut().filter(|_| self.kept.is_none() && self.mask.as_ref() != mask)
        else {
            return Ok(());
        };
        file.set_mask(session, mask.map(Arc::as_ref))?;
        self.mask = mask.cloned();
        Ok(())
    }

    pub fn set_poses(&mut self, keyframes: &[MapKeyframe]) -> Result<()> {
        let Some(file) = self.file.as_mut().filter(|_| self.kept.is_none()) else { return Ok(()) };
        let poses: Vec<_> =
            keyframes.iter().map(|keyframe| (keyframe.id, keyframe.pose, keyframe.covariance)).collect();
        file.set_poses(&poses)
    }
}

impl KeyframeImages for GrowingMapFile {
    fn load(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        if let Some(image) = self.kept.as_mut().and_then(|kept| kept.load(keyframe).ok()) {
            return Ok(image);
        }
        self.open()?.load(keyframe)
    }
}

impl KeyframeStore for GrowingMapFile {
    fn keep(&mut self, keyframe: &MapKeyframe, image: KeyframeImage, ties: &[MapEdge]) -> Result<()> {
        match &mut self.kept {
            Some(kept) => kept.keep(keyframe, image, ties),
            None => self.open()?.add_keyframe(keyframe, &image, ties),
        }
    }

    fn add_edge(&mut self, edge: &MapEdge) -> Result<()> {
        match &mut self.kept {
            Some(_) => Ok(()),
            None => self.open()?.add_edges(std::slice::from_ref(edge)),
        }
    }
}
