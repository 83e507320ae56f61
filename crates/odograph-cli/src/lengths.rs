//! Lengths on the command line: a number of metres, or a number with its unit.

use crate::console;

/// Units and how many metres they are; of two that end alike the longer comes first.
const UNITS: [(&str, f64); 5] = [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("ft", 0.3048), ("in", 0.0254)];

/// A camera on a vehicle is not higher: above this a number without a unit may have been meant as
/// centimetres.
const DOUBTFUL_HEIGHT_M: f64 = 30.0;

/// No camera looks at the ground from higher.
const GREATEST_HEIGHT_M: f64 = 1e6;

/// A length in metres: `0.9`, `0.9m`, `90cm`, `900mm`, `3ft`, `35in`.
pub fn metres(text: &str) -> Result<f64, String> {
    parse(text).map(|(metres, _)| metres)
}

/// Height of a camera above the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Height {
    pub metres: f64,
    /// Whether the unit was written.
    has_unit: bool,
}

/// A height as [`metres`] reads it.
pub fn height(text: &str) -> Result<Height, String> {
    let (metres, has_unit) = parse(text)?;
    // What is no number is told with the rig.
    if metres.is_finite() && metres > GREATEST_HEIGHT_M {
        return Err(format!("a height of {metres} m is more than any camera over ground has"));
    }
    Ok(Height { metres, has_unit })
}

impl Height {
    /// What to say of a height that may have been meant in another unit.
    fn doubt(self) -> Option<String> {
        let Self { metres, has_unit } = self;
        (metres.is_finite() && metres > DOUBTFUL_HEIGHT_M && !has_unit).then(|| {
            format!(
                "note: height of {metres} m: taken as metres; if centimetres were meant write {metres}cm, if not {metres}m says so"
            )
        })
    }

    /// Tells that.
    pub fn tell_doubt(self) {
        if let Some(doubt) = self.doubt() {
            console::complain(&doubt);
        }
    }
}

fn parse(text: &str) -> Result<(f64, bool), String> {
    let text = text.trim();
    let unit = UNITS.iter().find_map(|(unit, metres)| Some((text.strip_suffix(unit)?, *metres)));
    let (number, in_metres) = unit.unwrap_or((text, 1.0));
    match number.trim_end().parse::<f64>() {
        Ok(number) => Ok((number * in_metres, unit.is_some())),
        Err(_) => Err("give a length as 0.9 (metres), 0.9m, 90cm, 900mm, 3ft or 35in".to_owned()),
    }
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
    }

    #[test]
    fn only_a_great_height_without_a_unit_is_doubted() {
        assert!(height("90").unwrap().doubt().unwrap().contains("write 90cm"));
        for text in ["90m", "90cm", "1.2", "30"] {
            assert_eq!(height(text).unwrap().doubt(), None, "{text}");
        }
        assert!(height("1e300").is_err());
    }
}
