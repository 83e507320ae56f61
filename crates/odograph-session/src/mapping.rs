//! The map of a run: written during the run, and applied to the path at the end.

use crate::files;
use crate::folder::OutputFolder;
use crate::growing_map_file::GrowingMapFile;
use crate::kept_frames::KeptFrames;
use crate::marker_statistics::MarkerStatistics;
use crate::markers::MarkerWatch;
use crate::observer::Observer;
use crate::other_scale::OtherScale;
use crate::output::{MapUse, RunOutput};
use crate::plan::RunPlan;
use crate::statistics::LoopStatistics;
use crate::timings::{StageTime, Timings};
use odograph::error::{Error, Result};
use odograph::fixed_pattern::ImageMask;
use odograph::geometry::{GroundPoint, GroundPose, Sim2};
use odograph::georeference::{Anchor, Georeference};
use odograph::ground_map::{KeyframeImage, KeyframeImages, MemoryImages};
use odograph::keyframe::{EdgeKind, KeyframeId};
use odograph::mosaic::{Mosaic, MosaicPicture};
use odograph::numerics::median;
use odograph::odometry::{FrameReference, KeyframeEvent};
use odograph::slam::{AntennaFix, DriftCorrection, KeyframeSpans, Mapper, SessionScale};
use odograph::trajectory::{FrameEstimate, LostStretches};
use odograph_map::{MapClaim, MapFile, PathFrame};
use odograph_video::Frame;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// The mapper of a run, and the file that it writes.
pub struct Mapping {
    mapper: Mapper,
    file: GrowingMapFile,
    times: Timings,
    /// The markers on the ground, where they are looked for.
    markers: Option<MarkerWatch>,
    /// Height of the camera that the run began with, metres.
    height_m: f64,
    /// Whether neither loops nor markers are looked for, to keep up with a camera.
    is_suspended: bool,
    /// Whether the map is to have this run only where it is recognised.
    only_recognised: bool,
    /// Whether a run that is not recognised has a warning; a localization reports this otherwise.
    warns: bool,
    /// The height at which a run that is not recognised would be.
    other_scale: Option<OtherScale>,
}

/// Ground sampling distance of the mosaic of a continued map, in ground pixels at the image centre:
/// a quarter of the pixels, hence about a quarter of the time.
const COARSER: f64 = 2.0;

/// Largest ratio of the map's keyframes to this run's for which the mosaic is rendered again:
/// larger keeps the picture complete, smaller keeps the end of a short run short.
const MAX_OLD: usize = 4;

impl Mapping {
    /// Opens the map to be continued, or creates a new one. Fails where the file is not a map with
    /// a session of this camera.
    pub fn new(plan: &RunPlan, folder: &OutputFolder, output: &RunOutput) -> Result<Self> {
        let map = &output.map;
        let path = map.path().map_or_else(|| folder.path().join("map.gpkg"), Path::to_owned);
        let continued = map.path().is_some() && MapFile::is_there(&path);
        let claim = match (map.is_read_only(), folder.claim_on(&path)) {
            (true, _) => None,
            (false, Some(claim)) => Some(claim.clone()),
            (false, None) => Some(MapClaim::on(&path)?),
        };
        // The map stores images corrected to a global shutter.
        let global = plan.camera.clone().with_readout_s(None)?;
        let markers = MarkerWatch::new(plan, &global)?;
        if continued && markers.as_ref().is_some_and(|markers| markers.control.is_some()) {
            return Err(Error::usage(format!(
                "control points place a new map, and {} is there already with a frame of its own; leave one of the two out",
                path.display()
            )));
        }
        let mut file = GrowingMapFile {
            file: None,
            replaces: map.path().is_none(),
            claim,
            path,
            camera: global.clone(),
            rig: plan.rig,
            source: output.source_name(&plan.source.path),
            origin: folder.origin().cloned(),
            session: 0,
            mask: None,
            kept: map.is_read_only().then(MemoryImages::default),
        };
        let mapper = if continued {
            let mut there = match &file.claim {
                None => MapFile::open_read_only(&file.path)?,
                Some(claim) => MapFile::open_claimed(claim.clone())?,
            };
            if !there.mounted_cameras()?.iter().any(|mounted| mounted.camera == global) {
                return Err(Error::input(format!(
                    "{} was made with another camera than this run's; give the camera file that it was made with, or \
                     begin a new map",
                    file.path.display()
                )));
            }
            let mut old = there.map()?;
            let first = there.next_keyframe()?;
            let seen = markers.as_ref().map_or(Ok(Vec::new()), |markers| markers.seen_before(&there))?;
            file.session = if map.is_read_only() {
                there.sessions()?.iter().map(|session| session.id + 1).max().unwrap_or(0)
            } else {
                file.begin_session(&mut there)?
            };
            file.file = Some(there);
            if global != old.camera {
                old.other_cameras.insert(file.session, file.mounted());
            }
            let mut mapper = Mapper::continuing(old, &plan.odometry, plan.slam, file.session, first);
            mapper.remember_sightings(seen);
            mapper
        } else {
            Mapper::new(&global, plan.rig, &plan.odometry, plan.slam)
        };
        Ok(Self {
            mapper,
            file,
            times: Timings::default(),
            markers,
            height_m: plan.rig.height_m,
            is_suspended: false,
            only_recognised: matches!(map, MapUse::Extend(_)),
            warns: matches!(map, MapUse::Continue(_)) || output.resumed.is_some(),
            other_scale: None,
        })
    }

