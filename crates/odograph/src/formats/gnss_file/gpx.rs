//! GPX: track points. What surrounds them is not looked at.

use super::utc::parse_utc;
use super::{not_later, place};
use crate::error::{Error, Result};
use crate::georeference::GnssFix;

/// Reads the track points. Points without a time are an error: they belong to no frame.
pub fn parse(text: &str) -> Result<Vec<GnssFix>> {
    let mut fixes: Vec<GnssFix> = Vec::new();
    let (mut rest, mut line) = (text, 1);
    while let Some(at) = rest.find("<trkpt") {
        line += rest[..at].bytes().filter(|&byte| byte == b'\n').count();
        let point = &rest[at + "<trkpt".len()..];
        let end = point.find("</trkpt").or_else(|| point.find("<trkpt")).unwrap_or(point.len());
        let (point, after) = point.split_at(end);
        let (tag, body) = point.split_once('>').unwrap_or((point, ""));
        let wrong = |what: &str| Error::input(format!("line {line}: the track point {what}"));
        let coordinate = |name: &str| attribute(tag, name).and_then(|value| value.trim().parse::<f64>().ok());
        let (Some(latitude), Some(longitude)) = (coordinate("lat"), coordinate("lon")) else {
            return Err(wrong("has no lat and lon that are numbers"));
        };
        let place = place(line, latitude, longitude)?;
        let time_s = element(body, "time").and_then(parse_utc).ok_or_else(|| wrong("has no time"))?;
        let number = |name: &str| {
            element(body, name).and_then(|text| text.trim().parse::<f64>().ok()).filter(|n| n.is_finite())
        };
        let dilution = number("hdop").filter(|&dilution| dilution > 0.0);
        let sigma_m = dilution.map_or(GnssFix::USUAL_SIGMA_M, |dilution| GnssFix::RANGE_ERROR_M * dilution);
        // Altitude above the geoid; its height is that of a point, or not known.
        let altitude_m = number("ele").map(|above_m| above_m + number("geoidheight").unwrap_or(0.0));
        if let Some(before) = fixes.last().filter(|before| before.time_s >= time_s) {
            return Err(not_later(line, time_s, before.time_s));
        }
        fixes.push(GnssFix {
            time_s,
            place,
            altitude_m,
            covariance_m2: GnssFix::covariance_m2(sigma_m, sigma_m),
        });
        line += point.bytes().filter(|&byte| byte == b'\n').count();
        rest = after;
    }
    Ok(fixes)
}

/// The value of an attribute of a tag.
fn attribute<'a>(tag: &'a str, name: &str) -> Option<&'a str> {
    let mut rest = tag;
    loop {
        let at = rest.find(name)?;
        let (before, after) = (&rest[..at], &rest[at + name.len()..]);
        let is_name = before.ends_with(|c: char| c.is_whitespace());
        if let (true, Some(value)) = (is_name, after.trim_start().strip_prefix('=')) {
            let value = value.trim_start();
            let quote = value.chars().next().filter(|c| matches!(c, '"' | '\''))?;
            return value[1..].split_once(quote).map(|(value, _)| value);
        }
        rest = after;
    }
}

/// The text of an element that has no attributes.
fn element<'a>(body: &'a str, name: &str) -> Option<&'a str> {
    let (_, after) = body.split_once(&format!("<{name}>"))?;
    after.split_once('<').map(|(text, _)| text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn track_points_are_read_with_their_times() {
        let text = "<?xml version=\"1.0\"?>\n<gpx><trk><trkseg>\n<trkpt lat=\"48.2082\" lon='16.3738'><ele>160.5</ele>\
                    <time>2026-05-04T10:12:33.5Z</time><hdop>0.8</hdop></trkpt>\n\
                    <trkpt lon=\"16.3739\" lat=\"48.2083\"><time>2026-05-04T10:12:34.5Z</time></trkpt></trkseg></trk></gpx>";
        let fixes = parse(text).unwrap();
        assert_eq!((fixes.len(), fixes[0].time_s, fixes[0].altitude_m), (2, 1_777_889_553.5, Some(160.5)));
        assert!(
            (fixes[0].covariance_m2[(0, 0)] - 4.0).abs() < 1e-12 && fixes[1].covariance_m2[(0, 0)] == 9.0
        );
        assert!((fixes[1].place.longitude_rad.to_degrees() - 16.3739).abs() < 1e-12);
    }

    #[test]
    fn points_that_cannot_be_used_are_refused_with_their_line() {
        let point =
            |lat: &str, time: &str| format!("<trkpt lat=\"{lat}\" lon=\"16\"><time>{time}</time></trkpt>\n");
        let (noon, later) = ("2026-05-04T12:00:00Z", "2026-05-04T12:00:01Z");
        for (text, part) in [
            (point("91", noon), "line 1: latitude 91°"),
            (point("nan", noon), "line 1: latitude NaN°"),
            (point("x", noon), "line 1: the track point has no lat and lon"),
            (point("48", "noon"), "line 1: the track point has no time"),
            (point("48", later) + &point("48", noon), "line 2: the time"),
        ] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
