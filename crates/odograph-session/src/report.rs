//! Contents of a run's report, and the trait that renders it.

use crate::place::PoseInMap;
use crate::reference::ComparedReference;
use crate::resemblance::AlikePlace;
use odograph::camera::{Camera, Rig};
use odograph::drawing::{DrawnLandmark, ReckonedStretch};
use odograph::error::Result;
use odograph::filter::fusion::SensorReport;
use odograph::geometry::{GroundPoint, Placement};
use odograph::image::RgbImage;
use odograph::mosaic::MosaicPicture;
use odograph::odometry::TrackView;
use odograph::trajectory::{FrameEstimate, FrameSummary};
use odograph_video::Frame;

/// Renders `map.png` and `report.html`.
///
/// A run without a reporter writes neither. The crate `odograph-report` has the program's one; it
/// needs a text and drawing stack that users of poses should not have to build.
pub trait RunReporter: Send + Sync {
    /// The drawing of the map, an SVG document, as the bytes of a PNG file.
    ///
    /// # Errors
    /// If it cannot be drawn.
    fn map_png(&self, svg: &str) -> Result<Vec<u8>>;

    /// The report as one HTML file.
    fn page(&self, contents: &ReportInput<'_>) -> String;

    /// What draws the frames of an overlay video of this camera; `None` without such.
    fn frame_painter(&self, camera: &Camera) -> Option<Box<dyn FramePainter>> {
        let _ = camera;
        None
    }
}

/// Draws the frames of an overlay video, in their order.
pub trait FramePainter: Send {
    /// Width and height of every picture, pixels.
    fn size(&self) -> (usize, usize);

    /// The picture of a frame.
    fn paint(&mut self, frame: &OverlayFrame<'_>) -> RgbImage;
}

/// A frame of a run as it was tracked, before loops and other sensors.
#[derive(Debug, Clone, Copy)]
pub struct OverlayFrame<'a> {
    /// The image.
    pub image: &'a Frame,
    /// The estimate of the camera, in the odometry frame.
    pub camera: &'a FrameEstimate,
    /// The same of the frame whose poses the run writes: the camera's or the robot's.
    pub written: &'a FrameEstimate,
    /// The tracked corners.
    pub tracks: &'a [TrackView],
}

/// Contents of the report of a run.
#[derive(Debug, Clone, Copy)]
pub struct ReportInput<'a> {
    /// Name of the run, e.g. that of the recording; any text.
    pub title: &'a str,
    /// Description of the source: file, size, frame rate; any text.
    pub source: &'a str,
    /// All frames of the run, in order of time.
    pub frames: &'a [FrameSummary],
    /// The path by other sensors where the camera was lost.
    pub reckoned: &'a [ReckonedStretch],
    /// How far an interrupted run got, or a live run that was stopped before its recording ended,
    /// e.g. "interrupted after 3 of 5 frames"; `None` if it is complete.
    pub interruption: Option<&'a str>,
    /// The camera that was used.
    pub camera: &'a Camera,
    /// The initial mount of the camera over the ground.
    pub rig: &'a Rig,
    /// The map, drawn by [`MapDrawing::svg`](odograph::drawing::MapDrawing::svg).
    pub map_svg: &'a str,
    /// Positions of the camera at the keyframes of the run, metres.
    pub keyframes: &'a [GroundPoint],
    /// Loop closures: the two positions of the camera from which the same ground was seen.
    pub loops: &'a [[GroundPoint; 2]],
    /// Markers on the ground.
    pub landmarks: &'a [DrawnLandmark],
    /// Marks set during a live run.
    pub marks: &'a [ReportMark],
    /// The orthophoto mosaic of the ground, if there is one.
    pub mosaic: Option<ReportMosaic<'a>>,
    /// All parameters used, in the format of `run.toml`.
    pub run_toml: &'a str,
    /// Names of the files in the folder of the report.
    pub files: &'a [&'a str],
    /// Warnings about the input; sentences.
    pub warnings: &'a [String],
    /// Results of the sensors other than the camera.
    pub sensors: &'a [SensorReport],
    /// The comparison with a reference trajectory, if one was given.
    pub reference: Option<&'a ComparedReference>,
    /// What was found in a map, if the run looked for its place there.
    pub localization: Option<ReportLocalization<'a>>,
}

/// Where a picture or a recording is in a map.
#[derive(Debug, Clone, Copy)]
pub struct ReportLocalization<'a> {
    /// The place; `None` if none is certain.
    pub place: Option<&'a PoseInMap>,
    /// Why no place is certain, a sentence; empty if one is.
    pub reason: &'a str,
    /// The possible places if none is certain, the most probable first.
    pub alike: &'a [AlikePlace],
    /// The mosaic of the map, if it has one.
    pub ground: Option<&'a MosaicPicture>,
}

/// The mosaic as displayed in the report.
#[derive(Debug, Clone, Copy)]
pub struct ReportMosaic<'a> {
    /// The mosaic, downscaled to what a page needs.
    pub picture: &'a MosaicPicture,
    /// Georeference of the full-resolution mosaic.
    pub placement: Placement,
    /// File name of the full-resolution mosaic.
    pub file_name: &'a str,
}

/// A mark that the user set during a live run.
#[derive(Debug, Clone, PartialEq)]
pub struct ReportMark {
    /// Name given by the user, or the mark's number; any text.
    pub name: String,
    /// Time since the first frame, seconds.
    pub time_s: f64,
}
