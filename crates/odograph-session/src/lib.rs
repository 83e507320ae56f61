//! # odograph-session
//!
//! A whole run as a library: recording or camera in; trajectory, map, mosaic and statistics out.
//!
//! A [`RunBuilder`] says what is to be run, [`RunBuilder::run`] runs it, and a [`RunOutcome`] is
//! what it gives:
//!
//! ```no_run
//! use odograph_session::{RunBuilder, RunEnd};
//!
//! let outcome = RunBuilder::new("drive.mp4")
//!     .camera_file("camera.yaml")
//!     .height_m(1.20)
//!     .folder("drive")
//!     .run(&())?;
//! match outcome.end {
//!     RunEnd::Completed => println!("{:.2} m", outcome.statistics.distance_m),
//!     RunEnd::Interrupted => println!("stopped after {} frames", outcome.statistics.frames),
//!     RunEnd::TrackingFailed => println!("most frames have no pose"),
//! }
//! for frame in &outcome.trajectory {
//!     if let Some(at) = &frame.place {
//!         println!("{:.3} {:.4} {:.4} {:.4}", frame.time_s, at.x_m, at.y_m, at.heading_rad);
//!     }
//! }
//! # Ok::<(), odograph::Error>(())
//! ```
//!
//! | to | use |
//! |---|---|
//! | show progress, or stop a run | an [`Observer`] in place of `()` |
//! | look at the source before running | [`RunBuilder::open`], then [`Run::follow`] |
//! | continue a map | [`RunBuilder::map`] with [`MapUse::Continue`], or `Extend` |
//! | find a picture in a map | [`RunBuilder::localizing`] |
//! | use markers, or be in their frame | [`RunBuilder::markers`], [`RunBuilder::control`] |
//! | use a gyroscope, compass, wheel or range finder | [`RunBuilder::sensors`] |
//! | run again exactly | [`RunBuilder::repeating`] with the folder's `run.toml` |
//! | follow a camera as it moves | the feature `live`, then `RunBuilder::open_live` |
//! | know what will limit the accuracy, before a run | [`RunBuilder::examine`] |
//! | run many recordings, on many machines | [`batch::Batch`] |
//! | have an overlay video | [`RunBuilder::video`] |
//! | have `report.html` and `map.png` | [`RunBuilder::reporter`] with `odograph-report` |
//!
//! The modules are listed in the order of their dependencies: a module imports only modules listed
//! above it.
//!
//! A run decodes, tracks and maps on threads of its own, keeps its frames on disk, and has every
//! result of the last second in its folder even if the process is killed. Same input, same bytes,
//! for any number of threads. This crate prints nothing; errors are [`odograph::Error`]s, one
//! sentence for people with their cause as [`source`](std::error::Error::source).

mod observer;
pub mod files;
mod trajectory_input;
mod rig;
pub mod ros_messages;
mod ros_bag;
mod mask;
mod sensors;
mod budget;
mod timings;
mod kept_frames;
mod growing_table;
mod half_session;
mod output;
mod plan;
mod plan_paths;
mod begun_run;
mod unfinished;
mod reference;
mod place;
mod other_scale;
mod resemblance;
mod report;
mod overlay_video;
mod builder;
mod pixel_shape;
mod resuming;
mod markers;
mod marker_statistics;
mod planning;
mod found;
mod recalibrated_odometry;
mod tilt;
mod stillness;
mod earth_statistics;
mod statistics;
mod folder;
mod earth;
mod found_rig;
mod wheel_scale;
mod outcome;
mod growing_map_file;
mod mapping;
mod views;
mod pictures;
mod pipeline;
mod passes;
mod finish;
mod separate_outputs;
mod run;
pub mod batch;
mod doctor;
#[cfg(feature = "live")]
pub mod live;

pub use budget::Budget;
pub use builder::RunBuilder;
pub use doctor::{Diagnosis, ExaminedFrame, Finding, Judgement};
pub use earth_statistics::{EarthStatistics, GnssOutlier, GnssStatistics};
pub use folder::RUN_FILES;
pub use found::{FixedInImage, FoundCoefficient, FoundLens, FoundMount, FoundReadout};
pub use mapping::other_height;
pub use marker_statistics::{LandmarkStatistics, MarkerStatistics};
pub use observer::Observer;
pub use other_scale::OtherScale;
pub use outcome::{RunEnd, RunOutcome};
pub use output::MapUse;
pub use place::PoseInMap;
pub use plan::{FrameChoice, MarkerPlan, RunPlan, SourcePlan, check_recording, open_recording};
pub use reference::ComparedReference;
pub use report::{
    FramePainter, OverlayFrame, ReportInput, ReportLocalization, ReportMark, ReportMosaic, RunReporter,
};
pub use resemblance::{AlikePlace, Resemblance, ResemblanceVerdict};
pub use rig::{doubtful_unit, other_size, parse_camera, read_rig, rig_of_mount};
pub use run::Run;
pub use sensors::SensorFiles;
pub use statistics::{BudgetStatistics, LiveStatistics, LoopStatistics, RunStatistics, SensorStatistics};
pub use timings::StageTime;
pub use trajectory_input::{LoadedTrajectory, read_trajectory, read_trajectory_text};
pub use unfinished::UnfinishedRun;
