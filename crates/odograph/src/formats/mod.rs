//! Text to values and back: camera files, rig files, sensor records and trajectories.
//!
//! Nothing here opens a file: every reader takes the text and every writer returns it. Readers accept any text without
//! panicking, in time and memory proportional to its length, and say in one sentence what is wrong with it.

pub mod calibration_file;
pub mod camera_file;
pub mod rig_file;
pub mod sensor_file;
pub mod trajectory_file;
