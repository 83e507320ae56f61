//! Whether a wheel and the camera agree on lengths.

use odograph::filter::fusion::{SensorKind, SensorReport};

/// Lengths that differ by less are within what tyres and their pressure explain.
const USUAL: f64 = 0.05;
/// The difference must exceed this number of standard deviations.
const SIGNIFICANT: f64 = 4.0;
/// A ratio within this of a unit's is that unit.
const OF_UNIT: f64 = 0.15;

/// Units in which speeds or distances come instead of metres, in metres.
const UNITS: [(&str, f64); 3] =
    [("millimetres", 0.001), ("centimetres", 0.01), ("kilometres per hour", 1.0 / 3.6)];

/// A warning where lengths by an accepted wheel differ from those of the camera, whose height sets
/// the scale: one of the two is wrong, and the path is the camera's.
pub fn warning(reports: &[SensorReport]) -> Option<String> {
    let wheel =
        reports.iter().find(|report| report.sensor == SensorKind::Wheel && report.rejected.is_none())?;
    // What the wheel's lengths are to be multiplied by.
    let scale = wheel.parameters.iter().find(|parameter| parameter.name == "scale")?;
    let (factor, percent) = (scale.value, 100.0 * (1.0 / scale.value - 1.0));
    let is_off = (factor - 1.0).abs() > SIGNIFICANT * scale.sigma && (1.0 / factor - 1.0).abs() > USUAL;
    if !(is_off && factor > 0.0 && percent.is_finite()) {
        return None;
    }
    let begins = "its lengths are fitted to those of the camera, which sets the scale";
    if let Some((unit, _)) = UNITS.iter().find(|(_, unit_m)| (factor / unit_m - 1.0).abs() < OF_UNIT) {
        return Some(format!(
            "the wheel's numbers are {:.4} times the metres that the camera saw, as {unit} would be; {begins}, but give it \
             metres",
            1.0 / factor
        ));
    }
    let longer = if percent > 0.0 { "longer" } else { "shorter" };
    Some(format!(
        "by the wheel the path is {:.1} % {longer} than by the camera; {begins}: if the wheel is right, multiply --height \
         (or --field-of-view) by {:.4}, if the camera is right, the wheel by {factor:.4}",
        percent.abs(),
        1.0 / factor
    ))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::filter::fusion::SensorParameter;

    fn said(value: f64, sigma: f64) -> Option<String> {
        warning(&[SensorReport {
            sensor: SensorKind::Wheel,
            rejected: None,
            offset: None,
            parameters: vec![SensorParameter { name: "scale", value, sigma }],
            noise: None,
            seconds: 10,
            contradictions: 0,
            nis: None,
        }])
    }

    #[test]
    fn a_height_that_a_wheel_contradicts_is_named_with_its_factor() {
        // Tracked at 0.8 m, truly at 0.9 m: the wheel goes 1.125 times as far.
        let short = said(0.8 / 0.9, 0.001).unwrap();
        assert!(short.contains("12.5 % longer") && short.contains("--field-of-view) by 1.1250"), "{short}");
        let long = said(1.25, 0.001).unwrap();
        assert!(long.contains("20.0 % shorter") && long.contains("the wheel by 1.2500"), "{long}");
    }

    #[test]
    fn a_wheel_in_other_units_has_them_named() {
        for (factor, unit) in [
            (0.00101, "as millimetres would be"),
            (0.0099, "as centimetres would be"),
            (0.28, "as kilometres per hour would be"),
        ] {
            let said = said(factor, 1e-6).unwrap();
            assert!(said.contains(unit) && said.ends_with("give it metres"), "{said}");
        }
    }

    #[test]
    fn what_tyres_and_noise_explain_is_no_warning() {
        assert_eq!(said(1.04, 0.001), None);
        assert_eq!(said(1.3, 0.1), None, "not significant");
        assert_eq!(said(f64::NAN, 0.1), None);
        assert_eq!(warning(&[]), None);
    }
}
