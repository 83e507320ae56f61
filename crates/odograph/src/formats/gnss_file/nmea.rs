//! NMEA 0183: GGA (position and its quality), RMC (position and date), GST (standard deviations).

use super::utc::{days, decimal, whole};
use super::{not_later, place};
use crate::error::{Error, Result};
use crate::geometry::EarthPosition;
use crate::georeference::GnssFix;

const DAY_S: f64 = 86_400.0;

/// What the sentences of one time say.
#[derive(Debug, Clone)]
struct Epoch {
    line: usize,
    /// Seconds since midnight.
    time_of_day_s: f64,
    /// Days since 1970, where a sentence had the date.
    day: Option<i64>,
    place: Option<EarthPosition>,
    altitude_m: Option<f64>,
    /// By the quality, and by GST, east and north.
    usual_m: Option<f64>,
    sigmas_m: Option<[f64; 2]>,
}

/// Sentences as they come, by their times.
#[derive(Debug, Default)]
pub struct Sentences {
    epochs: Vec<Epoch>,
}

impl Sentences {
    /// Takes a line, which is numbered from 0. Fails if a position is impossible.
    pub fn push(&mut self, number: usize, line: &str) -> Result<()> {
        let Some(fields) = sentence(line) else { return Ok(()) };
        let Some(time_of_day_s) = fields.get(1).and_then(|time| time_of_day(time)) else { return Ok(()) };
        let kind = fields[0].get(2..).unwrap_or_default();
        if !["GGA", "RMC", "GST"].contains(&kind) {
            return Ok(());
        }
        let line = number + 1;
        if self.epochs.last().is_none_or(|last| last.time_of_day_s != time_of_day_s) {
            self.epochs.push(Epoch {
                line,
                time_of_day_s,
                day: None,
                place: None,
                altitude_m: None,
                usual_m: None,
                sigmas_m: None,
            });
        }
        let Some(epoch) = self.epochs.last_mut() else { return Ok(()) };
        match kind {
            "GGA" => gga(&fields, line, epoch),
            "RMC" => rmc(&fields, line, epoch),
            _ => {
                gst(&fields, epoch);
                Ok(())
            }
        }
    }

    /// The positions with the numbers of their first lines, in the order of the lines.
    pub fn dated(&self) -> Vec<(usize, GnssFix)> {
        let dated = self.epochs.iter().zip(times_s(&self.epochs));
        dated.filter_map(|(epoch, time_s)| Some((epoch.line - 1, epoch.fix(time_s)?))).collect()
    }
}

impl Epoch {
    /// The position at this time; `None` where there is none.
    fn fix(&self, time_s: f64) -> Option<GnssFix> {
        let place = self.place.filter(|_| self.usual_m != Some(f64::INFINITY))?;
        let usual_m = self.usual_m.unwrap_or(GnssFix::USUAL_SIGMA_M);
        let [east_m, north_m] = self.sigmas_m.unwrap_or([usual_m; 2]);
        let covariance_m2 = GnssFix::covariance_m2(east_m, north_m);
        Some(GnssFix { time_s, place, altitude_m: self.altitude_m, covariance_m2 })
    }
}

/// Reads the positions.
pub fn parse(text: &str) -> Result<Vec<GnssFix>> {
    let mut sentences = Sentences::default();
    text.lines().enumerate().try_for_each(|(number, line)| sentences.push(number, line))?;
    fixes(&sentences.epochs)
}

/// The fields of a sentence without its checksum, the first as `GPGGA`; `None` if it is cut off or
/// damaged, as those of a serial line sometimes are.
fn sentence(line: &str) -> Option<Vec<&str>> {
    let body = line.trim().strip_prefix(['$', '!'])?;
    let body = match body.rsplit_once('*') {
        Some((body, sum)) => {
            let stated = u8::from_str_radix(sum.get(..2)?, 16).ok()?;
            (body.bytes().fold(0, |sum, byte| sum ^ byte) == stated).then_some(body)?
        }
        None => body,
    };
    Some(body.split(',').collect())
}

/// Seconds since midnight of `hhmmss.ss`.
fn time_of_day(text: &str) -> Option<f64> {
    let (hours, minutes) = (whole(text.get(..2)?, 2)?, whole(text.get(2..4)?, 2)?);
    let seconds = decimal(text.get(4..)?)?;
    (hours < 24 && minutes < 60 && seconds < 61.0).then(|| (3600 * hours + 60 * minutes) as f64 + seconds)
}

