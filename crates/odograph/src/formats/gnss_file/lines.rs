//! Positions line by line, as a receiver sends them.

use super::{csv, nmea};
use crate::error::Error;
use crate::georeference::GnssFix;

/// Reads CSV or NMEA 0183 line by line, as a receiver sends them. A line that is damaged, cut off
/// or out of order is left out: nothing can be asked for again.
#[derive(Debug, Default)]
pub struct GnssLines {
    /// Number of lines so far.
    lines: usize,
    /// The line with the names of the columns, of CSV.
    header: Option<String>,
    /// Positions of CSV, each with the number of its line.
    rows: Vec<(usize, GnssFix)>,
    sentences: nmea::Sentences,
    left_out: usize,
    first: Option<Error>,
}

/// The positions of a receiver.
#[derive(Debug, Default)]
pub struct ReceivedFixes {
    /// In order of time, each with the number of its first line.
    pub fixes: Vec<(usize, GnssFix)>,
    /// Number of lines that were left out because of what is in them.
    pub left_out: usize,
    /// What was wrong with the first of these.
    pub first: Option<Error>,
}

impl GnssLines {
    /// Takes the next line.
    pub fn push(&mut self, line: &str) {
        let number = self.lines;
        self.lines += 1;
        let line = line.trim_start_matches('\u{feff}').trim();
        if line.is_empty() || line.starts_with('#') {
            return;
        }
        let taken = if line.starts_with(['$', '!']) {
            self.sentences.push(number, line)
        } else if line.to_ascii_lowercase().contains("time_s") {
            // A sender that begins again names its columns again.
            csv(line).map(|_| self.header = Some(line.to_owned()))
        } else if let Some(header) = &self.header {
            csv(&format!("{header}\n{line}\n"))
                .map(|fixes| self.rows.extend(fixes.into_iter().map(|fix| (number, fix))))
        } else {
            // The rest of a line of which the beginning was missed.
            return;
        };
        if let Err(error) = taken {
            self.leave_out(error, number);
        }
    }

    fn leave_out(&mut self, error: Error, line: usize) {
        self.left_out += 1;
        // The error counts from the header.
        let why = error.to_string();
        let why = match why.strip_prefix("line ") {
            Some(rest) => {
                rest.trim_start_matches(|c: char| c.is_ascii_digit()).trim_start_matches([':', ' '])
            }
            None => &why,
        };
        self.first.get_or_insert_with(|| Error::input(format!("line {}: {why}", line + 1)));
    }

    /// The positions so far. Of CSV and NMEA mixed, those of CSV.
    pub fn received(mut self) -> ReceivedFixes {
        let mut fixes = match self.rows.is_empty() {
            true => self.sentences.dated(),
            false => std::mem::take(&mut self.rows),
        };
        let mut before_s = f64::NEG_INFINITY;
        let mut late = Vec::new();
        fixes.retain(|(line, fix)| {
            let is_later = fix.time_s > before_s;
            if is_later {
                before_s = fix.time_s;
            } else {
                late.push((*line, super::not_later(*line, fix.time_s, before_s)));
            }
            is_later
        });
        late.into_iter().for_each(|(line, error)| self.leave_out(error, line));
        ReceivedFixes { fixes, left_out: self.left_out, first: self.first }
    }
}

#[cfg(test)]
mod tests {
    use super::super::parse;
    use super::*;
    use proptest::prelude::*;

    fn received(lines: &[&str]) -> ReceivedFixes {
        let mut of = GnssLines::default();
        lines.iter().for_each(|line| of.push(line));
        of.received()
    }

    #[test]
    fn lines_give_what_the_file_gives() {
        let csv = "time_s,latitude_deg,longitude_deg,sigma_m\n1.5,48.2,16.4,0.02\n2.5,48.3,16.5,0.03\n";
        let nmea = "$GNGGA,101233.50,4812.4920,N,01622.4280,E,4,12,0.7,160.0,M,43.5,M,1.0,0001\n\
                    $GNRMC,101233.50,A,4812.4920,N,01622.4280,E,0.5,90.0,040526,,,R\n\
                    $GNGST,101233.50,0.02,,,,0.014,0.011,0.03\n\
                    $GNGGA,101234.50,4812.4930,N,01622.4290,E,4,12,0.7,160.0,M,43.5,M,1.0,0001\n";
        for (text, first_lines) in [(csv, [1, 2]), (nmea, [0, 3])] {
            let lines: Vec<&str> = text.lines().collect();
            let found = received(&lines);
            assert_eq!(found.fixes.iter().map(|(_, fix)| *fix).collect::<Vec<_>>(), parse(text).unwrap());
            assert_eq!(found.fixes.iter().map(|(line, _)| *line).collect::<Vec<_>>(), first_lines);
            assert!(found.left_out == 0 && found.first.is_none());
        }
    }

    #[test]
    fn what_is_damaged_is_left_out() {
        let found = received(&[
            "8.2,16.4,0.02",
            "time_s,lat,lon",
            "1,48.2,16.4",
            "2,48.2",
            "3,99,16.4",
            "time_s,lat,lon",
            "2.5,48.2,16.4",
            "2.5,48.3,16.4",
        ]);
        let times: Vec<f64> = found.fixes.iter().map(|(_, fix)| fix.time_s).collect();
        assert_eq!((times, found.left_out), (vec![1.0, 2.5], 3));
        let first = found.first.unwrap().to_string();
        assert!(first.starts_with("line 4: ") && !first.contains('\n'), "{first}");

        let found = received(&[
            "13.50,4812.4920,N,01622.4280,E,4,12,0.7,160.0,M,43.5,M,1.0,0001",
            "$GNGGA,101233.50,9912.4920,N,01622.4280,E,4,12,0.7,160.0,M,43.5,M,1.0,0001",
            "$GNGGA,101234.50,4812.4930,N,01622.4290,E,4,12,0.7,160.0,M,43.5,M,1.0,0001*00",
            "$GNGGA,101235.50,4812.4930,N,01622.4290,E,4,12,0.7,160.0,M,43.5,M,1.0,0001",
            "$GNGGA,101235.00,4812.4930,N,01622.4290,E,4,12,0.7,160.0,M,43.5,M,1.0,0001",
        ]);
        let times: Vec<f64> = found.fixes.iter().map(|(_, fix)| fix.time_s % 100.0).collect();
        assert_eq!((times, found.left_out), (vec![55.5], 2));
    }

    proptest! {
        #[test]
        fn any_lines_are_survived(lines in proptest::collection::vec("([$][A-Z]{5}(,[0-9.NESWA]{0,9}){0,14})|time_s,lat,lon|.*", 0..9)) {
            let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
            let _ = received(&lines);
        }
    }
}
