//! Positions of a satellite receiver (GNSS) as CSV, NMEA 0183, GPX or the subtitles of a drone.
//!
//! * CSV: a header line with `time_s`, `latitude_deg`, `longitude_deg`, and perhaps `altitude_m`
//!   above the ellipsoid and the standard deviations `sigma_m`, or `sigma_east_m` and
//!   `sigma_north_m`; then one line per position. Other columns are ignored.
//! * NMEA: GGA, RMC and GST sentences; others are ignored, and so are lines with a wrong checksum.
//!   The standard deviation is GST's, otherwise the usual one of GGA's quality.
//! * GPX 1.0 and 1.1: track points with their times; of the dilution of precision the horizontal.
//! * SRT: the subtitles of drones of DJI, with the usual standard deviation.
//!
//! Times of NMEA and GPX are seconds since 1970 in UTC; those of NMEA without a date are seconds
//! since midnight. Those of subtitles count from the start of the video.

mod gpx;
mod lines;
mod nmea;
mod srt;
mod utc;

pub use lines::{GnssLines, ReceivedFixes};
pub use utc::parse_utc;

use super::columns::{Columns, shortened};
use crate::error::{Error, Result};
use crate::geometry::EarthPosition;
use crate::georeference::GnssFix;

/// Reads positions, in order of time.
///
/// # Errors
/// Where the text is none of these formats, a number is missing or impossible, a time is not later
/// than the one before, or there is no position; the line is named.
pub fn parse(text: &str) -> Result<Vec<GnssFix>> {
    let text = text.trim_start_matches('\u{feff}');
    let begins = text.trim_start();
    let fixes = if begins.starts_with('<') {
        gpx::parse(text)?
    } else if begins.starts_with('$') || begins.starts_with('!') {
        nmea::parse(text)?
    } else if srt::is_one(begins) {
        srt::parse(text)?
    } else {
        csv(text)?
    };
    if fixes.is_empty() {
        return Err(Error::input(
            "there is no position in the file; give one with positions of the recording's time",
        ));
    }
    Ok(fixes)
}

fn csv(text: &str) -> Result<Vec<GnssFix>> {
    let mut table = Columns::new(text)?;
    let either = |names: [&str; 2]| names.iter().find_map(|name| table.named(name));
    let (latitude, longitude) = (either(["latitude_deg", "lat"]), either(["longitude_deg", "lon"]));
    let altitude = either(["altitude_m", "alt"]);
    let sigmas = [either(["sigma_east_m", "sigma_m"]), either(["sigma_north_m", "sigma_m"])];
    let (Some(latitude), Some(longitude), true) = (latitude, longitude, table.has_time()) else {
        return Err(Error::input(format!(
            "line {} is {:?}; it must name the columns, time_s,latitude_deg,longitude_deg, and may name altitude_m,sigma_m",
            table.header_line,
            shortened(table.header)
        )));
    };
    let mut fixes = Vec::new();
    while let Some(row) = table.next_row()? {
        let value = |column: usize| table.value(&row, column);
        let place = place(row.line, value(latitude)?, value(longitude)?)?;
        let altitude_m = altitude.map(value).transpose()?;
        let mut sigmas_m = [GnssFix::USUAL_SIGMA_M; 2];
        for (sigma_m, column) in sigmas_m.iter_mut().zip(sigmas) {
            let Some(column) = column else { continue };
            *sigma_m = value(column)?;
            if *sigma_m <= 0.0 {
                return Err(Error::input(format!(
                    "line {}: the standard deviation {sigma_m} m must be positive",
                    row.line
                )));
            }
        }
        let covariance_m2 = GnssFix::covariance_m2(sigmas_m[0], sigmas_m[1]);
        fixes.push(GnssFix { time_s: row.time_s, place, altitude_m, covariance_m2 });
    }
    Ok(fixes)
}

/// The place of a line.
fn place(line: usize, latitude_deg: f64, longitude_deg: f64) -> Result<EarthPosition> {
    EarthPosition::from_degrees(latitude_deg, longitude_deg).ok_or_else(|| {
        Error::input(format!(
            "line {line}: latitude {latitude_deg}°, longitude {longitude_deg}° is no place on Earth that a map can be at"
        ))
    })
}

/// The refusal of a time that is not later than the one before.
fn not_later(line: usize, time_s: f64, before_s: f64) -> Error {
    Error::input(format!(
        "line {line}: the time {time_s:.3} s is not later than {before_s:.3} s before it; sort the file by time"
    ))
}

