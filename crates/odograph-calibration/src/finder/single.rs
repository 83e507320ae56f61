//! Single markers, each by itself, anywhere in an image.

use super::markers::{self, Codes, MarkerLayout};
use crate::MarkerFamily;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// Windows of the adaptive threshold: radius in tiles of 4 pixels, and offset below the local mean
/// in standard deviations. A marker on a white margin needs no narrow one.
const WINDOWS: [(usize, f64); 1] = [(2, 0.35)];

/// Finds the markers of a family in images, each by itself.
///
/// It holds data precomputed for the family. The same image always has the same result.
#[derive(Debug, Clone)]
pub struct MarkerFinder {
    codes: Codes,
}

/// A marker in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenMarker {
    /// Its number in the dictionary.
    pub number: usize,
    /// Corners of the black square, clockwise from the top left as printed, pixels, without
    /// correction of the lens distortion.
    pub corners: [Pixel; 4],
}

impl MarkerFinder {
    /// A finder for a family.
    pub fn new(family: &MarkerFamily) -> Self {
        let bits: Vec<u64> = (0..).map_while(|number| family.bits(number)).collect();
        let side = family.dictionary().bits_per_side();
        let layout = MarkerLayout { bits: side, border: MarkerFamily::BORDER_BITS };
        let margin = MarkerFamily::BORDER_BITS as f64 / family.cells() as f64;
        Self { codes: Codes::new(&bits, vec![layout], margin, &WINDOWS) }
    }

    /// The markers in an image, in the order of their numbers. A number is there more than once if
    /// the image shows it at several places.
    ///
    /// Markers with a side of less than `least_px` pixels are not looked for. The more is known of
    /// their size, the less texture is looked at in vain.
    ///
    /// Accepts images of any size and content. The run time is proportional to the number of
    /// pixels.
    pub fn find(&self, image: &GrayImage, least_px: f64) -> Vec<SeenMarker> {
        let least_px = (least_px as usize).max(markers::MIN_PX);
        let read = markers::find(image, &self.codes, least_px).read;
        let mut seen: Vec<SeenMarker> = Vec::new();
        for marker in read {
            let is_new = seen.iter().all(|other| {
                other.number != marker.id
                    || other.corners[0].distance(marker.corners[0])
                        > 0.5 * marker.corners[0].distance(marker.corners[2])
            });
            if is_new {
                seen.push(SeenMarker { number: marker.id, corners: marker.corners });
            }
        }
        seen.sort_by_key(|marker| marker.number);
        seen
    }
}
