//! A page as an SVG drawing whose unit is a millimetre.

use super::page::{DiscMm, Page, RectangleMm, TextMm};
use std::fmt::Write;

/// The drawing.
pub fn svg(page: &Page) -> String {
    let (width, height) = (page.paper.width_mm, page.paper.height_mm);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
    );
    // One path, so that no viewer draws a hair line between rectangles that touch.
    svg.push_str("<path d=\"");
    for RectangleMm { x, y, width, height } in &page.rectangles {
        let _ = write!(svg, "M{} {}h{}v{}h-{}z", mm(*x), mm(*y), mm(*width), mm(*height), mm(*width));
    }
    svg.push_str("\"/>\n");
    for DiscMm { x, y, radius } in &page.discs {
        let _ = writeln!(svg, "<circle cx=\"{}\" cy=\"{}\" r=\"{}\"/>", mm(*x), mm(*y), mm(*radius));
    }
    svg.push_str(&texts(&page.texts, 0.0, 0.0, 1.0));
    svg.push_str("</svg>\n");
    svg
}

/// Lines of text as elements, moved to the left and up and then magnified.
pub fn texts(texts: &[TextMm], left_mm: f64, top_mm: f64, scale: f64) -> String {
    let line = |TextMm { x, y, size, text }: &TextMm| {
        let (x, y, size) = (mm((x - left_mm) * scale), mm((y - top_mm) * scale), mm(size * scale));
        // The text of a board needs no XML escapes.
        format!(
            "<text x=\"{x}\" y=\"{y}\" font-size=\"{size}\" font-family=\"Roboto, Helvetica, Arial, sans-serif\">{text}</text>\n"
        )
    };
    texts.iter().map(line).collect()
}

/// A hundredth of a micrometre is finer than anything printed.
fn mm(value: f64) -> f64 {
    (value * 1e5).round() / 1e5
}
