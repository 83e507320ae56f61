//! Single markers of one family and size, as they lie on a floor.

use super::Dictionary;
use super::board::length_m;
use super::dictionary::bit;
use odograph::error::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// Square markers of one dictionary and one size.
///
/// The text form is a family, a dictionary and the side of the black square with its unit:
/// `apriltag:36h11:80mm`, `aruco:4x4_50:10cm`. Around a marker is a white margin of at least one
/// bit. AprilTags are upright as published, ArUco markers as OpenCV draws them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarkerFamily {
    dictionary: Dictionary,
    side_m: f64,
}

/// Sides of usable markers, metres.
const SIDES_M: std::ops::RangeInclusive<f64> = 0.002..=10.0;

impl MarkerFamily {
    /// Markers of this dictionary whose black square has this side, metres.
    ///
    /// # Errors
    /// If the side is not between 2 mm and 10 m.
    pub fn new(dictionary: Dictionary, side_m: f64) -> Result<Self> {
        if !SIDES_M.contains(&side_m) {
            return Err(Error::usage(format!(
                "a marker with a side of {side_m} m is not usable; the side of its black square is between 2 mm and 10 m"
            )));
        }
        Ok(Self { dictionary, side_m })
    }

    /// The dictionary.
    pub fn dictionary(&self) -> Dictionary {
        self.dictionary
    }

    /// Family and dictionary without the side, such as `apriltag:36h11`.
    pub fn name(&self) -> String {
        let (family, name) = Self::names(self.dictionary);
        format!("{family}:{name}")
    }

    /// Side of the black square, metres.
    pub fn side_m(&self) -> f64 {
        self.side_m
    }

    /// Number of different markers.
    pub fn markers(&self) -> usize {
        self.dictionary.markers()
    }

    /// Width of the black border in bits of the marker, and of the white margin around it.
    pub const BORDER_BITS: usize = 1;

    /// Number of bits along a side, with the border.
    pub fn cells(&self) -> usize {
        self.dictionary.bits_per_side() + 2 * Self::BORDER_BITS
    }

    /// The bits of a marker as printed upright, in the order of [`Dictionary::marker`]; `None` for
    /// a number that the family does not have.
    pub fn bits(&self, number: usize) -> Option<u64> {
        let bits = self.dictionary.marker(number)?;
        // The dictionary has OpenCV's orientation, rotated by 180° against the publication.
        let half_turn = self.dictionary == Dictionary::AprilTag36h11;
        Some(if half_turn { self.dictionary.turned(bits, 2) } else { bits })
    }

    /// Whether a printed marker is black at a point of its plane, in sides from its top left
    /// corner, x to the right and y down; false on the margin and for an unknown number.
    pub fn is_black(&self, number: usize, x: f64, y: f64) -> bool {
        let (cells, side) = (self.cells() as f64, self.dictionary.bits_per_side());
        let inside = (0.0..1.0).contains(&x) && (0.0..1.0).contains(&y);
        let Some(bits) = self.bits(number).filter(|_| inside) else { return false };
        let cell = |at: f64| ((at * cells) as usize).checked_sub(Self::BORDER_BITS).filter(|at| *at < side);
        match (cell(x), cell(y)) {
            (Some(column), Some(row)) => bit(bits, side, column, row) == 0,
            _ => true,
        }
    }

    /// Name of the family and of the dictionary in the text form.
    fn names(dictionary: Dictionary) -> (&'static str, &'static str) {
        let name = dictionary.name();
        name.strip_prefix("apriltag_").map_or(("aruco", name), |name| ("apriltag", name))
    }
}

impl FromStr for MarkerFamily {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let refuse = |why: String| {
            Error::usage(format!(
                "markers `{text}`: {why}; write them like apriltag:36h11:80mm or aruco:4x4_50:10cm"
            ))
        };
        let parts: Vec<&str> = text.trim().split(':').collect();
        let &[family, name, side] = parts.as_slice() else {
            return Err(refuse("they need a family, a dictionary and the side of a marker".to_owned()));
        };
        let known = Dictionary::NAMED.iter().map(|(_, dictionary)| (*dictionary, Self::names(*dictionary)));
        let found = known
            .clone()
            .find(|(_, names)| names.0.eq_ignore_ascii_case(family) && names.1.eq_ignore_ascii_case(name));
        let (dictionary, _) = found.ok_or_else(|| {
            let all: Vec<String> = known.map(|(_, (family, name))| format!("{family}:{name}")).collect();
            refuse(format!("there is no family `{family}:{name}` (there are {})", all.join(", ")))
        })?;
        let side_m = length_m(side).map_err(|error| refuse(error.to_string()))?;
        Self::new(dictionary, side_m).map_err(|error| error.at(format!("markers `{text}`")))
    }
}

impl fmt::Display for MarkerFamily {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}mm", self.name(), (self.side_m * 1e6).round() / 1e3)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    #[test]
    fn families_are_read_and_written() {
        for (text, dictionary, side_m) in [
            ("apriltag:36h11:80mm", Dictionary::AprilTag36h11, 0.08),
            ("aruco:4x4_50:100mm", Dictionary::Aruco4x4_50, 0.1),
        ] {
            let family: MarkerFamily = text.parse().unwrap();
            assert_eq!((family.dictionary(), family.side_m()), (dictionary, side_m));
            assert_eq!(family.to_string(), text);
        }
    }

    #[test]
    fn what_is_no_family_is_refused_in_one_sentence() {
        for (text, part) in [
            ("apriltag:36h11", "a family, a dictionary and the side"),
            ("apriltag:25h9:80mm", "there is no family `apriltag:25h9`"),
            ("aruco:4x4_50:80", "is not a length with its unit"),
            ("aruco:4x4_50:-8mm", "is not a positive length"),
            ("aruco:4x4_50:1mm", "between 2 mm and 10 m"),
        ] {
            let error = text.parse::<MarkerFamily>().unwrap_err().to_string();
            assert!(error.contains(part) && !error.contains('\n'), "{error}");
        }
    }

    #[test]
    fn a_printed_marker_has_a_black_border_and_its_bits() {
        let family: MarkerFamily = "aruco:4x4_50:60mm".parse().unwrap();
        // The first row of marker 0 is 1011: white, black, white, white.
        let row: Vec<bool> =
            (0..6).map(|cell| family.is_black(0, (f64::from(cell) + 0.5) / 6.0, 0.25)).collect();
        assert_eq!(row, [true, false, true, false, false, true]);
        assert!(
            family.is_black(0, 0.01, 0.99)
                && !family.is_black(0, -0.01, 0.5)
                && !family.is_black(50, 0.5, 0.5)
        );
    }
}
