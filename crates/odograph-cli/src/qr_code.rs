//! An address as a QR code on a terminal, for the camera of a telephone.

use qrcode::render::unicode::Dense1x2;
use qrcode::{EcLevel, QrCode};

/// Black on white, whatever the colours of the terminal: not every telephone reads the inverse.
const COLOURS: &str = "\u{1b}[30;107m";
const RESET: &str = "\u{1b}[0m";

/// The lines of the code, with a quiet zone; `None` for a text that is too long for one.
pub fn lines(text: &str) -> Option<Vec<String>> {
    let code = QrCode::with_error_correction_level(text, EcLevel::L).ok()?;
    let drawn = code.render::<Dense1x2>().dark_color(Dense1x2::Dark).light_color(Dense1x2::Light).build();
    Some(drawn.lines().map(|line| format!("{COLOURS}{line}{RESET}")).collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use qrcode::types::Color;

    /// Whether the module is dark, by the drawing: two rows of modules to a line.
    fn is_dark(lines: &[String], column: usize, row: usize) -> bool {
        let line = lines[row / 2].strip_prefix(COLOURS).unwrap().strip_suffix(RESET).unwrap();
        match (line.chars().nth(column).unwrap(), row % 2) {
            ('█', _) | ('▀', 0) | ('▄', 1) => true,
            (' ' | '▀' | '▄', _) => false,
            (other, _) => panic!("{other:?}"),
        }
    }

    #[test]
    fn every_module_is_drawn_in_a_quiet_zone() {
        let url = "http://192.168.1.20:8080/?token=0123456789abcdef";
        let lines = lines(url).unwrap();
        let code = QrCode::with_error_correction_level(url, EcLevel::L).unwrap();
        let (width, quiet) = (code.width(), 4);
        for row in 0..width {
            for column in 0..width {
                let drawn = is_dark(&lines, column + quiet, row + quiet);
                assert_eq!(drawn, code[(column, row)] == Color::Dark, "{column}, {row}");
            }
        }
        assert!((0..width + 2 * quiet).all(|at| !is_dark(&lines, at, 0) && !is_dark(&lines, 0, at)));
    }

    #[test]
    fn a_text_that_is_too_long_has_no_code() {
        assert_eq!(lines(&"x".repeat(4000)), None);
    }
}
