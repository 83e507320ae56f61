//! Sensor records as CSV: a header line with the column names, then one line per sample.
//!
//! | sensor | columns besides `time_s` |
//! |---|---|
//! | gyro | `rate_rad_s`; for an arbitrary orientation `x_rad_s`, `y_rad_s`, `z_rad_s` |
//! | heading | `heading_rad` (counter-clockwise) or `bearing_rad` (clockwise), any zero |
//! | wheel | `speed_m_s`, or `distance_m` with an arbitrary zero |
//! | range | `height_m` above the ground, or `distance_m` along the camera's optical axis |
//!
//! Angles may be in degrees (`rate_deg_s`, `heading_deg`, …). Values are separated by commas,
//! semicolons or white space. Unknown columns, empty lines and lines that begin with `#` are
//! ignored.

use super::columns::{Columns, shortened};
use crate::error::{Error, Result};
use crate::filter::fusion::{Quantity, SensorKind, SensorRecord};
use std::fmt::Write;

/// Column names of a quantity, with the factor that converts the values to SI units (and to
/// counter-clockwise).
struct Known {
    sensor: SensorKind,
    names: &'static [&'static str],
    factor: f64,
    quantity: Quantity,
}

const DEGREE: f64 = std::f64::consts::PI / 180.0;

const fn known(sensor: SensorKind, names: &'static [&'static str], factor: f64, quantity: Quantity) -> Known {
    Known { sensor, names, factor, quantity }
}

const KNOWN: [Known; 12] = [
    known(SensorKind::Gyro, &["rate_rad_s"], 1.0, Quantity::TurnRate),
    known(SensorKind::Gyro, &["rate_deg_s"], DEGREE, Quantity::TurnRate),
    known(SensorKind::Gyro, &["x_rad_s", "y_rad_s", "z_rad_s"], 1.0, Quantity::TurnRates),
    known(SensorKind::Gyro, &["x_deg_s", "y_deg_s", "z_deg_s"], DEGREE, Quantity::TurnRates),
    known(SensorKind::Heading, &["heading_rad"], 1.0, Quantity::Heading),
    known(SensorKind::Heading, &["heading_deg"], DEGREE, Quantity::Heading),
    known(SensorKind::Heading, &["bearing_rad"], -1.0, Quantity::Heading),
    known(SensorKind::Heading, &["bearing_deg"], -DEGREE, Quantity::Heading),
    known(SensorKind::Wheel, &["speed_m_s"], 1.0, Quantity::Speed),
    known(SensorKind::Wheel, &["distance_m"], 1.0, Quantity::Way),
    known(SensorKind::Range, &["height_m"], 1.0, Quantity::Height),
    known(SensorKind::Range, &["distance_m"], 1.0, Quantity::AxisDistance),
];

/// Reads the record of a sensor.
///
/// Fails, naming the line, if the header does not have the columns of the sensor, a line has a
/// different number of values than the header, a value is not a finite number, or a time is not
/// later than the one before. Also fails if there are fewer than two samples.
pub fn parse(text: &str, sensor: SensorKind) -> Result<SensorRecord> {
    let mut table = Columns::new(text)?;
    let of_sensor = || KNOWN.iter().filter(|known| known.sensor == sensor);
    let chosen = of_sensor().find_map(|known| {
        let columns: Option<Vec<usize>> = known.names.iter().map(|name| table.named(name)).collect();
        columns.map(|columns| (known, columns))
    });
    let Some((known, columns)) = chosen.filter(|_| table.has_time()) else {
        return Err(Error::input(format!(
            "line {} is {:?}; it must name the columns, time_s and {}",
            table.header_line,
            shortened(table.header),
            self::columns(sensor)
        )));
    };
    let mut times_s: Vec<f64> = Vec::new();
    let mut channels: Vec<Vec<f64>> = vec![Vec::new(); columns.len()];
    while let Some(row) = table.next_row()? {
        times_s.push(row.time_s);
        for (channel, &column) in channels.iter_mut().zip(&columns) {
            channel.push(known.factor * table.value(&row, column)?);
        }
    }
    SensorRecord::new(known.quantity, times_s, channels)
}

