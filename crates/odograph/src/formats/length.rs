//! Lengths as people write them: a number of metres, or a number with its unit.

/// Units and how many metres they are; of two that end alike the longer comes first.
const UNITS: [(&str, f64); 5] = [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("ft", 0.3048), ("in", 0.0254)];

/// Reads `0.9`, `0.9m`, `90cm`, `900mm`, `3ft` or `35in`: metres, and whether a unit was written.
/// `None` for anything else.
pub fn parse(text: &str) -> Option<(f64, bool)> {
    let text = text.trim();
    let unit = UNITS.iter().find_map(|(unit, metres)| Some((text.strip_suffix(unit)?, *metres)));
    let (number, in_metres) = unit.unwrap_or((text, 1.0));
    let number: f64 = number.trim_end().parse().ok()?;
    Some((number * in_metres, unit.is_some()))
}