/// Latitude and longitude at a field: `ddmm.mmmm,N,dddmm.mmmm,E`; `None` where a field is empty.
fn position(fields: &[&str], at: usize, line: usize) -> Result<Option<EarthPosition>> {
    let degrees = |at: usize, digits: usize, positive: &str, negative: &str| -> Option<f64> {
        let text = fields.get(at)?;
        let (degrees, minutes) = (whole(text.get(..digits)?, 3)? as f64, decimal(text.get(digits..)?)?);
        let side = fields.get(at + 1)?;
        let magnitude = degrees + minutes / 60.0;
        match *side {
            side if side == positive => Some(magnitude),
            side if side == negative => Some(-magnitude),
            _ => None,
        }
    };
    let (Some(latitude), Some(longitude)) = (degrees(at, 2, "N", "S"), degrees(at + 2, 3, "E", "W")) else {
        return Ok(None);
    };
    place(line, latitude, longitude).map(Some)
}

/// Standard deviation by GGA's quality, metres; `None` where it is no position of satellites.
fn usual_sigma_m(quality: &str, dilution: Option<f64>) -> Option<f64> {
    match quality {
        "1" | "3" => {
            Some(dilution.map_or(GnssFix::USUAL_SIGMA_M, |dilution| GnssFix::RANGE_ERROR_M * dilution))
        }
        // Differential, RTK fixed, RTK float.
        "2" => Some(1.0),
        "4" => Some(0.02),
        "5" => Some(0.3),
        _ => None,
    }
}

fn gga(fields: &[&str], line: usize, epoch: &mut Epoch) -> Result<()> {
    let number =
        |at: usize| fields.get(at).and_then(|text| text.parse::<f64>().ok()).filter(|n| n.is_finite());
    let Some(usual_m) = fields.get(6).and_then(|quality| usual_sigma_m(quality, number(8))) else {
        // Without a position, whatever other sentences of this time say.
        (epoch.place, epoch.usual_m) = (None, Some(f64::INFINITY));
        return Ok(());
    };
    epoch.place = position(fields, 2, line)?;
    epoch.usual_m = Some(usual_m);
    // Above the geoid, and the geoid above the ellipsoid.
    epoch.altitude_m = number(9).map(|above_geoid_m| above_geoid_m + number(11).unwrap_or(0.0));
    Ok(())
}

fn rmc(fields: &[&str], line: usize, epoch: &mut Epoch) -> Result<()> {
    let date = fields.get(9).filter(|date| date.len() == 6);
    epoch.day = date.and_then(|date| {
        let part = |at: usize| date.get(at..at + 2).and_then(|part| whole(part, 2));
        let year = part(4)?;
        days(if year < 80 { 2000 + year } else { 1900 + year }, part(2)?, part(0)?)
    });
    let is_valid = fields.get(2) == Some(&"A");
    if is_valid && epoch.usual_m.is_none() {
        epoch.place = position(fields, 3, line)?;
    }
    Ok(())
}

fn gst(fields: &[&str], epoch: &mut Epoch) {
    let sigma =
        |at: usize| fields.get(at).and_then(|text| text.parse::<f64>().ok()).filter(|&sigma| sigma > 0.0);
    if let (Some(north_m), Some(east_m)) = (sigma(6), sigma(7)) {
        epoch.sigmas_m = Some([east_m, north_m]);
    }
}

/// The times of the epochs, seconds since 1970: the date is that of the nearest earlier sentence
/// with one, otherwise of a later one; midnight begins the next day.
fn times_s(epochs: &[Epoch]) -> Vec<f64> {
    let mut day = 0;
    // Days since the first epoch's.
    let mut since: Vec<i64> = Vec::with_capacity(epochs.len());
    for (k, epoch) in epochs.iter().enumerate() {
        if k > 0 && epoch.time_of_day_s < epochs[k - 1].time_of_day_s - DAY_S / 2.0 {
            day += 1;
        }
        since.push(day);
    }
    let first = epochs.iter().zip(&since).find_map(|(epoch, since)| Some(epoch.day? - since));
    let mut offset = first.unwrap_or(0);
    let time_s = |(epoch, since): (&Epoch, &i64)| {
        offset = epoch.day.map_or(offset, |day| day - since);
        (offset + since) as f64 * DAY_S + epoch.time_of_day_s
    };
    epochs.iter().zip(&since).map(time_s).collect()
}