/// The reading of a sensor among values with the names of columns, in SI units; `None` if it is not
/// among them.
pub fn reading(sensor: SensorKind, value: impl Fn(&str) -> Option<f64>) -> Option<(Quantity, Vec<f64>)> {
    KNOWN.iter().filter(|known| known.sensor == sensor).find_map(|known| {
        let values: Option<Vec<f64>> =
            known.names.iter().map(|name| value(name).map(|value| known.factor * value)).collect();
        values.map(|values| (known.quantity, values))
    })
}

/// Names of the columns that a sensor may have beside `time_s`, for messages.
pub fn columns(sensor: SensorKind) -> String {
    let names: Vec<String> =
        KNOWN.iter().filter(|known| known.sensor == sensor).map(|known| known.names.join(",")).collect();
    names.join(" or ")
}

/// Writes a record for [`parse`], rounded to 1e-6 s and 1e-6 of its unit.
pub fn write(record: &SensorRecord) -> String {
    let quantity = record.quantity();
    let names = KNOWN.iter().find(|known| known.quantity == quantity && known.factor == 1.0);
    let mut text = format!("time_s,{}\n", names.map_or(String::new(), |known| known.names.join(",")));
    for (time_s, values) in record.samples() {
        let _ = write!(text, "{time_s:.6}");
        for value in values {
            let _ = write!(text, ",{value:.6}");
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn columns_are_selected_by_name_and_converted_to_si_units() {
        let record =
            parse("# a compass\ntime_s;note;bearing_deg\n0;1;350\n1;2;10\n", SensorKind::Heading).unwrap();
        let samples: Vec<(f64, Vec<f64>)> = record.samples().collect();
        // Converted from clockwise to counter-clockwise, and unwrapped across north.
        assert!((samples[1].1[0] - samples[0].1[0] + 20f64.to_radians()).abs() < 1e-12);
        let three = parse("time_s,x_rad_s,y_rad_s,z_rad_s\n0 1 2 3\n1 4 5 6\n", SensorKind::Gyro).unwrap();
        assert_eq!(three.quantity(), Quantity::TurnRates);
        assert_eq!(
            parse("time_s distance_m\n0 1\n1 2", SensorKind::Wheel).unwrap().quantity(),
            Quantity::Way
        );
        assert_eq!(
            parse("time_s distance_m\n0 1\n1 2", SensorKind::Range).unwrap().quantity(),
            Quantity::AxisDistance
        );
    }

    #[test]
    fn errors_name_the_line_and_the_value() {
        for (text, part) in [
            ("", "nothing in the file"),
            ("1.0,2.0\n", "line 1 is \"1.0,2.0\"; it must name the columns, time_s and rate_rad_s or"),
            ("time_s,speed_m_s\n", "rate_rad_s"),
            ("time_s,rate_rad_s\n0,1\n0.1\n", "line 3 has 1 value, the first line names 2 columns"),
            ("time_s,rate_rad_s\n0,1\n0.1,fast\n", "line 3: \"fast\""),
            ("time_s,rate_rad_s\n0,1\n0.1,inf\n", "line 3: \"inf\""),
            ("time_s,rate_rad_s\n1,1\n1,2\n", "line 3: the time 1 s is not later than 1 s"),
            ("time_s,rate_rad_s\n1,1\n", "needs at least two readings and has 1;"),
        ] {
            let error = parse(text, SensorKind::Gyro).unwrap_err();
            assert!(error.to_string().contains(part), "{text:?}: {error}");
            assert_eq!(error.kind(), crate::error::ErrorKind::Input);
            assert!(!error.to_string().contains('\n'));
        }
    }

    #[test]
    fn a_written_record_is_read_back() {
        let record =
            SensorRecord::new(Quantity::Speed, vec![0.0, 0.02, 0.5], vec![vec![0.25, -1.5, 0.0]]).unwrap();
        assert_eq!(parse(&write(&record), SensorKind::Wheel).unwrap(), record);
    }

    proptest! {
        #[test]
        fn any_text_is_survived(text in ".*", lines in "time_s,height_m\n([0-9]{1,3}[,;\n]){0,20}") {
            let _ = (parse(&text, SensorKind::Range), parse(&lines, SensorKind::Range));
        }
    }
}
