//! One module per command.

pub mod board;
pub mod calibrate;
pub mod camera;
pub mod cameras;
pub mod completions;
pub mod demo;
pub mod doctor;
pub mod evaluate;
mod frame_selection;
pub mod ground;
pub mod info;
pub mod live;
pub mod localize;
pub mod map;
pub mod profile;
pub mod run;
pub mod simulate;
pub mod site;
pub mod undistort;
pub mod view;
