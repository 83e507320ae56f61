//! Round numbers for axes, and numbers as people read them.

/// The step of 1, 2 or 5 times a power of ten that divides `span` into at most `parts` (and more
/// than about a third of that). 1 where `span` is not a positive number.
pub fn round_step(span: f64, parts: f64) -> f64 {
    let raw = span / parts;
    if !(raw.is_finite() && raw > 0.0) {
        return 1.0;
    }
    let decade = 10f64.powf(raw.log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|factor| factor * decade)
        .find(|&step| step >= raw * (1.0 - 1e-9))
        .unwrap_or(10.0 * decade)
}

/// The multiples of `step` from `low` to `high`, at most 1000 of them.
pub fn multiples(low: f64, high: f64, step: f64) -> Vec<f64> {
    let (first, last) = ((low / step - 1e-9).ceil(), (high / step + 1e-9).floor());
    if !(first.is_finite() && last >= first && last - first <= 1000.0) {
        return vec![];
    }
    (0..=(last - first) as usize).map(|k| (first + k as f64) * step).collect()
}

/// A value with as many decimals as steps of the given size need; a true minus sign.
pub fn label(value: f64, step: f64) -> String {
    let decimals = (-(step.abs().log10() + 1e-9).floor()).clamp(0.0, 12.0) as usize;
    let text = format!("{value:.decimals$}");
    let zero = text.trim_start_matches('-').chars().all(|c| c == '0' || c == '.');
    if zero { text.trim_start_matches('-').into() } else { text.replace('-', "−") }
}

/// The unit for lengths of about `step_m`: its name and its size in metres.
pub fn length_unit(step_m: f64) -> (&'static str, f64) {
    match step_m {
        s if s >= 999.0 => ("km", 1000.0),
        s if s < 0.00099 => ("µm", 1e-6),
        s if s < 0.0099 => ("mm", 0.001),
        _ => ("m", 1.0),
    }
}

/// A length as people say it: three digits and a unit from mm to km. Lengths below a millimetre
/// are in millimetres, too, so that they compare with those beside them; µm begin below 10 µm.
pub fn length_text(length_m: f64) -> String {
    let (unit, size) = match length_m.abs() {
        l if l >= 9_999.5 => ("km", 1000.0),
        l if l >= 0.9995 => ("m", 1.0),
        l if l >= 0.09995 => ("cm", 0.01),
        l if l >= 9.995e-6 || l == 0.0 => ("mm", 0.001),
        _ => ("µm", 1e-6),
    };
    let value = length_m / size;
    let decimals = match value.abs() {
        v if v >= 99.95 => 0,
        v if v >= 9.995 => 1,
        v if v >= 0.09995 => 2,
        _ => 3,
    };
    if length_m == 0.0 { "0 m".into() } else { format!("{value:.decimals$} {unit}").replace('-', "−") }
}

/// A duration as people say it: `42.1 s`, `12 min 05 s`, `1 h 02 min`.
pub fn duration_text(seconds: f64) -> String {
    if !seconds.is_finite() {
        return "?".into();
    }
    let whole = seconds.round();
    match seconds {
        s if s < 0.0005 => "0 s".into(),
        s if s < 0.9995 => format!("{s:.3} s"),
        s if s < 9.995 => format!("{s:.2} s"),
        s if s < 119.95 => format!("{s:.1} s"),
        _ if whole < 3600.0 => format!("{} min {:02} s", (whole / 60.0).floor(), whole % 60.0),
        _ => {
            let minutes = (seconds / 60.0).round();
            format!("{} h {:02} min", (minutes / 60.0).floor(), minutes % 60.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round_and_few() {
        assert_eq!(round_step(10.0, 10.0), 1.0);
        assert_eq!(round_step(10.0, 8.0), 2.0);
        assert!((round_step(0.013, 6.0) - 0.005).abs() < 1e-15);
        assert_eq!(round_step(0.0, 6.0), 1.0);
        assert_eq!(round_step(f64::NAN, 6.0), 1.0);
    }

    #[test]
    fn labels_have_the_decimals_of_their_step() {
        assert_eq!(label(-0.0, 0.5), "0.0");
        assert_eq!(label(-1.5, 0.5), "−1.5");
        assert_eq!(label(3.0, 1.0), "3");
        assert_eq!(label(0.02, 0.02), "0.02");
        assert_eq!(multiples(-0.1, 0.31, 0.1).len(), 5);
        assert!(multiples(0.0, f64::INFINITY, 1.0).is_empty());
    }

    #[test]
    fn durations_and_lengths_read_well() {
        assert_eq!(duration_text(0.0), "0 s");
        assert_eq!(duration_text(59.96), "60.0 s");
        assert_eq!(duration_text(725.2), "12 min 05 s");
        assert_eq!(duration_text(3720.0), "1 h 02 min");
        assert_eq!(length_text(0.0123), "12.3 mm");
        assert_eq!(length_text(12.3456), "12.3 m");
        assert_eq!(length_text(-0.5), "−50.0 cm");
        assert_eq!(length_text(0.0), "0 m");
        assert_eq!(length_text(0.000_891), "0.89 mm");
        assert_eq!(length_text(0.000_012_3), "0.012 mm");
        assert_eq!(length_text(0.000_002_5), "2.50 µm");
    }
}