/// The positions. Fails if a time is not later than the one before, or if there is none.
fn fixes(epochs: &[Epoch]) -> Result<Vec<GnssFix>> {
    let times_s = times_s(epochs);
    let mut before_s = f64::NEG_INFINITY;
    for (epoch, &time_s) in epochs.iter().zip(&times_s) {
        if time_s <= before_s {
            return Err(not_later(epoch.line, time_s, before_s));
        }
        before_s = time_s;
    }
    let fixes: Vec<GnssFix> =
        epochs.iter().zip(times_s).filter_map(|(epoch, time_s)| epoch.fix(time_s)).collect();
    if fixes.is_empty() {
        return Err(Error::input(
            "there is no position in the sentences: none of GGA with a fix, none of RMC",
        ));
    }
    Ok(fixes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summed(body: &str) -> String {
        format!("${body}*{:02X}\n", body.bytes().fold(0, |sum, byte| sum ^ byte))
    }

    #[test]
    fn sentences_of_a_time_make_one_position() {
        let text = [
            summed("GNGGA,101233.50,4812.4920,N,01622.4280,E,4,12,0.7,160.0,M,43.5,M,1.0,0001"),
            summed("GNGST,101233.50,0.02,,,,0.014,0.011,0.03"),
            summed("GNRMC,101233.50,A,4812.4920,N,01622.4280,E,0.5,90.0,040526,,,R"),
            summed("GPGSV,1,1,00"),
            summed("GNGGA,101234.50,4812.4930,S,01622.4290,W,1,12,2.0,,M,,M,,"),
            summed("GNGGA,101235.50,4812.4930,S,01622.4290,W,0,12,2.0,,M,,M,,"),
            "$GNGGA,101236.50,4812.4930,S,01622.4290,W,1,12,2.0,,M,,M,,*00\nnoise\n".to_owned(),
        ]
        .concat();
        let fixes = parse(&text).unwrap();
        assert_eq!(fixes.len(), 2);
        assert_eq!((fixes[0].time_s, fixes[0].altitude_m), (1_777_889_553.5, Some(203.5)));
        let degrees = (fixes[0].place.latitude_rad.to_degrees(), fixes[0].place.longitude_rad.to_degrees());
        assert!((degrees.0 - 48.2082).abs() < 1e-10 && (degrees.1 - 16.3738).abs() < 1e-10);
        let sigmas = fixes[0].covariance_m2.diagonal().map(f64::sqrt);
        assert!((sigmas[0] - 0.011).abs() < 1e-12 && (sigmas[1] - 0.014).abs() < 1e-12);
        assert_eq!((fixes[1].time_s, fixes[1].altitude_m), (1_777_889_554.5, None));
        assert!((fixes[1].covariance_m2[(0, 0)] - 25.0).abs() < 1e-12);
        assert!(fixes[1].place.latitude_rad < 0.0 && fixes[1].place.longitude_rad < 0.0);
    }

    #[test]
    fn midnight_begins_the_next_day() {
        let text = [
            summed("GPGGA,235959.00,4812.4920,N,01622.4280,E,1,12,1,,M,,M,,"),
            summed("GPRMC,000000.00,A,4812.4920,N,01622.4280,E,0.5,90.0,050526,,,A"),
        ]
        .concat();
        let fixes = parse(&text).unwrap();
        assert_eq!(fixes[1].time_s - fixes[0].time_s, 1.0);
        assert_eq!(fixes[1].time_s, 1_777_939_200.0);
    }

    #[test]
    fn what_cannot_be_is_refused_with_its_line() {
        let late = summed("GPGGA,100001.00,4812.4920,N,01622.4280,E,1,12,1,,M,,M,,");
        let early = summed("GPGGA,100000.00,4812.4920,N,01622.4280,E,1,12,1,,M,,M,,");
        let pole = summed("GPGGA,100000.00,9112.4920,N,01622.4280,E,1,12,1,,M,,M,,");
        let none = summed("GPGGA,100000.00,,,,,0,00,,,M,,M,,");
        for (text, part) in [
            (late + &early, "line 2: the time 36000.000 s is not later than 36001.000 s"),
            (pole, "line 1: latitude 91.2"),
            (none, "no position in the sentences"),
        ] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
