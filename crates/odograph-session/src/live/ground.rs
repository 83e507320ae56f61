//! The mosaic of a live run, shown while it grows.

use super::mosaic_rendering::{MosaicRendering, MosaicRenderingSummary};
use crate::views::Posed;
use odograph::camera::Camera;
use odograph::error::Result;
use odograph::fixed_pattern::ImageMask;
use odograph::geometry::{GroundPose, Sim2};
use odograph::ground_map::{KeyframeImages, MapKeyframe};
use odograph::keyframe::KeyframeId;
use odograph::mosaic::{Mosaic, MosaicSquare};
use odograph_live::ground::GroundState;
use odograph_live::{GroundPicture, TiledGround};
use odograph_map::MapFile;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The mosaic of a live run: rendered by one thread, read by those of the page, and rendered again
/// by a third.
#[derive(Clone)]
pub struct LiveGround {
    camera: Camera,
    shown: bool,
    state: Arc<Mutex<LiveGroundState>>,
}

struct LiveGroundState {
    mosaic: Stage,
    /// Number of complete renderings; the revisions of each are larger than all before.
    generation: u64,
    /// Tiles of the previous rendering that are now empty.
    bare: BTreeSet<MosaicSquare>,
}

enum Stage {
    Growing(Box<MosaicRendering>),
    /// Neither, temporarily.
    Away,
    Finished(Box<Mosaic>),
    /// As it was written.
    Written(Box<GroundPicture>),
}

/// A mosaic to be rendered again.
pub struct MosaicUpdate {
    /// The file with the keyframes' images.
    pub file: PathBuf,
    pub session: u32,
    /// The session's keyframes, in their order. Later ones and subsequent frames are corrected as
    /// the last of them.
    pub keyframes: Vec<PlacedKeyframe>,
}

/// Where a keyframe is after a loop closure.
#[derive(Clone, Copy)]
pub struct PlacedKeyframe {
    pub id: KeyframeId,
    /// Number of its frame in the source.
    pub frame: u64,
    /// In the map frame.
    pub pose: GroundPose,
    /// Correction of the frames after it, to the next keyframe.
    pub correction: Sim2,
}

impl From<&MapKeyframe> for PlacedKeyframe {
    fn from(keyframe: &MapKeyframe) -> Self {
        Self {
            id: keyframe.id,
            frame: keyframe.frame,
            pose: keyframe.pose,
            correction: keyframe.map_from_odometry(),
        }
    }
}

/// Largest number of times that keyframes are looked for which came during the rendering before.
const ROUNDS: usize = 4;

/// Revisions reserved for one rendering: more than a run has frames.
const REVISIONS: u64 = 1 << 40;

impl LiveGroundState {
    fn mosaic(&self) -> Option<&Mosaic> {
        match &self.mosaic {
            Stage::Growing(rendering) => Some(rendering.mosaic()),
            Stage::Away | Stage::Written(_) => None,
            Stage::Finished(mosaic) => Some(mosaic),
        }
    }
}

impl LiveGround {
    /// For a run with this output folder. If nobody looks (`shown` is false) nothing is rendered
    /// before the end.
    pub fn new(camera: Camera, folder: &Path, shown: bool) -> Self {
        let rendering = MosaicRendering::new(camera.clone(), folder, shown);
        let state = LiveGroundState {
            mosaic: Stage::Growing(Box::new(rendering)),
            generation: 0,
            bare: BTreeSet::new(),
        };
        Self { camera, shown, state: Arc::new(Mutex::new(state)) }
    }

    fn state(&self) -> MutexGuard<'_, LiveGroundState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether there may be viewers.
    pub fn is_shown(&self) -> bool {
        self.shown
    }

    /// Renders a frame where it shows new ground, outside the mask.
    pub fn render(&self, posed: Posed, mask: Option<Arc<ImageMask>>) {
        if let Stage::Growing(rendering) = &mut self.state().mosaic {
            rendering.next(posed, mask);
        }
    }

