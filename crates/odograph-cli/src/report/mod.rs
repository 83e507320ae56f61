//! What a person looks at after a run: the map as a picture and the report page.

mod charts;
mod figures;
mod page;
mod plot;
mod raster;

pub use page::{ReportInput, ReportMosaic, html};
pub use raster::{MAP_WIDTH_PX, gray_picture, map_png};

#[cfg(test)]
mod tests;
