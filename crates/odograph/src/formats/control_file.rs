//! Control points as CSV: surveyed places of markers.
//!
//! A header line with the column names, then one line per marker: `marker` (its number), `x_m` and
//! `y_m` of its centre in the survey frame, and optionally `sigma_m` (standard deviation of both;
//! 2 mm where it is missing) and `heading_deg` (direction of its top, counter-clockwise from x).
//! Values are separated by commas, semicolons or white space. Other columns, empty lines and lines
//! that begin with `#` are ignored.

use super::columns::{Columns, shortened};
use crate::error::{Error, Result};
use crate::landmark::ControlPoint;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::ops::RangeInclusive;

/// Largest coordinate, metres: survey frames of countries have seven digits.
const MAX_COORDINATE_M: f64 = 1e8;

/// Accepted standard deviations, metres: below the first one is rounded to nothing.
const DEVIATIONS_M: RangeInclusive<f64> = 1e-6..=1e3;

/// Largest heading, degrees. Larger are gons, or a mistake.
const MAX_HEADING_DEG: f64 = 360.0;

/// Reads the control points, in the order of the file.
///
/// Fails, naming the line, if a column is missing, a value is not a finite number or beyond its
/// range, a marker's number is not a whole one, or a marker stands there twice. Also fails if there
/// is none.
pub fn parse(text: &str) -> Result<Vec<ControlPoint>> {
    let mut table = Columns::new(text)?;
    let named = ["marker", "x_m", "y_m"].map(|name| table.named(name));
    let [Some(marker), Some(x), Some(y)] = named else {
        return Err(Error::input(format!(
            "line {} is {:?}; it must name the columns, marker, x_m and y_m",
            table.header_line,
            shortened(table.header)
        )));
    };
    let (sigma, heading) = (table.named("sigma_m"), table.named("heading_deg"));
    let mut points: Vec<ControlPoint> = Vec::new();
    let mut lines: BTreeMap<u32, usize> = BTreeMap::new();
    while let Some(row) = table.next_row()? {
        let number = table.value(&row, marker)?;
        if number.fract() != 0.0 || !(0.0..=f64::from(u32::MAX)).contains(&number) {
            return Err(Error::input(format!(
                "line {}: {number} stands where the number of a marker belongs, a whole number from 0",
                row.line
            )));
        }
        let number = number as u32;
        if let Some(first) = lines.insert(number, row.line) {
            return Err(Error::input(format!(
                "line {}: marker {number} stands in line {first} already; keep one of the two",
                row.line
            )));
        }
        let sigma_m = sigma.map_or(Ok(ControlPoint::USUAL_SIGMA_M), |column| table.value(&row, column))?;
        if !DEVIATIONS_M.contains(&sigma_m) {
            return Err(Error::input(format!(
                "line {}: the standard deviation of marker {number} is {sigma_m:?} m; it must be positive, from {} to {} m, \
                 such as 0.002",
                row.line,
                DEVIATIONS_M.start(),
                DEVIATIONS_M.end()
            )));
        }
        let (x_m, y_m) = (table.value(&row, x)?, table.value(&row, y)?);
        if x_m.abs().max(y_m.abs()) > MAX_COORDINATE_M {
            return Err(Error::input(format!(
                "line {}: marker {number} is at {x_m:?} m and {y_m:?} m; no place on Earth is farther than {MAX_COORDINATE_M:?} m",
                row.line
            )));
        }
        let heading_deg = heading.map(|column| table.value(&row, column)).transpose()?;
        if let Some(heading_deg) = heading_deg.filter(|heading_deg| heading_deg.abs() > MAX_HEADING_DEG) {
            return Err(Error::input(format!(
                "line {}: the heading of marker {number} is {heading_deg:?}; it must be in degrees, from -360 to 360",
                row.line
            )));
        }
        points.push(ControlPoint {
            number,
            x_m,
            y_m,
            sigma_m,
            heading_rad: heading_deg.map(f64::to_radians),
        });
    }
    if points.is_empty() {
        return Err(Error::input("there is no marker in the file, only the names of the columns"));
    }
    Ok(points)
}

