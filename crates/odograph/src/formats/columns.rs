//! Tables of numbers, most of them over time: a header line with the column names, then one line
//! per sample.
//!
//! Values are separated by commas, semicolons or white space, and may be in quotation marks. Empty
//! lines and lines that begin with `#` are ignored.

use crate::error::{Error, Result};

/// A table that is being read.
pub struct Columns<'a> {
    lines: Box<dyn Iterator<Item = (usize, &'a str)> + 'a>,
    /// The header, and its line, from 1.
    pub header: &'a str,
    pub header_line: usize,
    names: Vec<&'a str>,
    time: Option<usize>,
    before_s: Option<f64>,
}

/// A line of values.
pub struct Row<'a> {
    /// From 1.
    pub line: usize,
    /// Later than that of the row before; 0 in a table without times.
    pub time_s: f64,
    values: Vec<&'a str>,
}

impl<'a> Columns<'a> {
    /// Reads the header. Fails if there is none.
    pub fn new(text: &'a str) -> Result<Self> {
        let text = text.trim_start_matches('\u{feff}');
        let mut lines = text
            .lines()
            .enumerate()
            .map(|(index, line)| (index + 1, line.trim()))
            .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let (header_line, header) =
            lines.next().ok_or_else(|| Error::input("there is nothing in the file"))?;
        let names: Vec<&str> = words(header).collect();
        let mut columns =
            Self { lines: Box::new(lines), header, header_line, names, time: None, before_s: None };
        columns.time = columns.named("time_s");
        Ok(columns)
    }

    /// The index of a column; upper and lower case are the same.
    pub fn named(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known.eq_ignore_ascii_case(name))
    }

    /// Whether there is a column `time_s`.
    pub fn has_time(&self) -> bool {
        self.time.is_some()
    }

    /// The next row; `None` after the last. Fails, naming the line, if it does not have as many
    /// values as the header, or its time is not later than that before.
    pub fn next_row(&mut self) -> Result<Option<Row<'a>>> {
        let Some((line, text)) = self.lines.next() else { return Ok(None) };
        let values: Vec<&str> = words(text).collect();
        if values.len() != self.names.len() {
            let commas = text.matches(',').count();
            let has_decimal_commas = !self.header.contains(',') && values.len() == self.names.len() + commas;
            let hint = if has_decimal_commas { "; write decimals with a point, 0.5 and not 0,5" } else { "" };
            return Err(Error::input(format!(
                "line {line} has {} value{}, the first line names {} columns{hint}",
                values.len(),
                if values.len() == 1 { "" } else { "s" },
                self.names.len()
            )));
        }
        let mut row = Row { line, time_s: 0.0, values };
        row.time_s = self.time.map_or(Ok(0.0), |time| self.value(&row, time))?;
        let time_s = row.time_s;
        if let Some(before_s) = self.before_s.filter(|&before_s| before_s >= time_s) {
            return Err(Error::input(format!(
                "line {line}: the time {time_s} s is not later than {before_s} s before it; sort the file by time and drop repeated lines"
            )));
        }
        self.before_s = self.time.map(|_| time_s);
        Ok(Some(row))
    }

    /// A value of a row. Fails, naming the line, if it is not a finite number.
    pub fn value(&self, row: &Row<'a>, column: usize) -> Result<f64> {
        match row.values[column].parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(Error::input(format!(
                "line {}: {:?} stands where a finite number belongs ({})",
                row.line,
                shortened(row.values[column]),
                self.names[column]
            ))),
        }
    }
}

/// The values of a line; some programs put names and numbers in quotation marks.
fn words(line: &str) -> impl Iterator<Item = &str> {
    let is_between = |c: char| c.is_whitespace() || c == ',' || c == ';' || c == '"';
    line.split(is_between).filter(|word| !word.is_empty())
}

/// The beginning of a text, for messages.
pub fn shortened(text: &str) -> String {
    text.chars().take(40).collect()
}