/// Writes positions as CSV for [`parse`], to a tenth of a millimetre; of a covariance the standard
/// deviations. Altitudes are left out unless all are known.
pub fn write(fixes: &[GnssFix]) -> String {
    let altitudes = fixes.iter().all(|fix| fix.altitude_m.is_some());
    let named = if altitudes { ",altitude_m" } else { "" };
    let mut text = format!("time_s,latitude_deg,longitude_deg{named},sigma_east_m,sigma_north_m\n");
    for fix in fixes {
        let covariance = &fix.covariance_m2;
        let altitude = fix.altitude_m.filter(|_| altitudes);
        text.push_str(&format!(
            "{:.6},{:.9},{:.9}{},{:.4},{:.4}\n",
            fix.time_s,
            fix.place.latitude_rad.to_degrees(),
            fix.place.longitude_rad.to_degrees(),
            altitude.map_or(String::new(), |altitude_m| format!(",{altitude_m:.4}")),
            covariance[(0, 0)].sqrt(),
            covariance[(1, 1)].sqrt()
        ));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn columns_of_csv_are_selected_by_name() {
        let text = "# a receiver\ntime_s,lat,lon,alt,sigma_m,satellites\n1.5,48.2,16.4,200,0.02,11\n2.5,48.3,16.5,201,0.03,12\n";
        let fixes = parse(text).unwrap();
        assert_eq!((fixes.len(), fixes[1].time_s, fixes[1].altitude_m), (2, 2.5, Some(201.0)));
        assert!((fixes[1].place.latitude_rad.to_degrees() - 48.3).abs() < 1e-12);
        assert!((fixes[1].covariance_m2[(1, 1)] - 9e-4).abs() < 1e-15);
        let plain = parse("time_s latitude_deg longitude_deg\n0 1 2\n").unwrap();
        assert_eq!(plain[0].covariance_m2[(0, 0)], 9.0);
        assert_eq!(plain[0].altitude_m, None);
        assert_eq!(parse(&write(&fixes)).unwrap().len(), 2);
    }

    #[test]
    fn positions_are_read_as_they_are_written() {
        let text = "time_s,lat,lon,alt,sigma_m\n1.5,48.2,16.4,200,0.02\n2.5,48.3,16.5,201,0.03\n";
        let fixes = parse(text).unwrap();
        let again = parse(&write(&fixes)).unwrap();
        for (fix, again) in fixes.iter().zip(&again) {
            assert_eq!((fix.time_s, fix.altitude_m), (again.time_s, again.altitude_m));
            assert!((fix.place.latitude_rad - again.place.latitude_rad).abs() < 2e-11);
            assert!((fix.covariance_m2 - again.covariance_m2).norm() < 1e-12);
        }
        // An altitude that is not known is not 0.
        let partly = [fixes[0], GnssFix { altitude_m: None, ..fixes[1] }];
        assert!(parse(&write(&partly)).unwrap().iter().all(|fix| fix.altitude_m.is_none()));
    }

    #[test]
    fn errors_name_the_line_and_what_is_wrong() {
        for (text, part) in [
            ("", "nothing in the file"),
            ("time_s,x_m,y_m\n", "it must name the columns, time_s,latitude_deg,longitude_deg"),
            ("time_s,lat,lon\n", "no position"),
            ("time_s,lat,lon\n0,nan,16\n", "line 2: \"nan\" stands where a finite number belongs (lat)"),
            ("time_s,lat,lon\n0,91,16\n", "line 2: latitude 91°, longitude 16° is no place"),
            ("time_s,lat,lon\n1,48,16\n0,48,16\n", "line 3: the time 0 s is not later than 1 s"),
            ("time_s,lat,lon,sigma_m\n1,48,16,0\n", "line 2: the standard deviation 0 m must be positive"),
            ("$GPGSV,1,1,00*79\n", "no position"),
            ("<gpx></gpx>", "no position"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(part) && !error.contains('\n'), "{text:?}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_survived(text in ".*", sentences in "([$][A-Z]{5}(,[0-9.NESWA]{0,9}){0,14}([*][0-9A-F]{2})?\n){0,9}",
                                cues in "(00:00:0[0-9],[0-9]{1,3} --> 00:00:09,000\n([\\[](latitude|longitude|altitude) ?:? ?[-0-9.]{0,6}[\\]] ?|GPS[(][-0-9.,]{0,9}[)]){0,3}\n){0,5}",
                                tags in "(<(/?trkpt|time|/time|ele)( (lat|lon)=\"[-0-9.]{0,5}\"){0,3}/?>[-0-9TZ:.]{0,9}){0,9}") {
            let _ = (parse(&text), parse(&sentences), parse(&cues), parse(&format!("<gpx>{tags}")));
        }
    }
}
