//! Numbers as text: for readers, which parse them to the same value, and for people.

use std::fmt;

/// Shortest decimal representation that round-trips, always with a decimal point and an explicit
/// exponent sign. Without these, YAML 1.1 (Python's reader, hence Kalibr's and ROS's) parses `1e-5`
/// as a string.
pub fn decimal(value: f64) -> String {
    let shortest = format!("{value:?}");
    let Some((mantissa, exponent)) = shortest.split_once('e') else {
        return shortest;
    };
    let point = if mantissa.contains('.') { "" } else { ".0" };
    let sign = if exponent.starts_with('-') { "" } else { "+" };
    format!("{mantissa}{point}e{sign}{exponent}")
}

/// Comma-separated numbers.
pub fn decimals(values: &[f64]) -> String {
    values.iter().map(|&value| decimal(value)).collect::<Vec<_>>().join(", ")
}

/// A number in a text for people, where a negative value that rounds to zero has no sign of its
/// own: `format!("{:.3}", Rounded(-0.0001))` is `0.000`, with `{:+.3}` it is `+0.000`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rounded(pub f64);

impl fmt::Display for Rounded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let is_zero = match f.precision() {
            Some(decimals) => {
                let shown = format!("{:.decimals$}", self.0.abs());
                shown.bytes().all(|byte| matches!(byte, b'0' | b'.'))
            }
            None => self.0 == 0.0,
        };
        fmt::Display::fmt(if is_zero { &0.0 } else { &self.0 }, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_rounds_to_zero_is_not_negative() {
        for value in [-0.0, -0.000_4, 0.0, 0.000_4] {
            assert_eq!(format!("{:.3}", Rounded(value)), "0.000");
            assert_eq!(format!("{:+.2}°", Rounded(value)), "+0.00°");
            assert_eq!(format!("{:8.3}", Rounded(value)), "   0.000");
        }
        assert_eq!(format!("{} {:.0}", Rounded(-0.0), Rounded(-0.4)), "0 0");
        assert_eq!(format!("{:.3} {:.1}", Rounded(-0.000_6), Rounded(-12.34)), "-0.001 -12.3");
        assert_eq!(format!("{:.1} {:.1}", Rounded(f64::NAN), Rounded(f64::NEG_INFINITY)), "NaN -inf");
    }
}
