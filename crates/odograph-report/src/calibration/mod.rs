//! The report of a calibration: the page and its drawings as images.

mod drawing;
mod lens;
mod page;
mod thumbnail;
mod views;

pub use lens::{ExpectedError, pixels_text};
pub use page::{BentBoard, BoardDetections, CalibrationReport, lens_name};
pub use thumbnail::Thumbnail;
pub use views::{ReprojectionError, ShownView};

/// Style rules in addition to those of all pages.
const STYLE: &str = include_str!("style.css");

#[cfg(test)]
mod tests;