    /// Renders everything again at the corrected poses: the keyframes in the map file, and the
    /// frames that show what no keyframe does. Subsequent frames are corrected as the newest
    /// keyframe. Until then the old mosaic is shown.
    pub fn render_again(&self, update: &MosaicUpdate) -> Result<()> {
        let Some(newest) = update.keyframes.last() else { return Ok(()) };
        let mut file = MapFile::open_read_only(&update.file)?;
        let mut fresh = Mosaic::new(Default::default());
        if let Stage::Growing(rendering) = &self.state().mosaic {
            fresh.set_mask(rendering.mosaic().mask().cloned());
        }
        let mut rendered = BTreeSet::new();
        for _ in 0..ROUNDS {
            let mut views = self.views(&file, update)?;
            views.retain(|view| rendered.insert(view.0));
            if views.is_empty() {
                break;
            }
            for (frame, keyframe, pose) in views {
                let image = match keyframe {
                    Some(id) => file.load(id)?,
                    None => match &mut self.state().mosaic {
                        Stage::Growing(rendering) => rendering.views().image(frame)?,
                        _ => return Ok(()),
                    },
                };
                match &image.color {
                    Some(color) => fresh.add(color, &self.camera, &pose),
                    None => fresh.add(&image.gray, &self.camera, &pose),
                };
            }
        }
        let state = &mut *self.state();
        let Stage::Growing(rendering) = &mut state.mosaic else { return Ok(()) };
        state.bare.extend(rendering.mosaic().changed_since(0));
        rendering.go_on(fresh, newest.correction, |frame| rendered.contains(&frame));
        let there: BTreeSet<MosaicSquare> = rendering.mosaic().changed_since(0).collect();
        state.bare.retain(|square| !there.contains(square));
        state.generation += 1;
        Ok(())
    }

    /// Frame, keyframe if it is one, and corrected pose of everything with a stored image, in the
    /// order of the frames.
    fn views(
        &self,
        file: &MapFile,
        update: &MosaicUpdate,
    ) -> Result<Vec<(u64, Option<KeyframeId>, GroundPose)>> {
        let mut keyframes = update.keyframes.clone();
        let newest = keyframes.last().copied();
        let of_map = file.map()?.keyframes;
        let since = of_map.iter().filter(|keyframe| keyframe.session == update.session);
        keyframes.extend(since.filter_map(|keyframe| {
            let correction = newest.filter(|newest| newest.frame < keyframe.frame)?.correction;
            let pose = correction.apply_to_pose(&keyframe.odometry_pose);
            Some(PlacedKeyframe { pose, correction, ..keyframe.into() })
        }));
        let mut views: Vec<_> =
            keyframes.iter().map(|keyframe| (keyframe.frame, Some(keyframe.id), keyframe.pose)).collect();
        if let Stage::Growing(rendering) = &mut self.state().mosaic {
            views.extend(rendering.views().kept().iter().filter_map(|(frame, pose)| {
                let after = keyframes.partition_point(|keyframe| keyframe.frame <= *frame);
                let keyframe = keyframes.get(after.saturating_sub(1))?;
                Some((*frame, None, keyframe.correction.apply_to_pose(pose)))
            }));
        }
        views.sort_unstable_by_key(|view| view.0);
        Ok(views)
    }

    /// Finishes rendering; viewers see the mosaic as it is. `None` if it is finished already.
    pub fn finish(&self) -> Option<MosaicRenderingSummary> {
        let mut state = self.state();
        let Stage::Growing(rendering) = std::mem::replace(&mut state.mosaic, Stage::Away) else {
            return None;
        };
        let (mosaic, kept) = rendering.finished();
        state.mosaic = Stage::Finished(Box::new(mosaic));
        Some(kept)
    }

    /// Shows the mosaic that was written, all frames at their final poses, instead of the one that
    /// grew.
    pub fn show_written(&self, picture: GroundPicture) {
        let there: BTreeSet<MosaicSquare> = picture.changed_since(0).into_iter().collect();
        let state = &mut *self.state();
        let before: Vec<MosaicSquare> =
            state.mosaic().map_or_else(Vec::new, |mosaic| mosaic.changed_since(0).collect());
        state.bare.extend(before);
        state.bare.retain(|square| !there.contains(square));
        state.mosaic = Stage::Written(Box::new(picture));
        state.generation += 1;
    }
}

impl TiledGround for LiveGround {
    fn state(&self) -> Option<GroundState> {
        let state = Self::state(self);
        if let Stage::Written(picture) = &state.mosaic {
            let GroundState { metres_per_pixel, revision } = picture.state()?;
            return Some(GroundState { metres_per_pixel, revision: state.generation * REVISIONS + revision });
        }
        let mosaic = state.mosaic()?;
        let revision = state.generation * REVISIONS + mosaic.revision().min(REVISIONS - 1);
        Some(GroundState { metres_per_pixel: mosaic.resolution_m()?, revision })
    }

