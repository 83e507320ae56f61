//! # odograph-video
//!
//! Recordings, picture folders and streams as gray frames with timestamps.
//!
//! [`open`] looks at what a file or folder *is* (its first bytes, not its name) and gives a [`Source`]; the source gives one
//! [`Frame`] after another. A frame's gray image is the luminance plane of the decoded video as it stands: no colour
//! conversion and no copy. Timestamps come from the container, never from counting frames.
//!
//! Decoded in this crate, without any system package: picture folders (PNG, JPEG, TIFF, PGM, PPM), MP4/MOV/MKV with H.264
//! and HEVC, AVI/MOV with Motion JPEG, VP9 in WebM/MKV/MP4, raw H.264 and HEVC streams, Y4M from a file or standard input.
//! Everything else goes through an installed `ffmpeg`, where there is one, in bounded memory; otherwise it ends in one
//! sentence that names the codec.
//!
//! All input is untrusted: sizes are bounded before memory is asked for, and a panic inside a decoder of a third party
//! becomes an [`Error`](odograph::error::Error).
//!
//! ```no_run
//! let mut source = odograph_video::open("drive.mp4", &odograph_video::SourceOptions::default())?;
//! while let Some(frame) = source.next_frame()? {
//!     println!("{} {:.3} s {}x{}", frame.number, frame.time_s, frame.gray.width(), frame.gray.height());
//! }
//! # Ok::<(), odograph::error::Error>(())
//! ```

mod limits;
mod guard;
mod frame;
mod robot_recording;
mod rotation;
mod codec;
mod samples;
mod timestamps;
mod pictures;
mod y4m;
mod container;
mod ffmpeg;
mod video;
mod source;

pub use frame::{Frame, Picture};
pub use samples::SampleLayout;
pub use source::{Source, SourceInfo, SourceOptions, is_stream, open};
