//! What every report page is made of.

use odograph::mapping::drawing::scale::label;
use odograph::mapping::drawing::svg::escape;
use std::fmt::Write;

/// The style sheet of every page.
pub const STYLE: &str = include_str!("style.css");

/// A page up to its title and what it was made from; `style` is added to the style sheet. The page
/// ends with `</main></body></html>`.
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

/// A box of sentences that a person should know; nothing where there are none.
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

/// A figure with its name and what it says.
pub fn card(name: &str, value: &str, says: &str, page: &mut String) {
    let _ = writeln!(page, "<div class=\"card\"><em>{name}</em><b>{value}</b><small>{says}</small></div>");
}

/// A number with so many decimals; one that rounds to zero has no sign.
pub fn number(value: f64, decimals: usize) -> String {
    label(value, 10f64.powi(-(decimals as i32)))
}