    fn changed_since(&self, revision: u64) -> Vec<MosaicSquare> {
        let state = Self::state(self);
        if let Stage::Written(picture) = &state.mosaic {
            let before = if revision / REVISIONS == state.generation { revision % REVISIONS } else { 0 };
            let bare = state.bare.iter().copied().filter(|_| before == 0);
            return picture.changed_since(before).into_iter().chain(bare).collect();
        }
        let Some(mosaic) = state.mosaic() else { return Vec::new() };
        if revision / REVISIONS == state.generation {
            return mosaic.changed_since(revision % REVISIONS).collect();
        }
        // An empty tile has a reply of its own.
        mosaic.changed_since(0).chain(state.bare.iter().copied()).collect()
    }

    fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
        let state = Self::state(self);
        match &state.mosaic {
            Stage::Written(picture) => picture.tile_rgba(tile),
            _ => state.mosaic()?.tile_rgba(tile),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::camera::{Distortion, Rig};
    use odograph::geometry::{GroundPose, Placement};
    use odograph::ground_map::KeyframeImage;
    use odograph::image::GrayImage;
    use odograph::keyframe::KeyframeId;
    use odograph_video::{Frame, Picture, SampleLayout};

    fn camera() -> Camera {
        Camera::new((64, 48), (50.0, 50.0), (31.5, 23.5), Distortion::from_opencv(&[0.0; 4]).unwrap())
            .unwrap()
    }

    fn at(x_m: f64) -> GroundPose {
        GroundPose { x_m, ..GroundPose::level(1.0) }
    }

    fn posed(number: u64, shade: u8, pose: GroundPose) -> Posed {
        let picture =
            Picture::from_samples(SampleLayout::Gray, 64, 48, 64, &[shade; 64 * 48], false).unwrap();
        let frame = Frame::new(number, number as f64, picture);
        Posed { frame, pose, segment: 0, is_keyframe: false }
    }

    /// Gray level of the ground at x on the x axis.
    fn shade(ground: &LiveGround, x_m: f64) -> Option<u8> {
        let metres_per_pixel = TiledGround::state(ground)?.metres_per_pixel;
        let column = (x_m / metres_per_pixel).floor() as i64;
        let side = Mosaic::TILE_SIDE_PX as i64;
        let rgba = ground.tile_rgba(MosaicSquare { column: column.div_euclid(side), row: 0 })?;
        let pixel = 4 * (column.rem_euclid(side) + 2 * side) as usize;
        (rgba[pixel + 3] > 0).then_some(rgba[pixel])
    }

    #[test]
    fn without_viewers_nothing_is_rendered() {
        let folder = tempfile::tempdir().unwrap();
        let rendered = |shown| {
            let ground = LiveGround::new(camera(), folder.path(), shown);
            ground.render(posed(0, 50, at(0.0)), None);
            ground.render(posed(1, 90, at(30.0)), None);
            assert!(ground.finish().unwrap().failure.is_none());
            TiledGround::state(&ground).is_some()
        };
        assert!(rendered(true));
        assert!(!rendered(false));
    }

    #[test]
    fn after_a_loop_the_ground_lies_where_the_map_has_it_and_so_does_what_comes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        let camera = camera();
        let mut file = MapFile::create(&path, &camera, &Rig::level(1.0)).unwrap();
        let session = file.begin_session("drive").unwrap();
        let keyframe = |id: u64, pose| MapKeyframe {
            id: KeyframeId(id),
            session,
            segment: 0,
            frame: id,
            time_s: id as f64,
            odometry_pose: at(30.0 * id as f64),
            pose,
            covariance: nalgebra::Matrix6::identity() * 1e-6,
            signature: Default::default(),
        };
        let (first, second) = (keyframe(0, at(0.0)), keyframe(1, at(15.0)));
        for (keyframe, shade) in [(&first, 50), (&second, 90)] {
            let gray = GrayImage::from_samples(64, 48, vec![shade; 64 * 48]).unwrap();
            file.add_keyframe(keyframe, &KeyframeImage { gray, color: None }, &[]).unwrap();
        }
        let ground = LiveGround::new(camera, folder.path(), true);
        ground.render(posed(0, 50, at(0.0)), None);
        ground.render(posed(1, 90, at(30.0)), None);
        let before = TiledGround::state(&ground).unwrap().revision;
        assert_eq!([0.1, 15.1, 30.1].map(|x_m| shade(&ground, x_m)), [Some(50), None, Some(90)]);
        let keyframes = vec![PlacedKeyframe::from(&first), PlacedKeyframe::from(&second)];
        ground.render_again(&MosaicUpdate { file: path, session, keyframes }).unwrap();
        // Every changed tile is reported to the viewers, including empty ones.
        let changed = ground.changed_since(before);
        let (there, bare): (Vec<_>, Vec<_>) =
            changed.into_iter().partition(|tile| ground.tile_rgba(*tile).is_some());
        assert!(!there.is_empty() && !bare.is_empty(), "{there:?} {bare:?}");
        assert_eq!([0.1, 15.1, 30.1].map(|x_m| shade(&ground, x_m)), [Some(50), Some(90), None]);
        // Frames that odometry has fifteen metres too far are rendered at their corrected poses.
        let revision = TiledGround::state(&ground).unwrap().revision;
        ground.render(posed(2, 130, at(40.0)), None);
        assert_eq!([25.1, 40.1].map(|x_m| shade(&ground, x_m)), [Some(130), None]);
        let new = ground.changed_since(revision);
        assert!(!new.is_empty() && new.iter().all(|tile| ground.tile_rgba(*tile).is_some()), "{new:?}");
    }