    /// Adds the keyframe events of a frame.
    pub fn take(&mut self, events: Vec<KeyframeEvent>, frame: Option<&Frame>) -> Result<()> {
        for event in events {
            let color = match &event {
                KeyframeEvent::Made(new) => frame
                    .filter(|frame| frame.number == new.frame && frame.has_color())
                    .map(|frame| frame.rgb()),
                KeyframeEvent::Revisited(_) => None,
            };
            let sightings = match (&mut self.markers, &event) {
                (Some(markers), KeyframeEvent::Made(new)) if !self.is_suspended => markers.look(new),
                _ => Vec::new(),
            };
            let started = Instant::now();
            self.mapper.take(event, color, &mut self.file)?;
            self.file.set_mask(self.mapper.map().masks.get(&self.mapper.session()))?;
            if let Some(markers) = self.markers.as_ref().filter(|_| !sightings.is_empty()) {
                let before = self.mapper.marker_sightings();
                self.mapper.add_sightings(&sightings, &mut self.file)?;
                let added = &self.mapper.own_sightings()[before..];
                self.file.add_markers(&markers.family, added)?;
            }
            self.times.push(started.elapsed());
        }
        Ok(())
    }

    /// Suspends the search for loops and markers until there is time again.
    #[cfg_attr(not(feature = "live"), allow(dead_code))]
    pub fn suspend_search(&mut self, is_suspended: bool) {
        self.is_suspended = is_suspended;
        self.mapper.suspend_loop_search(is_suspended);
    }

    /// The pose graph so far.
    pub fn mapper(&self) -> &Mapper {
        &self.mapper
    }

    /// Mask of pixels that did not show ground when the map was last continued with this camera.
    pub fn expected_mask(&self) -> Option<&Arc<ImageMask>> {
        self.mapper.map().newest_mask_of(&self.file.camera)
    }

    /// Path of the map file.
    #[cfg_attr(not(feature = "live"), allow(dead_code))]
    pub fn path(&self) -> &Path {
        &self.file.path
    }

    /// Applies the fused path: frames before and after, and their references, which move with them.
    pub fn apply_fusion(
        &mut self,
        raw: &[FrameEstimate],
        fused: &[FrameEstimate],
        references: &mut [Option<FrameReference>],
    ) {
        self.mapper.apply_fusion(raw, fused, references);
    }

    /// Finishes the map: optimises it, and places it in the survey frame of its control points.
    pub fn finish(&mut self) {
        self.mapper.finish();
        if let Some(markers) = &mut self.markers {
            markers.survey(&mut self.mapper);
        }
        if !self.mapper.is_recognised() {
            self.other_scale = OtherScale::of(&self.mapper, self.height_m, &mut self.file);
        }
    }

    /// Bends the finished map to the positions of a satellite receiver, where these show that it
    /// has drifted ([`Mapper::correct_drift`]).
    pub fn correct_drift(&mut self, fixes: &[AntennaFix], found: &Georeference) -> Option<DriftCorrection> {
        self.mapper.correct_drift(fixes, &found.anchor.plane_from_map(), found.spread)
    }

