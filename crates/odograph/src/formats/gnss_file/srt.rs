//! Subtitles (SubRip) as drones of DJI write them beside a video: each has what was measured at its
//! time, `[latitude: 46.9] [longitude: 7.4] [rel_alt: 80.0 abs_alt: 620.0]`, or, of earlier models,
//! `GPS(7.4,46.9,14)` with the longitude first.

use super::utc::{decimal, whole};
use super::{not_later, place};
use crate::error::{Error, Result};
use crate::georeference::GnssFix;

/// Whether a text is of subtitles: a line with the span of the first is among its first.
pub fn is_one(text: &str) -> bool {
    text.lines().take(4).any(|line| start_s(line).is_some())
}

/// Reads the position of each subtitle, at its start. Left out are repetitions, which are of the
/// same measurement, and 0°, 0°, which a receiver without a fix reports.
pub fn parse(text: &str) -> Result<Vec<GnssFix>> {
    let mut fixes: Vec<GnssFix> = Vec::new();
    let mut lines = text.lines().enumerate().peekable();
    let mut before_deg = (0.0, 0.0);
    while let Some((number, line)) = lines.next() {
        let Some(time_s) = start_s(line) else { continue };
        let mut said = String::new();
        while let Some((_, line)) = lines.next_if(|(_, line)| !line.contains("-->")) {
            said.push_str(line);
            said.push(' ');
        }
        let Some(place_deg) = place_deg(&said).filter(|&place_deg| place_deg != before_deg) else { continue };
        before_deg = place_deg;
        if place_deg == (0.0, 0.0) {
            continue;
        }
        let line = number + 1;
        let place = place(line, place_deg.0, place_deg.1)?;
        if let Some(before) = fixes.last().filter(|before| before.time_s >= time_s) {
            return Err(not_later(line, time_s, before.time_s));
        }
        let sigma_m = GnssFix::USUAL_SIGMA_M;
        let altitude_m = ["abs_alt", "[altitude"].iter().find_map(|name| value(&said, name));
        fixes.push(GnssFix {
            time_s,
            place,
            altitude_m,
            covariance_m2: GnssFix::covariance_m2(sigma_m, sigma_m),
        });
    }
    if fixes.is_empty() {
        return Err(Error::input(
            "there is no position in the subtitles; drones of DJI write them if captions are switched on, and only \
             while they receive satellites",
        ));
    }
    Ok(fixes)
}

/// Start of a span such as `00:01:02,033 --> 00:01:02,066`.
fn start_s(line: &str) -> Option<f64> {
    let (start, _) = line.split_once("-->")?;
    let start = start.trim().replace(',', ".");
    let mut parts = start.splitn(3, ':');
    let (hours, minutes) = (whole(parts.next()?, 3)?, whole(parts.next()?, 2)?);
    Some((3600 * hours + 60 * minutes) as f64 + decimal(parts.next()?)?)
}

/// Latitude and longitude, degrees.
fn place_deg(said: &str) -> Option<(f64, f64)> {
    // Some models misspell it.
    let longitude = ["[longitude", "[longtitude"].iter().find_map(|name| value(said, name));
    value(said, "[latitude").zip(longitude).or_else(|| {
        let (_, after) = said.split_once("GPS")?;
        let (inside, _) = after.trim_start().strip_prefix('(')?.split_once(')')?;
        let mut numbers = inside.split(',').map(|number| number.trim().parse::<f64>().ok());
        let (longitude_deg, latitude_deg) = (numbers.next()??, numbers.next()??);
        Some((latitude_deg, longitude_deg))
    })
}

/// The number after a name and a colon, which some models leave out.
fn value(said: &str, name: &str) -> Option<f64> {
    let (_, after) = said.split_once(name)?;
    let after = after.trim_start_matches([' ', ':']);
    let end = after.find(|c: char| !(c.is_ascii_digit() || "+-.".contains(c))).unwrap_or(after.len());
    after[..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_new_position_is_read_at_the_start_of_its_subtitle() {
        let cue = |number: usize, span: &str, said: &str| {
            format!(
                "{number}\r\n{span}\r\n<font size=\"28\">FrameCnt: {number}, DiffTime: 33ms\r\n2026-05-04 10:12:33.380\r\n\
                     [iso: 100] [shutter: 1/3200.0] [fnum: 1.7] [ev: 0] {said} [ct: 5310] </font>\r\n\r\n"
            )
        };
        let text = [
            cue(
                1,
                "00:00:00,000 --> 00:00:00,033",
                "[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 0.0 abs_alt: 0.0]",
            ),
            cue(
                2,
                "00:00:00,033 --> 00:00:00,066",
                "[latitude: 48.208200] [longitude: 16.373800] [rel_alt: 1.300 abs_alt: 180.500]",
            ),
            cue(
                3,
                "00:00:00,066 --> 00:00:00,100",
                "[latitude: 48.208200] [longitude: 16.373800] [rel_alt: 1.400 abs_alt: 180.600]",
            ),
            cue(
                4,
                "00:01:00,100 --> 00:01:00,133",
                "[latitude : 48.208201] [longtitude : 16.373800] [altitude: 181.0]",
            ),
            cue(5, "01:00:00,000 --> 01:00:01,000", "GPS(16.3739,48.2082,14) BAROMETER:1.9"),
            cue(6, "01:00:01,000 --> 01:00:02,000", "no position"),
        ]
        .concat();
        assert!(is_one(&text));
        let fixes = super::super::parse(&text).unwrap();
        let read: Vec<(f64, Option<f64>)> = fixes.iter().map(|fix| (fix.time_s, fix.altitude_m)).collect();
        assert_eq!(read, [(0.033, Some(180.5)), (60.1, Some(181.0)), (3600.0, None)]);
        let last = fixes[2].place;
        assert!((last.latitude_rad.to_degrees() - 48.2082).abs() < 1e-12);
        assert!((last.longitude_rad.to_degrees() - 16.3739).abs() < 1e-12);
        assert_eq!(last.latitude_rad.to_bits(), fixes[0].place.latitude_rad.to_bits());
        assert_eq!(fixes[0].covariance_m2[(0, 0)], 9.0);
    }

    #[test]
    fn what_cannot_be_is_refused_with_its_line() {
        let cue = |time: &str, latitude: &str| {
            format!("1\n00:00:{time} --> 00:01:00,000\n[latitude: {latitude}] [longitude: 16]\n\n")
        };
        for (text, part) in [
            (cue("01,000", "91"), "line 2: latitude 91°"),
            (
                cue("02,000", "48") + &cue("01,000", "49"),
                "line 6: the time 1.000 s is not later than 2.000 s",
            ),
            (cue("01,000", "none"), "there is no position in the subtitles"),
        ] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