    #[test]
    fn after_a_loop_frames_between_keyframes_and_later_keyframes_stay_rendered() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.gpkg");
        let camera = camera();
        let mut file = MapFile::create(&path, &camera, &Rig::level(1.0)).unwrap();
        let session = file.begin_session("drive").unwrap();
        let mut keyframe = |id: u64, frame: u64, odometry_x_m, x_m, shade| {
            let keyframe = MapKeyframe {
                id: KeyframeId(id),
                session,
                segment: 0,
                frame,
                time_s: frame as f64,
                odometry_pose: at(odometry_x_m),
                pose: at(x_m),
                covariance: nalgebra::Matrix6::identity() * 1e-6,
                signature: Default::default(),
            };
            let gray = GrayImage::from_samples(64, 48, vec![shade; 64 * 48]).unwrap();
            file.add_keyframe(&keyframe, &KeyframeImage { gray, color: None }, &[]).unwrap();
            keyframe
        };
        let ground = LiveGround::new(camera, folder.path(), true);
        // A loop moves the keyframe of frame 0 back by 5 m, that of frame 20 by 13 m.
        let known = [keyframe(0, 0, 0.0, -5.0, 50), keyframe(1, 20, 200.0, 187.0, 90)];
        // The map has another one since then, and those of the last frames are yet to come.
        keyframe(2, 30, 300.0, 300.0, 110);
        for number in 0..=32 {
            let shade = 50 + number as u8;
            let is_keyframe = [0, 20, 30].contains(&number);
            ground.render(Posed { is_keyframe, ..posed(number, shade, at(10.0 * number as f64)) }, None);
        }
        let keyframes = known.iter().map(PlacedKeyframe::from).collect();
        ground.render_again(&MosaicUpdate { file: path, session, keyframes }).unwrap();
        for (frame, shift_m, expected) in [
            (0, 5.0, 50),
            (1, 5.0, 51),
            (19, 5.0, 69),
            (20, 13.0, 90),
            (21, 13.0, 71),
            (29, 13.0, 79),
            (30, 13.0, 110),
            (31, 13.0, 81),
            (32, 13.0, 82),
        ] {
            let x_m = 10.0 * f64::from(frame) - shift_m + 0.1;
            assert_eq!(shade(&ground, x_m), Some(expected), "frame {frame}");
        }
    }

    #[test]
    fn at_the_end_the_ground_is_the_one_that_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let ground = LiveGround::new(camera(), folder.path(), true);
        ground.render(posed(0, 50, at(0.0)), None);
        ground.render(posed(1, 90, at(30.0)), None);
        ground.finish().unwrap();
        let before = TiledGround::state(&ground).unwrap();
        let placement = Placement { metres_per_pixel: before.metres_per_pixel, x_m: 0.0, y_m: 0.0 };
        let side = 2 * Mosaic::TILE_SIDE_PX;
        let rgba = [200, 200, 200, 255].repeat(side * side);
        ground.show_written(GroundPicture::new(rgba, side, side, placement).unwrap());
        assert_eq!([0.1, 30.1].map(|x_m| shade(&ground, x_m)), [Some(200), None]);
        // All tiles are announced once, including those that are now empty.
        let changed = ground.changed_since(before.revision);
        assert!(changed.iter().any(|tile| ground.tile_rgba(*tile).is_none()), "{changed:?}");
        let now = TiledGround::state(&ground).unwrap().revision;
        assert!(now > before.revision && ground.changed_since(now).is_empty());
    }
}