    /// Transforms the frames into the frame of the finished map; with the correction of each where
    /// `moves` are requested. Writes no output file. Fails where the frames cannot be read back.
    pub fn correct_frames(
        &mut self,
        frames: &mut KeptFrames,
        moves: bool,
        folder: &Path,
    ) -> Result<CorrectedFrames> {
        // A new frame of reference is no correction.
        let surveyed = self.markers.as_ref().and_then(|markers| markers.surveyed.as_ref()?.as_ref().ok());
        let frame_moved = surveyed.map(|surveyed| surveyed.survey_from_map);
        let kept = self.mapper.is_corrected().then(|| KeptFrames::new(folder));
        let mut corrected = CorrectedFrames { frames: kept, ..CorrectedFrames::default() };
        let mut spans = KeyframeSpans::default();
        if corrected.frames.is_some() {
            frames.each(|frame, reference| {
                spans.push(frame, reference);
                Ok(())
            })?;
        }
        let mut correction = spans.correction(&self.mapper);
        frames.each(|before, _| {
            let after = correction.next(before.clone());
            corrected.count(before, &after, frame_moved.as_ref(), moves);
            if let Some(kept) = &mut corrected.frames {
                kept.push(after, None);
            }
            Ok(())
        })?;
        Ok(corrected)
    }

    /// Writes the final poses of the keyframes, the path of the run and what of its images is not
    /// ground, unless the map is to stay as it was.
    pub fn save(&mut self, frames: &mut KeptFrames, mask: Option<&Arc<ImageMask>>) -> Result<()> {
        if self.is_withdrawn() {
            return Ok(());
        }
        self.file.set_mask(mask)?;
        self.file.set_poses(&self.mapper.map().keyframes)?;
        if let Some(markers) = &self.markers {
            // Their metres are those of the keyframes, which sensors may have corrected.
            self.file.set_markers(&markers.family, self.mapper.own_sightings())?;
        }
        self.write_path(frames)
    }

    /// Whether the map is to stay as it was.
    fn is_withdrawn(&self) -> bool {
        self.only_recognised && !self.mapper.is_recognised()
    }

    /// A warning where the run could not be connected to the map that it continues.
    pub fn warning(&self) -> Option<String> {
        let outcome = match self.only_recognised {
            true => "it stays as it was, and the path is",
            false => "the path is",
        };
        (self.warns && !self.mapper.is_recognised()).then(|| {
            let other_scale = self.other_scale.map_or(String::new(), |scale| format!("; {scale}"));
            format!(
                "nothing of {} was recognised: {outcome} in a frame of its own, which begins at its first frame{other_scale}",
                self.file.path.display()
            )
        })
    }

    /// A warning where the run was recognised, but with metres that are not those of the map.
    pub fn scale_warning(&self) -> Option<String> {
        let scale = self.mapper.scale_in_map().filter(SessionScale::is_doubtful)?;
        self.mapper.is_recognised().then(|| {
            let camera = other_height("the camera", &scale, self.height_m);
            let path = self.file.path.display();
            format!(
                "by the ground that was recognised in {path} {camera}: check height and focal length, here and of the map"
            )
        })
    }

    /// The height at which the run would have been recognised in the map that it continues or looks
    /// into; `None` where it was, or where no height helps.
    pub fn other_scale(&self) -> Option<OtherScale> {
        self.other_scale
    }

    /// Statistics of the markers and warnings about them; `None` where none are looked for.
    pub fn marker_statistics(&self) -> Option<(MarkerStatistics, Vec<String>)> {
        let watch = self.markers.as_ref()?;
        let statistics = MarkerStatistics::of(watch, &self.mapper);
        let warnings = statistics.warnings(watch, self.height_m);
        Some((statistics, warnings))
    }

