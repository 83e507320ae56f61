//! Timestamps files.

use crate::regular_file::read_regular_file;
use odograph::error::{Error, Result};
use std::io::ErrorKind;
use std::path::Path;

/// Strictly increasing times from a file, seconds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Timestamps {
    /// Image names with their times.
    Named(Vec<(String, f64)>),
    /// Times in the order of the frames.
    InOrder(Vec<f64>),
}

/// Integers from here on are nanoseconds since 1970 (1973 in nanoseconds; far in the future in
/// seconds).
const NANOSECONDS_FROM: f64 = 1e17;
/// No time is later, nor earlier than this before 1970: thirty thousand years, seconds. Beyond it
/// frames at a usual rate cannot be distinguished.
const LATEST_S: f64 = 1e12;
/// Results have times to the nanosecond.
const MIN_STEP_S: f64 = 1e-9;
/// Largest size of a timestamps file, bytes.
const MAX_BYTES: u64 = 256 << 20;

impl Timestamps {
    /// Reads a timestamps file.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = read_regular_file(path, MAX_BYTES).map_err(|error| {
            let why = match error.kind() {
                ErrorKind::FileTooLarge => {
                    format!(
                        "the timestamps are larger than {} MiB; it is not the file meant",
                        MAX_BYTES >> 20
                    )
                }
                _ => format!("the timestamps cannot be read: {error}"),
            };
            Error::input(why).caused_by(error).at(path.display())
        })?;
        let text = String::from_utf8(bytes).map_err(|error| {
            Error::input("the timestamps are not text").caused_by(error).at(path.display())
        })?;
        Self::parse(&text).map_err(|error| error.at(path.display()))
    }

    pub fn into_times(self) -> Vec<f64> {
        match self {
            Self::Named(named) => named.into_iter().map(|(_, time_s)| time_s).collect(),
            Self::InOrder(times) => times,
        }
    }

    fn parse(text: &str) -> Result<Self> {
        let text = text.trim_start_matches('\u{feff}');
        let nanoseconds_said = text.lines().any(|l| l.contains("[ns]"));
        let mut named = Vec::new();
        let mut in_order = Vec::new();
        let mut before: Option<f64> = None;
        let mut first = true;
        for (index, line) in text.lines().enumerate() {
            let number = index + 1;
            let line = line.split('#').next().unwrap_or("").trim();
            if line.is_empty() {
                continue;
            }
            let mut fields =
                line.split(|c: char| c == ',' || c == ';' || c.is_whitespace()).filter(|f| !f.is_empty());
            let (one, two) = (fields.next().unwrap_or(""), fields.next());
            let seconds = |field: &str| seconds(field, nanoseconds_said);
            let (time_s, name) = match (seconds(one), two.map(|t| (t, seconds(t)))) {
                (Some(time_s), None) => (time_s, None),
                (Some(time_s), Some((name, None))) => (time_s, Some(name)),
                (None, Some((_, Some(time_s)))) => (time_s, Some(one)),
                (Some(_), Some((_, Some(_)))) => {
                    return Err(Error::input(format!(
                        "line {number} has two numbers, and it is not clear which is the time; write `seconds name`"
                    )));
                }
                // Header line of a table.
                (None, _) if first => {
                    first = false;
                    continue;
                }
                (None, _) => return Err(Error::input(format!("line {number} has no time: {line}"))),
            };
            first = false;
            if let Some(before) = before.filter(|&before| time_s <= before) {
                return Err(Error::input(format!(
                    "line {number}: the time {time_s:?} s does not come after the {before:?} s before it"
                )));
            }
            if before.is_some_and(|before| time_s - before < MIN_STEP_S) {
                return Err(Error::input(format!(
                    "line {number}: the time {time_s:?} s comes less than a nanosecond after the one before it"
                )));
            }
            if time_s.abs() > LATEST_S {
                return Err(Error::input(format!(
                    "line {number}: {time_s:?} s cannot be the time of a frame; write seconds, or whole nanoseconds since 1970"
                )));
            }
            before = Some(time_s);
            match name {
                Some(name) => named.push((name.to_string(), time_s)),
                None => in_order.push(time_s),
            }
        }
        match (named.is_empty(), in_order.is_empty()) {
            (true, true) => Err(Error::input("there are no timestamps in this file")),
            (false, true) => Ok(Self::Named(named)),
            (true, false) => Ok(Self::InOrder(in_order)),
            (false, false) => Err(Error::input("some lines name a picture and some do not")),
        }
    }
}

