//! Text formats: camera, calibration, control, rig, sensor, GNSS and trajectory files; and the
//! record of a frame for pages.
//!
//! Nothing here opens a file: readers take text, writers return it. Readers accept any text without
//! panicking, in time and memory proportional to its length, and report errors in one sentence.

pub mod decimal;
mod columns;
pub mod camera_file;
pub mod control_file;
pub mod geojson;
pub mod gnss_file;
pub mod length;
pub mod rig_file;
pub mod sensor_file;
pub mod track_record;
pub mod trajectory_file;