    /// Effect of the loops on the frames.
    pub fn statistics(&self, corrected: &CorrectedFrames) -> LoopStatistics {
        let closed = self.mapper.closures().len();
        let session = self.mapper.session();
        let map = self.mapper.map();
        let own = |id: KeyframeId| map.keyframes.iter().any(|k| k.id == id && k.session == session);
        let loops = map.edges.iter().filter(|e| e.kind == EdgeKind::Loop && own(e.from)).count();
        let (ahead, left) = self.mapper.turn_per_m();
        LoopStatistics {
            closed: closed as u64,
            revisited: loops.saturating_sub(closed + self.mapper.marker_edges()) as u64,
            correction_rms_m: (corrected.squares_m2 / corrected.posed.max(1) as f64).sqrt(),
            correction_most_m: corrected.most_m,
            turn_per_m: [ahead, left],
            keyframe: StageTime::of(&self.times),
        }
    }

    /// The keyframes of this run, each with the number of its frame.
    pub fn own_keyframes(&self) -> impl Iterator<Item = (KeyframeId, u64)> {
        let session = self.mapper.session();
        let own = self.mapper.map().keyframes.iter().filter(move |keyframe| keyframe.session == session);
        own.map(|keyframe| (keyframe.id, keyframe.frame))
    }

    /// Positions of the camera at the keyframes of this run.
    pub fn own_places(&self) -> Vec<GroundPoint> {
        let session = self.mapper.session();
        let own = self.mapper.map().keyframes.iter().filter(|keyframe| keyframe.session == session);
        own.map(|keyframe| GroundPoint::new(keyframe.pose.x_m, keyframe.pose.y_m)).collect()
    }

    /// The image of a keyframe. Fails where it cannot be read back.
    pub fn image(&mut self, keyframe: KeyframeId) -> Result<KeyframeImage> {
        self.file.load(keyframe)
    }

    /// The recognised places: pose of the camera, and the earlier pose.
    pub fn loops(&self) -> Vec<[GroundPoint; 2]> {
        let map = self.mapper.map();
        let place = |id: KeyframeId| {
            let at = map.keyframes.binary_search_by_key(&id, |keyframe| keyframe.id).ok()?;
            let pose = map.keyframes[at].pose;
            Some(GroundPoint::new(pose.x_m, pose.y_m))
        };
        let closures = self.mapper.closures().iter();
        closures.filter_map(|closure| Some([place(closure.edge.from)?, place(closure.edge.to)?])).collect()
    }

    fn write_path(&mut self, frames: &mut KeptFrames) -> Result<()> {
        let writable = self.file.kept.is_none();
        let Some(file) = self.file.file.as_mut().filter(|_| writable) else { return Ok(()) };
        let mut lost = LostStretches::default();
        file.set_path_from(self.file.session, |put| {
            frames.each(|frame, _| {
                lost.push(frame.time_s, frame.status);
                match &frame.estimate {
                    Some(known) => put(&PathFrame {
                        frame: frame.frame,
                        segment: frame.segment,
                        time_s: frame.time_s,
                        pose: known.pose,
                    }),
                    None => Ok(()),
                }
            })
        })?;
        file.set_losses(self.file.session, &lost.finish())
    }

    /// Writes the mosaic into the file, at twice the ground sampling distance of the camera. Where
    /// all ground is this run's, its `mosaic` is reused. Returns a warning where the file lacks the
    /// mosaic of some ground: because the run was interrupted, or because most of a continued map
    /// is of earlier runs, which are not rendered again for every short one.
    pub fn render_ground(&mut self, mosaic: &Mosaic, observer: &dyn Observer) -> Result<Option<String>> {
        let map = self.mapper.map();
        let session = self.mapper.session();
        let own = map.keyframes.iter().filter(|keyframe| keyframe.session == session).count();
        let mut heights_m: Vec<f64> = map.keyframes.iter().map(|keyframe| keyframe.pose.height_m).collect();
        let height_m = median(&mut heights_m).unwrap_or(map.rig.height_m);
        let coarse_m = COARSER * height_m / map.camera.focal_px().0;
        let (short, alone) = (map.keyframes.len() > MAX_OLD * own, map.keyframes.len() == own);
        let writable = self.file.kept.is_none() && !self.is_withdrawn();
        let Some(file) = self.file.file.as_mut().filter(|_| writable && own > 0) else { return Ok(None) };
        let before = file.mosaic()?;
        if alone && before.is_none() && file.set_mosaic(&mosaic.coarser())? {
            return Ok(None);
        }
        let rendered = !short && {
            let resolution_m = before.as_ref().map_or(coarse_m, |layer| layer.resolution_m);
            file.render_mosaic(Some(resolution_m), &mut |_| !observer.is_stop_asked())?
        };
        let path = self.file.path.display();
        Ok((!rendered).then(|| match before {
            Some(_) => format!(
                "the mosaic in {path} does not show this run yet; odograph map mosaic {path} renders it again"
            ),
            None => format!("{path} has no picture of the ground; odograph map mosaic {path} renders it"),
        }))
    }

