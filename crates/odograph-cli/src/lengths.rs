//! Lengths on the command line: a number of metres, or a number with its unit.

use crate::console;
use odograph::formats::length;
use odograph_session::doubtful_unit;

/// A length in metres: `0.9`, `0.9m`, `90cm`, `900mm`, `3ft`, `35in`.
pub fn metres(text: &str) -> Result<f64, String> {
    parse(text).map(|(metres, _)| metres)
}

/// Two lengths in metres. A unit behind the second is that of both; one behind the first alone says
/// nothing certain about the second.
pub fn pair(first: &str, second: &str) -> Option<(f64, f64)> {
    let ((first_m, first_has_unit), (second_m, second_has_unit)) = (parse(first).ok()?, parse(second).ok()?);
    match (first_has_unit, second_has_unit) {
        (false, true) => {
            let unit = second.trim().trim_start_matches(|c: char| !c.is_ascii_alphabetic());
            Some((metres(&format!("{first}{unit}")).ok()?, second_m))
        }
        (true, false) => None,
        _ => Some((first_m, second_m)),
    }
}

/// A length in a unit of this many metres; a bare number is in that unit already.
pub fn in_unit(text: &str, unit_m: f64) -> Result<f64, String> {
    parse(text).map(|(number, has_unit)| if has_unit { number / unit_m } else { number })
}

/// A length of at least zero that must have its unit, in metres: `5mm`.
pub fn with_unit(text: &str) -> Result<f64, String> {
    let wrong = || format!("`{text}` is not a length with its unit, such as 5mm");
    match parse(text) {
        Ok((metres, true)) if metres.is_finite() && metres >= 0.0 => Ok(metres),
        _ => Err(wrong()),
    }
}

/// Height of a camera above the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Height {
    pub metres: f64,
    /// Whether the unit was written.
    has_unit: bool,
}

/// A height as [`metres`] reads it; its range is checked with the rig.
pub fn height(text: &str) -> Result<Height, String> {
    let (metres, has_unit) = parse(text)?;
    Ok(Height { metres, has_unit })
}

impl Height {
    /// A height that is certainly meant in metres.
    pub fn in_metres(metres: f64) -> Self {
        Self { metres, has_unit: true }
    }

    /// A question about a height that was probably meant in another unit.
    fn doubt(self) -> Option<String> {
        let Self { metres, has_unit } = self;
        doubtful_unit(metres).filter(|_| !has_unit).map(|(unit, name)| {
            format!(
                "--height {metres} is read as {metres} metres; if {name} are meant, write {metres}{unit} \
                 ({metres}m silences this)"
            )
        })
    }

    /// Asks it.
    pub fn question(self) {
        if let Some(doubt) = self.doubt() {
            console::warn(&doubt);
        }
    }
}

/// A length as it was typed, with how far it may have been rounded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Typed {
    pub metres: f64,
    /// Standard deviation of the rounding to the last digit that was typed.
    pub rounding_m: f64,
}

/// A length as [`metres`] reads it, and what its digits say: 6.2 is known less well than 6.20.
pub fn typed(text: &str) -> Result<Typed, String> {
    let metres = metres(text)?;
    let number = text.trim().trim_end_matches(|c: char| c.is_ascii_alphabetic() || c.is_whitespace());
    let decimals = number.split_once('.').map_or(0, |(_, decimals)| decimals.len());
    let unit_m = number.parse::<f64>().ok().filter(|number| *number != 0.0).map_or(1.0, |n| metres / n);
    let last_digit_m = unit_m.abs() * 10_f64.powi(-i32::try_from(decimals).unwrap_or(i32::MAX));
    // Rounding is spread evenly over one unit of the last digit.
    Ok(Typed { metres, rounding_m: last_digit_m / 12_f64.sqrt() })
}

/// A length in metres, and whether its unit was written.
fn parse(text: &str) -> Result<(f64, bool), String> {
    length::parse(text).ok_or_else(|| match text.replace(',', ".") {
        point if point != text && length::parse(&point).is_some() => {
            format!("write it with a decimal point, {point}")
        }
        _ => "give a length as 0.9 (metres), 0.9m, 90cm, 900mm, 3ft or 35in".to_owned(),
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    #[test]
    fn lengths_have_units_or_are_metres() {
        for (text, expected_m) in
            [("0.9", 0.9), ("90cm", 0.9), ("0.9m", 0.9), ("900 mm", 0.9), ("3ft", 0.9144), ("-1", -1.0)]
        {
            assert!((metres(text).unwrap() - expected_m).abs() < 1e-12, "{text}");
        }
        for text in ["", "cm", "1.2.3", "ninety", "9 0", "1km", "1e"] {
            assert!(metres(text).unwrap_err().contains("90cm"), "{text}");
        }
        assert!(metres("0,9m").unwrap_err().contains("decimal point, 0.9m"));
        assert!(metres("1,2,3").unwrap_err().contains("90cm"));
        assert_eq!(in_unit("7", 1e-2), Ok(7.0));
        for (text, last_digit_m) in [("6.2", 0.1), ("6.20", 0.01), ("620cm", 0.01), ("12", 1.0)] {
            let rounding_m = typed(text).unwrap().rounding_m;
            assert!((rounding_m * 12_f64.sqrt() - last_digit_m).abs() < 1e-12, "{text}: {rounding_m}");
        }
        assert_eq!(in_unit("1cm", 1e-3), Ok(10.0));
        assert_eq!(with_unit("5mm"), Ok(5e-3));
        assert_eq!(pair("25", "19mm"), Some((0.025, 0.019)));
        assert_eq!(pair("120cm", "0.9m"), Some((1.2, 0.9)));
        assert_eq!((pair("1.2", "0.9"), pair("120cm", "90")), (Some((1.2, 0.9)), None));
        for text in ["5", "-5mm", "nanmm", "mm"] {
            assert!(with_unit(text).unwrap_err().contains("with its unit"), "{text}");
        }
    }

    #[test]
    fn a_bare_height_above_ten_metres_is_questioned() {
        for (text, likely) in [("90", "write 90cm"), ("900", "write 900mm"), ("12.5", "write 12.5cm")] {
            assert!(height(text).unwrap().doubt().unwrap().contains(likely), "{text}");
        }
        for text in ["90m", "90cm", "1.2", "10"] {
            assert_eq!(height(text).unwrap().doubt(), None, "{text}");
        }
    }
}
