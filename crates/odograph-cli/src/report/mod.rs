//! Reports of runs and calibrations: pages and images.

pub mod calibration;
mod charts;
mod figures;
mod page;
mod parts;
mod plot;
mod raster;

pub use page::{ReportInput, ReportMosaic, ReportReference, html};
pub use raster::{MAP_WIDTH_PX, drawing_png, gray_picture};

#[cfg(test)]
mod tests;