/// Writes control points for [`parse`], rounded to a micrometre and to 1e-5 degrees; the heading
/// only if all have one.
pub fn write(points: &[ControlPoint]) -> String {
    let with_heading = points.iter().all(|point| point.heading_rad.is_some());
    let mut text = String::from(if with_heading {
        "marker,x_m,y_m,sigma_m,heading_deg\n"
    } else {
        "marker,x_m,y_m,sigma_m\n"
    });
    for point in points {
        let _ = write!(text, "{},{:.6},{:.6},{:.6}", point.number, point.x_m, point.y_m, point.sigma_m);
        if let Some(heading_rad) = point.heading_rad.filter(|_| with_heading) {
            let _ = write!(text, ",{:.5}", heading_rad.to_degrees());
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
    fn written_points_are_read_back() {
        let point =
            |number, heading_rad| ControlPoint { number, x_m: 1.5, y_m: -0.25, sigma_m: 0.003, heading_rad };
        let points = vec![point(4, Some(0.5)), point(0, Some(-3.0))];
        let read = parse(&write(&points)).unwrap();
        assert!(read.iter().zip(&points).all(|(a, b)| {
            (a.number, a.x_m, a.y_m, a.sigma_m) == (b.number, b.x_m, b.y_m, b.sigma_m)
                && (a.heading_rad.unwrap() - b.heading_rad.unwrap()).abs() < 1e-6
        }));
        let plain = vec![point(4, None)];
        assert_eq!(parse(&write(&plain)).unwrap(), plain);
        let usual = parse("# hall 3\nY_M; marker; x_m; note\n2;7;1;5\n").unwrap()[0];
        assert_eq!((usual.number, usual.y_m, usual.sigma_m), (7, 2.0, ControlPoint::USUAL_SIGMA_M));
    }

    /// What once failed the fuzz target.
    #[test]
    fn what_is_accepted_can_be_written_and_read_again() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/regressions/control_file");
        let inputs: Vec<_> = std::fs::read_dir(folder).unwrap().collect();
        assert!(!inputs.is_empty());
        for input in inputs {
            let bytes = std::fs::read(input.unwrap().path()).unwrap();
            if let Ok(points) = parse(&String::from_utf8_lossy(&bytes)) {
                assert_eq!(parse(&write(&points)).unwrap().len(), points.len());
            }
        }
    }

    #[test]
    fn errors_name_the_line_and_the_value() {
        for (text, part) in [
            ("", "nothing in the file"),
            ("marker,x,y\n1,2,3\n", "it must name the columns, marker, x_m and y_m"),
            ("marker,x_m,y_m\n", "no marker in the file"),
            ("marker,x_m,y_m\n1,2\n", "line 2 has 2 values"),
            ("marker,x_m,y_m\n1,NaN,3\n", "line 2: \"NaN\""),
            ("marker,x_m,y_m\n1.5,2,3\n", "line 2: 1.5 stands where the number of a marker"),
            ("marker,x_m,y_m\n-1,2,3\n", "line 2: -1 stands where"),
            ("marker,x_m,y_m\n1,2,3\n2,2,3\n1,4,4\n", "line 4: marker 1 stands in line 2 already"),
            ("marker,x_m,y_m,sigma_m\n1,2,3,0\n", "it must be positive"),
            (
                "marker,x_m,y_m,sigma_m\n1,2,3,1e-7\n",
                "is 1e-7 m; it must be positive, from 0.000001 to 1000 m",
            ),
            ("marker,x_m,y_m,sigma_m\n1,2,3,1e300\n", "is 1e300 m; it must be positive"),
            ("marker,x_m,y_m\n1,2,-1e300\n", "line 2: marker 1 is at 2.0 m and -1e300 m; no place on Earth"),
            (
                "marker,x_m,y_m,heading_deg\n1,2,3,390\n",
                "line 2: the heading of marker 1 is 390.0; it must be in degrees",
            ),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(part) && !error.contains('\n'), "{text:?}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_survived(text in ".*", lines in "marker,x_m,y_m\n([0-9]{1,3}[,;\n]){0,20}") {
            let _ = (parse(&text), parse(&lines));
        }
    }
}
