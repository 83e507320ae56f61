//! A drive: odometry, map and mosaic, one after the other for every frame.

use crate::picture::{Chroma, Picture};
use crate::settings::{Settings, Setup};
use odograph_core::error::Result;
use odograph_core::formats::track_record::TrackRecord;
use odograph_core::formats::trajectory_file;
use odograph_core::geometry::GroundPose;
use odograph_core::ground_map::{KeyframeImages, MemoryImages};
use odograph_core::loop_closure::LoopClosureConfig;
use odograph_core::mosaic::{Mosaic, MosaicOptions};
use odograph_core::odometry::{FrameReference, KeyframeEvent, TrackView};
use odograph_core::pose_frame::{BaseLink, PoseFrame};
use odograph_core::self_calibration::{CameraDifference, CameraMonitor, MultiPassCalibration};
use odograph_core::slam::{Mapper, map_frames};
use odograph_core::trajectory::{FrameSummary, distance_m};
use odograph_core::{Camera, FrameEstimate, Odometry, OdometryConfig};
use serde::Serialize;
use std::collections::BTreeMap;

/// One recording, tracked as `odograph run` tracks it, in memory alone.
#[derive(Debug)]
pub struct Drive {
    calibration: MultiPassCalibration,
    size: (usize, usize),
    pass: Pass,
}

/// One pass over the recording: it begins again where the camera proves to differ from what was
/// assumed.
#[derive(Debug)]
struct Pass {
    odometry: Odometry,
    monitor: CameraMonitor,
    mapper: Mapper,
    images: MemoryImages,
    /// Colour of the keyframes, by their frames.
    colors: BTreeMap<u64, Chroma>,
    /// While driving, with ground pixels twice as wide as at the end.
    mosaic: Mosaic,
    /// The last frame with a pose; no keyframe shows the ground at the end.
    last_view: Option<Picture>,
    /// Revision of the mosaic whose changes were asked for last.
    shown_revision: u64,
    frames: Vec<FrameEstimate>,
    references: Vec<Option<FrameReference>>,
}

/// Number of values in the record of a frame.
pub const RECORD: usize = TrackRecord::LENGTH;

/// What became of a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Taken {
    /// Its record.
    Frame([f32; RECORD]),
    /// The recording is to be given again from its first frame, because of what the sentence says.
    Again(String),
}

/// Tiles of the mosaic that have changed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChangedGround {
    /// Side of a ground pixel, metres; `None` before the first frame.
    pub metres_per_pixel: Option<f64>,
    /// Column and row of each.
    pub tiles: Vec<(i64, i64)>,
}

/// A finished drive.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Frames.
    pub frames: usize,
    /// Frames with a pose.
    pub tracked: usize,
    /// Keyframes.
    pub keyframes: usize,
    /// Loops closed.
    pub loops: usize,
    /// Path length over ground, metres.
    pub distance_m: f64,
    /// Largest correction of a frame by loops, metres.
    pub correction_m: f64,
    /// x, y (metres) and heading (radians) of the last frame with a pose.
    pub last: Option<[f64; 3]>,
    /// What was found of the camera, a sentence; empty where it is as given.
    pub found: String,
}

/// Width of a ground pixel while driving, in pixels of the image's centre: a quarter of the pixels,
/// hence about a quarter of the time.
const COARSER: f64 = 2.0;

/// Half as much as on a machine of one's own: a page has at most 4 GB for everything.
const MOSAIC_PIXELS: usize = 16_000_000;

impl Drive {
    /// A drive with frames of this size, pixels.
    ///
    /// # Errors
    /// If the settings cannot be understood.
    pub fn begin(settings: &Settings, size: (usize, usize)) -> Result<(Self, Setup)> {
        let (camera, rig) = settings.camera_and_rig(size)?;
        let setup = Setup::of(&camera, &rig);
        let mut calibration = MultiPassCalibration::new(camera, rig);
        calibration.calibrates = true;
        calibration.measures_shutter = true;
        calibration.corrects_images = true;
        let pass = Pass::new(&calibration)?;
        Ok((Self { calibration, size, pass }, setup))
    }

    /// Width and height of the frames, pixels.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Takes the next frame.
    ///
    /// # Errors
    /// If the time is not a number.
    pub fn process(&mut self, picture: Picture, time_s: f64) -> Result<Taken> {
        match self.pass.next(picture, time_s, &self.calibration.camera)? {
            None => Ok(Taken::Frame(self.pass.last_record())),
            Some(difference) => self.again(difference).map(Taken::Again),
        }
    }

