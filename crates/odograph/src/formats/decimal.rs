//! Numbers as text that every reader parses to the same value.

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
