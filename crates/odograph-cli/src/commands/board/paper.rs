//! Sizes of paper.

use odograph::error::{Error, Result};
use std::fmt;
use std::str::FromStr;

/// A sheet of paper, in portrait or landscape orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paper {
    /// Its name, if it has one.
    name: Option<&'static str>,
    /// Width, millimetres.
    pub width_mm: f64,
    /// Height, millimetres.
    pub height_mm: f64,
}

/// Name, width and height in millimetres: ISO 216 and the North American sizes.
const NAMED: [(&str, f64, f64); 9] = [
    ("A5", 148.0, 210.0),
    ("A4", 210.0, 297.0),
    ("A3", 297.0, 420.0),
    ("A2", 420.0, 594.0),
    ("A1", 594.0, 841.0),
    ("A0", 841.0, 1189.0),
    ("letter", 215.9, 279.4),
    ("legal", 215.9, 355.6),
    ("tabloid", 279.4, 431.8),
];

/// Shortest and longest side that is accepted; a page of a PDF is at most 5080 mm long.
const SIDES_MM: std::ops::RangeInclusive<f64> = 40.0..=5000.0;

impl Paper {
    /// Paper of a board if none is given, the smallest first: no common printer
    /// holds A5 by default.
    pub fn usual() -> impl Iterator<Item = Self> {
        NAMED.iter().filter(|(name, ..)| ["A4", "A3", "A2", "A1", "A0"].contains(name)).map(Self::named)
    }

    fn named((name, width_mm, height_mm): &(&'static str, f64, f64)) -> Self {
        Self { name: Some(*name), width_mm: *width_mm, height_mm: *height_mm }
    }

    /// Turned by a quarter.
    pub fn across(self) -> Self {
        Self { width_mm: self.height_mm, height_mm: self.width_mm, ..self }
    }

    /// What to write after `--paper` for it.
    pub fn argument(&self) -> String {
        match self.name {
            Some(name) => name.to_ascii_lowercase(),
            None => format!("{}x{}mm", self.width_mm, self.height_mm),
        }
    }
}

impl fmt::Display for Paper {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, width_mm, height_mm } = self;
        match name {
            Some(name) => write!(f, "{name} paper ({width_mm} x {height_mm} mm)"),
            None => write!(f, "paper of {width_mm} x {height_mm} mm"),
        }
    }
}

impl FromStr for Paper {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if let Some(named) = NAMED.iter().find(|(name, ..)| name.eq_ignore_ascii_case(text)) {
            return Ok(Self::named(named));
        }
        let sides = text.strip_suffix("mm").and_then(|sides| sides.split_once('x'));
        let side = |text: &str| text.trim().parse().ok().filter(|side| SIDES_MM.contains(side));
        match sides.and_then(|(width, height)| Some((side(width)?, side(height)?))) {
            Some((width_mm, height_mm)) => Ok(Self { name: None, width_mm, height_mm }),
            None => Err(Error::usage(format!(
                "`{text}` is no paper; there are {} and sizes such as 500x700mm with sides of {} to {} mm",
                NAMED.map(|(name, ..)| name.to_ascii_lowercase()).join(", "),
                SIDES_MM.start(),
                SIDES_MM.end(),
            ))),
        }
    }
}
