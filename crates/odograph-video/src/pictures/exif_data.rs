//! Capture time, orientation and position of an image from its EXIF data.

use crate::rotation::Orientation;
use exif::{DateTime, Exif, In, Reader, Tag, Value};
use odograph::geometry::EarthPosition;
use odograph::georeference::GnssFix;
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

/// Seconds since 1970 by the camera's clock (without time zone), from `DateTimeOriginal` and its
/// fraction.
pub(super) fn time_of_file(path: &Path) -> Option<f64> {
    time(&read(&mut BufReader::new(File::open(path).ok()?))?)
}

/// The EXIF data of a file: as far as they can be read, because some programs end a list of fields
/// without saying that none follows.
fn read(file: &mut (impl BufRead + Seek)) -> Option<Exif> {
    let read = Reader::new().continue_on_error(true).read_from_container(file);
    read.or_else(|error| error.distill_partial_result(|_| ())).ok()
}

/// Orientation of an image whose file is in memory.
pub(super) fn orientation(file: &[u8]) -> Orientation {
    let value = read(&mut Cursor::new(file))
        .and_then(|e| e.get_field(Tag::Orientation, In::PRIMARY)?.value.get_uint(0));
    value.map_or(Orientation::default(), Orientation::from_exif)
}

/// Where and when an image was taken, by the camera's clock as [`time_of_file`]; `None` if it does
/// not say both. `file` is at least the beginning of its file.
///
/// Its standard deviation is what drones with corrections write (`RtkStdLon`, `RtkStdLat`), or
/// `GPSHPositioningError`, or follows from `GPSDOP`; otherwise it is the usual one.
pub(super) fn fix(file: &[u8]) -> Option<GnssFix> {
    let exif = read(&mut Cursor::new(file))?;
    let angle_deg = |angle: Tag, of: Tag, negative: u8| {
        let Value::Rational(parts) = &exif.get_field(angle, In::PRIMARY)?.value else { return None };
        let &[degrees, minutes, seconds] = parts.as_slice() else { return None };
        let angle_deg = degrees.to_f64() + minutes.to_f64() / 60.0 + seconds.to_f64() / 3600.0;
        let is_negative = ascii(&exif, of)?.first()?.eq_ignore_ascii_case(&negative);
        Some(if is_negative { -angle_deg } else { angle_deg })
    };
    let number = |tag: Tag| match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(values) => values.first().map(|value| value.to_f64()),
        Value::SRational(values) => values.first().map(|value| value.to_f64()),
        _ => None,
    };
    let latitude_deg = angle_deg(Tag::GPSLatitude, Tag::GPSLatitudeRef, b'S')?;
    let longitude_deg = angle_deg(Tag::GPSLongitude, Tag::GPSLongitudeRef, b'W')?;
    if (latitude_deg, longitude_deg) == (0.0, 0.0) {
        // The camera had none yet.
        return None;
    }
    let place = EarthPosition::from_degrees(latitude_deg, longitude_deg)?;
    let below = exif.get_field(Tag::GPSAltitudeRef, In::PRIMARY).and_then(|field| field.value.get_uint(0));
    let is_below = below == Some(1);
    let altitude_m =
        number(Tag::GPSAltitude).map(|altitude_m| if is_below { -altitude_m } else { altitude_m });
    let stated = ["RtkStdLon", "RtkStdLat"].map(|name| metadata_number(file, name));
    let positive = |value: &f64| value.is_finite() && *value > 0.0;
    let [east_m, north_m] = match stated {
        [Some(east_m), Some(north_m)] if positive(&east_m) && positive(&north_m) => [east_m, north_m],
        _ => {
            let error_m = number(Tag::GPSHPositioningError);
            let diluted_m =
                || number(Tag::GPSDOP).map(|dilution| GnssFix::RANGE_ERROR_M * dilution).filter(positive);
            [error_m.filter(positive).or_else(diluted_m).unwrap_or(GnssFix::USUAL_SIGMA_M); 2]
        }
    };
    Some(GnssFix {
        time_s: time(&exif)?,
        place,
        altitude_m: altitude_m.filter(|altitude_m| altitude_m.is_finite()),
        covariance_m2: GnssFix::covariance_m2(east_m, north_m),
    })
}

/// A number of the XMP metadata, which are text (XML): `drone-dji:RtkStdLon="0.012"`, or an element
/// of that name.
fn metadata_number(file: &[u8], name: &str) -> Option<f64> {
    let at = file.windows(name.len()).position(|bytes| bytes == name.as_bytes())? + name.len();
    let value: String =
        file[at..].iter().take(32).map(|&byte| char::from(byte)).filter(|c| !c.is_whitespace()).collect();
    let value = value.strip_prefix(['=', '>'])?.trim_start_matches(['"', '\'']);
    let end = value.find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c)))?;
    value[..end].parse().ok()
}

fn ascii(exif: &Exif, tag: Tag) -> Option<&[u8]> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => lines.first().map(Vec::as_slice),
        _ => None,
    }
}

fn time(exif: &Exif) -> Option<f64> {
    let mut taken = DateTime::from_ascii(ascii(exif, Tag::DateTimeOriginal)?).ok()?;
    if let Some(fraction) = ascii(exif, Tag::SubSecTimeOriginal) {
        // An unreadable fraction is ignored.
        let _ = taken.parse_subsec(fraction);
    }
    if !(1..=12).contains(&taken.month) || !(1..=31).contains(&taken.day) {
        return None;
    }
    let days = days_since_1970(i64::from(taken.year), i64::from(taken.month), i64::from(taken.day));
    let seconds =
        ((days * 24 + i64::from(taken.hour)) * 60 + i64::from(taken.minute)) * 60 + i64::from(taken.second);
    Some(seconds as f64 + f64::from(taken.nanosecond.unwrap_or(0)) * 1e-9)
}

/// Days since 1970-01-01 in the proleptic Gregorian calendar. Years start in March, so that the
/// leap day is the last day.
fn days_since_1970(year: i64, month: i64, day: i64) -> i64 {
    let year = if month <= 2 { year - 1 } else { year };
    let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    365 * year + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400) + day_of_year - 719_468
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_of_the_calendar() {
        assert_eq!(days_since_1970(1970, 1, 1), 0);
        assert_eq!(days_since_1970(2000, 3, 1), 11_017);
        assert_eq!(days_since_1970(2024, 2, 29), 19_782);
    }
}