    /// Begins the next pass; returns what was found, a sentence.
    fn again(&mut self, difference: CameraDifference) -> Result<String> {
        self.calibration.apply(difference);
        self.pass = Pass::new(&self.calibration)?;
        Ok(self.found())
    }

    /// What was found of the camera, a sentence; empty where it is as given.
    fn found(&self) -> String {
        let mut parts = Vec::new();
        if let Some(tilt) = self.calibration.found().and_then(|found| found.tilt.as_ref()) {
            let (roll, pitch) = (tilt.roll_rad.to_degrees(), tilt.pitch_rad.to_degrees());
            parts.push(format!("the camera is tilted, roll {roll:+.2}° and pitch {pitch:+.2}°"));
        }
        if self.calibration.found().is_some_and(|found| found.lens.is_some()) {
            parts.push("the lens is another than the camera file says".to_owned());
        }
        if let Some(readout) = self.calibration.found_readout().filter(|found| found.mean_s != 0.0) {
            parts.push(format!("the shutter takes {:.1} ms to read an image", 1e3 * readout.mean_s));
        }
        if self.calibration.images.correction.is_some() {
            parts.push("the camera adds a pattern to every image".to_owned());
        }
        parts.join("; ")
    }

    /// Ends the drive, once: closes its loops and places frames and mosaic accordingly. What was
    /// found of the camera instead, if the recording is to be given again.
    ///
    /// # Errors
    /// If a keyframe's image is missing.
    pub fn finish(&mut self, is_whole: bool) -> Result<std::result::Result<Summary, String>> {
        if let Some(difference) = self.pass.monitor.at_end(&self.pass.odometry).filter(|_| is_whole) {
            return self.again(difference).map(Err);
        }
        let before = self.pass.frames.clone();
        self.pass.close_loops(&self.calibration.camera)?;
        let frames = &self.pass.frames;
        let pose = |frame: &FrameEstimate| frame.estimate.as_ref().map(|known| known.pose);
        let moved = before.iter().zip(frames).filter_map(|(before, after)| {
            let (before, after) = (pose(before)?, pose(after)?);
            Some(after.distance_m(&before))
        });
        let summaries: Vec<FrameSummary> = frames.iter().map(FrameSummary::from).collect();
        Ok(Ok(Summary {
            frames: frames.len(),
            tracked: frames.iter().filter(|frame| frame.estimate.is_some()).count(),
            keyframes: self.pass.mapper.map().keyframes.len(),
            loops: self.pass.mapper.closures().len(),
            distance_m: distance_m(&summaries),
            correction_m: moved.fold(0.0, f64::max),
            last: frames.iter().rev().find_map(pose).map(|pose| [pose.x_m, pose.y_m, pose.heading_rad]),
            found: self.found(),
        }))
    }

    /// The tracks of the last frame: where each is and where its corner is in the keyframe,
    /// quarters of a pixel, and whether it agrees with the motion.
    pub fn tracks(&self) -> Vec<[i16; 5]> {
        let quarters = |pixels: f64| (4.0 * pixels) as i16; // values out of range become the nearest
        let track = |track: &TrackView| {
            let [x, y] = [track.pixel.x, track.pixel.y].map(quarters);
            let [from_x, from_y] = [track.corner.x, track.corner.y].map(quarters);
            [x, y, from_x, from_y, track.inlier.into()]
        };
        self.pass.odometry.tracks().iter().map(track).collect()
    }

    /// The mosaic so far.
    pub fn mosaic(&self) -> &Mosaic {
        &self.pass.mosaic
    }

    /// The tiles of the mosaic that have changed since this was last asked.
    pub fn changed_ground(&mut self) -> ChangedGround {
        let Pass { mosaic, shown_revision, .. } = &mut self.pass;
        let tiles = mosaic.changed_since(*shown_revision).map(|square| (square.column, square.row)).collect();
        *shown_revision = mosaic.revision();
        ChangedGround { metres_per_pixel: mosaic.resolution_m(), tiles }
    }

    /// The records of all frames.
    pub fn records(&self) -> impl Iterator<Item = [f32; RECORD]> {
        let first_s = self.pass.first_time_s();
        self.pass.frames.iter().map(move |frame| TrackRecord::new(frame, first_s, None).values)
    }

