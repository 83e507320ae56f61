//! The report's table of the sensors beside the camera.

use super::parts::number;
use odograph::drawing::svg::escape;
use odograph::filter::fusion::{SensorParameter, SensorReport};
use std::fmt::Write;

/// Writes the section; nothing without such sensors.
pub fn other_sensors(sensors: &[SensorReport], page: &mut String) {
    if sensors.is_empty() {
        return;
    }
    page.push_str(
        "<h2>Other sensors</h2>\n<p class=\"quiet\">Every ± is one standard deviation.</p>\n<div class=\"box scroll\">\
         <table>\n<tr><th>Sensor</th><th>used</th><th>clock ahead by</th><th>found</th></tr>\n",
    );
    for report in sensors {
        let used = report.rejected.map_or("yes".into(), |reason| format!("no: {reason}"));
        let clock = match report.offset {
            Some(offset) if offset.sigma_s.is_finite() => {
                format!("{} ± {} ms", number(1e3 * offset.offset_s, 1), number(1e3 * offset.sigma_s, 1))
            }
            Some(_) => "not determined by the motion".into(),
            None => String::new(),
        };
        let found: Vec<String> = report.parameters.iter().map(in_words).collect();
        let _ = writeln!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{clock}</td><td>{}</td></tr>",
            report.sensor,
            escape(&used),
            escape(&found.join(", "))
        );
    }
    page.push_str("</table></div>\n");
}

/// A parameter with its standard deviation, in the units of people.
fn in_words(found: &SensorParameter) -> String {
    let (name, unit, size, decimals) = match found.name {
        "bias_rad_s" => ("bias", "°/s", 1f64.to_radians(), 3),
        "zero_rad" => ("heading at the start", "°", 1f64.to_radians(), 2),
        "direction_rad" => ("rolling direction", "°", 1f64.to_radians(), 2),
        "camera_ahead_m" => ("camera ahead of its axle by", " m", 1.0, 4),
        "camera_left_m" => ("camera to the left of its axle by", " m", 1.0, 4),
        "camera_above_sensor_m" => ("camera above the sensor by", " m", 1.0, 4),
        "axis_x" => ("axis x", "", 1.0, 4),
        "axis_y" => ("axis y", "", 1.0, 4),
        "axis_z" => ("axis z", "", 1.0, 4),
        other => (other, "", 1.0, 4),
    };
    let [value, sigma] = [found.value, found.sigma].map(|quantity| number(quantity / size, decimals));
    match unit.trim_start() {
        "m" | "" => format!("{name} {value} ± {sigma}{unit}"),
        _ => format!("{name} {value}{unit} ± {sigma}{unit}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_have_words_units_and_one_standard_deviation() {
        let text = |name, value, sigma| in_words(&SensorParameter { name, value, sigma });
        assert_eq!(text("bias_rad_s", 0.01, 0.001), "bias 0.573°/s ± 0.057°/s");
        assert_eq!(text("direction_rad", -0.1, 0.01), "rolling direction −5.73° ± 0.57°");
        assert_eq!(text("camera_left_m", 0.05, 0.002), "camera to the left of its axle by 0.0500 ± 0.0020 m");
        assert_eq!(text("scale", 0.98, 0.001), "scale 0.9800 ± 0.0010");
    }
}
