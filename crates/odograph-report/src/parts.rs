//! Elements common to all report pages.

use odograph::drawing::scale::{label, length_text};
use odograph::drawing::svg::escape;
use std::fmt::Write;

/// The style sheet of all pages.
pub const STYLE: &str = include_str!("style.css");

/// The beginning of a page, up to its title and source; `style` is added to the style sheet. The
/// page ends with `</main></body></html>`.
pub fn head(title: &str, source: &str, style: &str) -> String {
    let title = escape(title);
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{title} – odograph</title>\n<style>\n{STYLE}{style}</style>\n</head>\n<body>\n<main>\n\
         <h1>{title}</h1>\n<p class=\"quiet\">{}</p>\n",
        escape(source),
    )
}

/// A box of warnings; empty if there are none.
pub fn warnings(warnings: &[String], page: &mut String) {
    if warnings.is_empty() {
        return;
    }
    page.push_str("<div class=\"box warnings\"><b>To be aware of</b><ul>");
    for warning in warnings {
        let _ = write!(page, "<li>{}</li>", escape(warning));
    }
    page.push_str("</ul></div>\n");
}

/// A value with its name and explanation.
pub fn card(name: &str, value: &str, says: &str, page: &mut String) {
    let _ = writeln!(page, "<div class=\"card\"><em>{name}</em><b>{value}</b><small>{says}</small></div>");
}

/// Lengths in one unit, that of the longest, so that they can be compared.
pub fn lengths_text<const N: usize>(lengths_m: [f64; N]) -> [String; N] {
    let (unit, size_m, decimals) = match lengths_m.into_iter().fold(0.0, f64::max) {
        far if far >= 0.9995 => ("m", 1.0, 3),
        near if near >= 0.09995 => ("mm", 1e-3, 1),
        near if near >= 1e-5 || near == 0.0 => ("mm", 1e-3, 2),
        _ => ("µm", 1e-6, 2),
    };
    lengths_m.map(|length_m| format!("{} {unit}", number(length_m / size_m, decimals)))
}

/// Formats a number with `decimals` decimals; a value that rounds to zero has no sign.
pub fn number(value: f64, decimals: usize) -> String {
    label(value, 10f64.powi(-(decimals as i32)))
}

/// The length of a path, to the centimetre as the program prints it. What is far below a wavelength
/// of light is nothing.
pub fn distance_text(distance_m: f64) -> String {
    match distance_m {
        d if d < 1e-7 => length_text(0.0),
        d if (1.0..10_000.0).contains(&d) => format!("{d:.2} m"),
        d => length_text(d),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_stands_has_travelled_nothing() {
        assert_eq!(distance_text(6e-9), "0 m");
        assert_eq!(distance_text(2.5e-6), "2.50 µm");
        assert_eq!(distance_text(12.834), "12.83 m");
        assert_eq!(distance_text(0.5), "50.0 cm");
    }
}