    /// The mosaic of the map file with at most this number of pixels; `None` if it has none.
    pub fn ground_within(&self, most_pixels: usize) -> Result<Option<MosaicPicture>> {
        let Some(file) = &self.file.file else { return Ok(None) };
        file.mosaic_picture(most_pixels)
    }

    /// Writes the mosaic of the map file in UTM. Returns whether there is one.
    pub fn write_geotiff(&self, path: &Path, anchor: &Anchor) -> Result<bool> {
        let Some(file) = &self.file.file else { return Ok(false) };
        let Some(layer) = file.mosaic()? else { return Ok(false) };
        files::write_with(path, |output| {
            file.write_geotiff(&layer, output, Some(anchor), &mut || Ok(()))
                .map(drop)
                .map_err(|error| error.at(path.display()))
        })?;
        Ok(true)
    }

    /// Removes the new map file of a run that starts again.
    pub fn discard(self) -> Result<()> {
        let GrowingMapFile { file, claim, .. } = self.file;
        match file {
            Some(file) => file.close().and_then(|()| claim.map_or(Ok(()), |claim| claim.remove_map())),
            None => Ok(()),
        }
    }

    /// The map file, if this run has written to it.
    pub fn written(&self) -> Option<&Path> {
        let is_ours = self.file.kept.is_none() && !self.is_withdrawn();
        (self.file.file.is_some() && is_ours).then_some(self.file.path.as_path())
    }

    /// Closes the file. Removes the map of an earlier run that this one replaces if no ground was
    /// seen, and this run from a map that has no keyframe of it, or in which it was not recognised,
    /// where that is asked.
    pub fn close(&mut self) -> Result<()> {
        let is_empty = self.file.kept.is_none() && self.file.origin.is_none() && self.own_places().is_empty();
        let is_withdrawn = is_empty || self.is_withdrawn();
        match (self.file.file.take(), &self.file.claim) {
            (Some(mut file), _) if is_withdrawn => {
                file.remove_session(self.file.session).and_then(|()| file.close())
            }
            (Some(file), _) => file.close(),
            (None, Some(claim)) if self.file.replaces => claim.remove_map(),
            (None, _) => Ok(()),
        }
    }
}

/// Frames in the map frame.
#[derive(Default)]
pub struct CorrectedFrames {
    /// `None` if they are unchanged.
    pub frames: Option<KeptFrames>,
    /// Times of the frames with a pose, each with that pose before and after, where requested.
    pub moves: Vec<(f64, GroundPose, GroundPose)>,
    /// Displacement of the poses: sum of squares and largest, metres.
    squares_m2: f64,
    most_m: f64,
    posed: usize,
}

impl CorrectedFrames {
    /// `frame_moved` is from the frame of reference of the frames before to that of those after.
    fn count(
        &mut self,
        before: &FrameEstimate,
        after: &FrameEstimate,
        frame_moved: Option<&Sim2>,
        moves: bool,
    ) {
        let (Some(a), Some(b)) = (&before.estimate, &after.estimate) else { return };
        let from = frame_moved.map_or(a.pose, |moved| moved.apply_to_pose(&a.pose));
        let moved_m = from.distance_m(&b.pose);
        self.squares_m2 += moved_m * moved_m;
        self.most_m = self.most_m.max(moved_m);
        self.posed += 1;
        if moves {
            self.moves.push((before.time_s, a.pose, b.pose));
        }
    }
}

/// Says at which height a camera was by the metres of a map, and not at that by which it was
/// tracked, metres.
pub fn other_height(camera: &str, scale: &SessionScale, height_m: f64) -> String {
    let in_map_m = height_m * scale.ratio;
    // Three digits: a microscope is millimetres high.
    let decimals = (2.0 - in_map_m.log10().floor()).clamp(2.0, 9.0) as usize;
    format!("{camera} was {in_map_m:.decimals$} m above it, not {height_m:.decimals$} m")
}