/// Parses a finite number of seconds; integers too large for seconds are nanoseconds.
fn seconds(field: &str, nanoseconds_said: bool) -> Option<f64> {
    let value: f64 = field.parse().ok().filter(|v: &f64| v.is_finite())?;
    if field.bytes().all(|b| b.is_ascii_digit()) && (nanoseconds_said || value >= NANOSECONDS_FROM) {
        return seconds_from_digits(field, 9);
    }
    Some(value)
}

/// Converts an integer multiple of 10^-`decimals` seconds; split before the conversion to keep
/// precision.
fn seconds_from_digits(digits: &str, decimals: usize) -> Option<f64> {
    let value: u64 = digits.parse().ok()?;
    let unit = 10u64.checked_pow(decimals as u32)?;
    Some((value / unit) as f64 + (value % unit) as f64 / unit as f64)
}

/// Time from a file name that is plausibly a timestamp: decimal seconds since 1970
/// (`1305031102.175304`), or integer nano-, micro- or milliseconds since 1970, in the years 1990 to
/// 2100.
pub(crate) fn time_from_name(stem: &str) -> Option<f64> {
    const YEARS_S: std::ops::Range<f64> = 631_152_000.0..4_102_444_800.0;
    let time_s = if stem.contains('.') {
        let plain = stem.bytes().all(|b| b.is_ascii_digit() || b == b'.');
        stem.parse().ok().filter(|_| plain)?
    } else if stem.bytes().all(|b| b.is_ascii_digit()) {
        seconds_from_digits(
            stem,
            match stem.len() {
                18 | 19 => 9,
                15 | 16 => 6,
                12 | 13 => 3,
                _ => return None,
            },
        )?
    } else {
        return None;
    };
    YEARS_S.contains(&time_s).then_some(time_s)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn absurd_times_are_refused() {
        for (text, line) in [("0\n1e300\n", 2), ("-1e13\n", 1)] {
            let message = Timestamps::parse(text).unwrap_err().to_string();
            assert!(
                message.starts_with(&format!("line {line}: ")) && message.contains("write seconds"),
                "{message}"
            );
        }
        assert!(Timestamps::parse("1700000000.0 a.png\n").is_ok());
    }

    #[test]
    fn tum_with_columns_in_either_order() {
        let tum =
            "# timestamp filename\n1305031102.175304 rgb/1305031102.175304.png\n1305031102.2 rgb/b.png\n";
        let expected = Timestamps::Named(vec![
            ("rgb/1305031102.175304.png".into(), 1305031102.175304),
            ("rgb/b.png".into(), 1305031102.2),
        ]);
        assert_eq!(Timestamps::parse(tum).unwrap(), expected);
        assert_eq!(
            Timestamps::parse("a.png 0.5\nb.png 1").unwrap(),
            Timestamps::Named(vec![("a.png".into(), 0.5), ("b.png".into(), 1.0)])
        );
    }

    #[test]
    fn euroc_nanoseconds() {
        let csv = "#timestamp [ns],filename\n1403715273262142976,1403715273262142976.png\n1403715273312143104,x.png\r\n";
        let Timestamps::Named(named) = Timestamps::parse(csv).unwrap() else { panic!() };
        assert!((named[0].1 - 1_403_715_273.262_143).abs() < 1e-6);
        assert_eq!(named[1].0, "x.png");
        let relative = "timestamp [ns],filename\n0,a.png\n50000000,b.png\n";
        assert_eq!(Timestamps::parse(relative).unwrap().into_times(), [0.0, 0.05]);
    }

    #[test]
    fn bare_numbers_in_order() {
        assert_eq!(
            Timestamps::parse("0\n0.1 # x\n\n0.25\n").unwrap(),
            Timestamps::InOrder(vec![0.0, 0.1, 0.25])
        );
    }

    #[test]
    fn invalid_files_fail_with_one_sentence() {
        for text in [
            "",
            "# only\n",
            "0 a\n0 b\n",
            "1 a\n0.5 b\n",
            "0 1\n",
            "nan a\ninf b\nx y\n",
            "0 a\n1\n",
            "0 a\nfoo bar\n",
        ] {
            let error = Timestamps::parse(text).unwrap_err().to_string();
            assert!(!error.contains('\n') && error.len() > 10, "{text:?}: {error}");
        }
    }

    #[test]
    fn names_that_are_times() {
        assert!((time_from_name("1403715273262142976").unwrap() - 1_403_715_273.262_143).abs() < 1e-6);
        assert_eq!(time_from_name("1305031102.175304"), Some(1305031102.175304));
        assert_eq!(time_from_name("000042"), None);
        assert_eq!(time_from_name("img_1"), None);
        assert_eq!(time_from_name("99999"), None);
    }
}
