//! # odograph-video
//!
//! Decodes recordings, image folders and streams to timestamped gray frames.
//!
//! [`open`] detects the format from the content (the first bytes, not the name) and returns a
//! [`Source`], which yields one [`Frame`] after another. The gray image is the luminance plane of
//! the decoded video, without colour conversion and without a copy. Timestamps come from the
//! container, never from counting frames.
//!
//! Decoded in this crate, without any system package: image folders (PNG, JPEG, TIFF, PGM, PPM),
//! MP4/MOV/MKV with H.264 and HEVC, AVI/MOV with Motion JPEG, VP9 in WebM/MKV/MP4, raw H.264 and
//! HEVC streams, Y4M from a file or standard input; robot recordings (MCAP, rosbag2, ROS 1 bags)
//! with raw or compressed images. Everything else is decoded by an installed
//! `ffmpeg`, in bounded memory; without one, [`open`] fails with a message that names the codec.
//!
//! [`AviWriter`] writes Motion JPEG, the one video that needs no encoder of its own.
//!
//! All input is untrusted: sizes are bounded before memory is allocated, and a panic inside a
//! third-party decoder becomes an [`Error`](odograph::error::Error).
//!
//! ```no_run
//! let mut source = odograph_video::open("drive.mp4", &odograph_video::SourceOptions::default())?;
//! while let Some(frame) = source.next_frame()? {
//!     let (width, height) = (frame.gray.width(), frame.gray.height());
//!     println!("{} {:.3} s {width}x{height}", frame.number, frame.time_s);
//! }
//! # Ok::<(), odograph::error::Error>(())
//! ```

mod limits;
mod file_error;
mod record_file;
mod regular_file;
mod pipe;
mod temporary;
mod guard;
mod foreign_file;
mod frame;
mod nal;
mod source_options;
mod opened;
mod time_order;
mod arrival_clock;
mod recorded_camera;
mod contents;
mod rotation;
mod codec;
mod bayer;
mod samples;
mod timestamps;
mod pictures;
mod y4m;
mod container;
mod ffmpeg;
mod video;
mod bag;
mod source;
mod inspection;
mod avi_writer;
mod encode;

pub use arrival_clock::ArrivalClock;
pub use avi_writer::{AviFormat, AviWriter};
pub use bag::{
    LiveMessage, LiveTopic, LiveTransforms, MessageCursor, RecordedMount, RecordedTransforms,
    is_recording_folder, is_robot_recording, recorded_antenna, recorded_camera, recorded_fixes,
    recorded_mount, recorded_path, recorded_sensor,
};
pub use bayer::BayerPattern;
#[cfg(fuzzing)]
pub use codec::read_parameter_sets;
pub use contents::{Contents, Gap, Stream, StreamUse};
pub use encode::{
    jpeg_from_gray, jpeg_from_rgb, png_from_gray, png_from_rgb, png_from_rgb_samples, png_from_rgba,
    png_from_rgba_bands, png_to_print,
};
pub use frame::{Frame, Picture};
pub use inspection::inspect;
pub use pictures::picture_fixes;
pub use pipe::end_waiting;
pub use recorded_camera::RecordedCamera;
pub use regular_file::{check_regular_file, read_regular_file};
pub use samples::SampleLayout;
pub use source::{Source, SourceInfo, is_stream, open, open_picture};
pub use source_options::SourceOptions;
pub use temporary::TemporaryFolder;