    /// The path as `trajectory.tum`.
    pub fn trajectory_tum(&self) -> String {
        let of = self.pose_frame();
        let mut text = trajectory_file::tum_header(&of);
        let poses = self.pass.frames.iter().filter_map(|frame| of.stamped(frame));
        poses.for_each(|pose| text.push_str(&trajectory_file::tum_line(&pose)));
        text
    }

    /// All frames as `trajectory.csv`.
    pub fn trajectory_csv(&self) -> String {
        let of = self.pose_frame();
        let frames: Vec<FrameEstimate> =
            self.pass.frames.iter().map(|frame| of.frame(frame).into_owned()).collect();
        trajectory_file::csv_from_frames(&frames)
    }

    /// Whose poses are written: the robot's, where the rig says where the camera is on it.
    fn pose_frame(&self) -> PoseFrame {
        BaseLink::of(&self.calibration.rig).map_or(PoseFrame::Camera, PoseFrame::BaseLink)
    }
}

impl Pass {
    fn new(calibration: &MultiPassCalibration) -> Result<Self> {
        let MultiPassCalibration { camera, rig, .. } = calibration;
        let config = OdometryConfig::default();
        let mut odometry = calibration.odometry(config)?;
        odometry.record_keyframes();
        // The images of keyframes are as a global shutter would have taken them.
        let global = camera.clone().with_readout_s(None)?;
        Ok(Self {
            odometry,
            monitor: calibration.monitor(),
            mapper: Mapper::new(&global, *rig, &config, LoopClosureConfig::default()),
            images: MemoryImages::default(),
            colors: BTreeMap::new(),
            mosaic: Mosaic::new(MosaicOptions {
                ground_resolution_m: Some(COARSER * rig.height_m / camera.focal_px().0),
                max_pixels: MOSAIC_PIXELS,
            }),
            last_view: None,
            shown_revision: 0,
            frames: Vec::new(),
            references: Vec::new(),
        })
    }

    /// Takes the next frame; a difference, where the camera proves to be another.
    fn next(&mut self, picture: Picture, time_s: f64, camera: &Camera) -> Result<Option<CameraDifference>> {
        let frame = self.odometry.process(picture.gray.clone(), time_s)?;
        if let Some(difference) = self.monitor.watch(&frame, &self.odometry) {
            return Ok(Some(difference));
        }
        for event in self.odometry.take_keyframe_events() {
            if let (KeyframeEvent::Made(new), Some(chroma)) = (&event, &picture.chroma)
                && new.frame == frame.frame
            {
                self.colors.insert(new.frame, chroma.clone());
            }
            self.mapper.take(event, None, &mut self.images)?;
        }
        if let Some(pose) = frame.ground_pose() {
            if self.mosaic.wants(camera, &pose) {
                add(&mut self.mosaic, camera, &pose, &picture);
            }
            self.last_view = Some(picture);
        }
        self.references.push(self.odometry.reference());
        self.frames.push(frame);
        Ok(None)
    }

    /// Brings the frames into the frame of the finished map, and renders the mosaic there.
    fn close_loops(&mut self, camera: &Camera) -> Result<()> {
        self.mapper.finish();
        self.frames = map_frames(&self.mapper, &self.frames, &self.references);
        self.mosaic = Mosaic::new(MosaicOptions { max_pixels: MOSAIC_PIXELS, ..MosaicOptions::default() });
        self.shown_revision = 0;
        for keyframe in &self.mapper.map().keyframes {
            let gray = self.images.load(keyframe.id)?.gray;
            let chroma = self.colors.get(&keyframe.frame).cloned();
            add(&mut self.mosaic, camera, &keyframe.pose, &Picture { gray, chroma });
        }
        let last = self.frames.iter().rev().find_map(FrameEstimate::ground_pose);
        if let (Some(picture), Some(pose)) = (&self.last_view, last) {
            add(&mut self.mosaic, camera, &pose, picture);
        }
        Ok(())
    }

    fn first_time_s(&self) -> f64 {
        self.frames.first().map_or(0.0, |frame| frame.time_s)
    }

    /// The record of the last frame; NaN before the first.
    fn last_record(&self) -> [f32; RECORD] {
        let record = |frame| TrackRecord::new(frame, self.first_time_s(), None).values;
        self.frames.last().map_or([f32::NAN; RECORD], record)
    }
}

fn add(mosaic: &mut Mosaic, camera: &Camera, pose: &GroundPose, picture: &Picture) {
    match &picture.chroma {
        Some(chroma) => mosaic.add(&chroma.rgb(&picture.gray), camera, pose),
        None => mosaic.add(&picture.gray, camera, pose),
    };
}
