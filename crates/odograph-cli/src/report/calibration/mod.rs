//! What a person looks at after a calibration: the report page, and its drawings as pictures.

mod drawing;
mod lens;
mod page;
mod views;

pub use lens::{ExpectedError, pixels_text};
pub use page::{CalibrationReport, Found, lens_name};
pub use views::{Residual, ShownView};

/// What its page adds to the style sheet of every page.
const STYLE: &str = include_str!("style.css");

#[cfg(test)]
mod tests;
