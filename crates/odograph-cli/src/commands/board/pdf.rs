//! A page as a PDF document.

use super::page::{DiscMm, Page, RectangleMm, TextMm};
use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str};

/// Points to a millimetre.
const POINTS: f64 = 72.0 / 25.4;
/// How far the control points of a quarter of a circle are from its ends, in radii: the curve
/// leaves the circle by less than 3 parts in 10 000 (M. Goldapp, "Approximation of circular arcs by
/// cubic polynomials", 1991).
const QUARTER: f64 = 0.552_284_749_830_793_6;

/// The document: one page of the paper's size, which asks not to be scaled when it is printed.
pub fn pdf(page: &Page) -> Vec<u8> {
    let [catalog, pages, sheet, font, content] = [1, 2, 3, 4, 5].map(Ref::new);
    let font_name = Name(b"F1");
    let mut pdf = Pdf::new();
    let mut root = pdf.catalog(catalog);
    root.pages(pages);
    root.insert(Name(b"ViewerPreferences")).dict().pair(Name(b"PrintScaling"), Name(b"None"));
    root.finish();
    pdf.pages(pages).kids([sheet]).count(1);
    let mut leaf = pdf.page(sheet);
    leaf.media_box(Rect::new(0.0, 0.0, points(page.paper.width_mm), points(page.paper.height_mm)));
    leaf.parent(pages);
    leaf.contents(content);
    leaf.resources().fonts().pair(font_name, font);
    leaf.finish();
    // One of the fourteen typefaces that every reader has.
    pdf.type1_font(font).base_font(Name(b"Helvetica"));
    pdf.stream(content, &marks(page, font_name));
    pdf.finish()
}

fn points(mm: f64) -> f32 {
    (mm * POINTS) as f32
}

fn marks(page: &Page, font: Name<'_>) -> Vec<u8> {
    let mut content = Content::new();
    content.set_fill_gray(0.0);
    // PDF counts from the bottom.
    let up = |y: f64| points(page.paper.height_mm - y);
    // One path, so that no viewer draws a hair line between rectangles that touch.
    for RectangleMm { x, y, width, height } in &page.rectangles {
        content.rect(points(*x), up(y + height), points(*width), points(*height));
    }
    for DiscMm { x, y, radius } in &page.discs {
        let at = |right: f64, down: f64| (points(x + radius * right), up(y + radius * down));
        let start = at(1.0, 0.0);
        content.move_to(start.0, start.1);
        // Around by quarters: each direction, and the one a quarter further.
        let mut from = (1.0, 0.0);
        for _ in 0..4 {
            let to = (-from.1, from.0);
            let first = at(from.0 + QUARTER * to.0, from.1 + QUARTER * to.1);
            let second = at(to.0 + QUARTER * from.0, to.1 + QUARTER * from.1);
            let end = at(to.0, to.1);
            content.cubic_to(first.0, first.1, second.0, second.1, end.0, end.1);
            from = to;
        }
        content.close_path();
    }
    content.fill_nonzero();
    for TextMm { x, y, size, text } in &page.texts {
        content.begin_text();
        content.set_font(font, points(*size));
        content.next_line(points(*x), up(*y));
        content.show(Str(text.as_bytes()));
        content.end_text();
    }
    content.finish().to_vec()
}
