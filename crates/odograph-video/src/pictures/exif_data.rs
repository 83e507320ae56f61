//! Capture time and orientation of an image from its EXIF data.

use crate::rotation::Orientation;
use exif::{DateTime, Exif, In, Reader, Tag, Value};
use std::fs::File;
use std::io::{BufReader, Cursor};
use std::path::Path;

/// Seconds since 1970 by the camera's clock (without time zone), from `DateTimeOriginal` and its
/// fraction.
pub(super) fn time_of_file(path: &Path) -> Option<f64> {
    let exif = Reader::new().read_from_container(&mut BufReader::new(File::open(path).ok()?)).ok()?;
    time(&exif)
}

/// Orientation of an image whose file is in memory.
pub(super) fn orientation(file: &[u8]) -> Orientation {
    let exif = Reader::new().read_from_container(&mut Cursor::new(file));
    let value = exif.ok().and_then(|e| e.get_field(Tag::Orientation, In::PRIMARY)?.value.get_uint(0));
    value.map_or(Orientation::default(), Orientation::from_exif)
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
