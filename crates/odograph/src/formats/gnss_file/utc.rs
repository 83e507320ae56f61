//! Dates and times of day in UTC as seconds since 1970. Leap seconds are not counted, as in POSIX.

/// Days from 1970-01-01 to a date of the Gregorian calendar; `None` where there is no such date.
/// (H. Hinnant, "chrono-compatible low-level date algorithms", `days_from_civil`.)
pub fn days(year: i64, month: i64, day: i64) -> Option<i64> {
    let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let longest = match month {
        2 => 28 + i64::from(leap),
        4 | 6 | 9 | 11 => 30,
        1..=12 => 31,
        _ => return None,
    };
    if !(1..=longest).contains(&day) || !(1970..=9999).contains(&year) {
        return None;
    }
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let year_of_era = year.rem_euclid(400);
    let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let day_of_era = year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year;
    Some(era * 146_097 + day_of_era - 719_468)
}

/// A time as `2026-05-04T10:12:33.5Z`, or with an offset as `+02:00`, in seconds since 1970;
/// `None` if it is none. Without either it is taken to be UTC.
pub fn parse_utc(text: &str) -> Option<f64> {
    let (date, time) = text.trim().split_once(['T', 't', ' '])?;
    let mut parts = date.splitn(3, '-').map(|part| whole(part, 4));
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    let sign = |c: char| c == '+' || c == '-';
    let (time, offset_s) = if let Some(time) = time.strip_suffix(['Z', 'z']) {
        (time, 0)
    } else if let Some(at) = time.find(sign) {
        let (hours, minutes) = time[at + 1..].split_once(':').unwrap_or((&time[at + 1..], "0"));
        let offset_s = 3600 * whole(hours, 2)? + 60 * whole(minutes, 2)?;
        (&time[..at], if time[at..].starts_with('-') { -offset_s } else { offset_s })
    } else {
        (time, 0)
    };
    let mut parts = time.splitn(3, ':');
    let (hours, minutes) = (whole(parts.next()?, 2)?, whole(parts.next()?, 2)?);
    let seconds: f64 = parts.next().map_or(Some(0.0), decimal)?;
    if hours > 23 || minutes > 59 || seconds >= 61.0 {
        return None;
    }
    let whole_s = 86_400 * days(year, month, day)? + 3600 * hours + 60 * minutes - offset_s;
    Some(whole_s as f64 + seconds)
}

/// A number of at most `digits` digits.
pub fn whole(text: &str, digits: usize) -> Option<i64> {
    let is_one = !text.is_empty() && text.len() <= digits && text.bytes().all(|b| b.is_ascii_digit());
    is_one.then(|| text.parse().ok()).flatten()
}

/// A number of digits with a point.
pub fn decimal(text: &str) -> Option<f64> {
    let is_one = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit() || b == b'.');
    is_one.then(|| text.parse().ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_seconds_since_1970() {
        // `date -u -d 2026-05-04T10:12:33Z +%s`
        assert_eq!(parse_utc("2026-05-04T10:12:33.5Z"), Some(1_777_889_553.5));
        assert_eq!(parse_utc("2026-05-04T12:12:33.5+02:00"), Some(1_777_889_553.5));
        assert_eq!(parse_utc("2026-05-04 10:12:33.5"), Some(1_777_889_553.5));
        assert_eq!(parse_utc("2000-02-29T00:00:00Z"), Some(951_782_400.0));
        assert_eq!(parse_utc("1970-01-01T00:00Z"), Some(0.0));
        for text in
            ["", "2026-05-04", "2026-02-30T00:00:00Z", "2026-13-01T00:00:00Z", "aT", "2026-05-04T25:00:00Z"]
        {
            assert_eq!(parse_utc(text), None, "{text}");
        }
    }
}
