//! Where everything is on the paper, in millimetres from its top left corner.

use super::paper::Paper;
use odograph::error::{Error, Result};
use odograph_calibration::{Board, BoardKind, Drawing, Shape};

/// A page: a board, a ruler and two lines of text.
#[derive(Debug, Clone)]
pub struct Page {
    /// The paper; its width and height are those of the page.
    pub paper: Paper,
    /// Black rectangles, which may touch but do not overlap.
    pub rectangles: Vec<RectangleMm>,
    /// Black discs.
    pub discs: Vec<DiscMm>,
    /// Black text.
    pub texts: Vec<TextMm>,
    pattern_mm: (f64, f64),
    ruler_mm: u32,
}

/// A rectangle by its top left corner and its sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RectangleMm {
    pub x: f64,
    pub y: f64,
    pub width: f64,
    pub height: f64,
}

/// A disc by its centre and its radius.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DiscMm {
    pub x: f64,
    pub y: f64,
    pub radius: f64,
}

/// A line of text by the left end of its baseline.
#[derive(Debug, Clone, PartialEq)]
pub struct TextMm {
    pub x: f64,
    pub y: f64,
    /// Size of the type.
    pub size: f64,
    /// Printable ASCII.
    pub text: String,
}

/// Unprintable margin of common printers, and a little more.
const MARGIN_MM: f64 = 6.0;
/// Minimum margin between board and ruler.
const GAP_MM: f64 = 6.0;
/// Ruler and text below the board.
const FOOTER_MM: f64 = 15.0;
const RULERS_MM: [u32; 4] = [100, 50, 20, 10];
const TEXT_MM: f64 = 2.8;
/// Width of a digit, and the largest mean width of a letter of the caption, relative to the type
/// size.
const DIGIT_WIDTH: f64 = 0.556;
const LETTER_WIDTH: f64 = 0.56;

impl Page {
    /// Lays a board out on the given paper, or on the smallest of the usual sizes that is large
    /// enough; portrait or landscape.
    ///
    /// Fails if it does not fit, and names what would.
    pub fn new(board: &Board, paper: Option<Paper>) -> Result<Self> {
        let drawing = Drawing::new(board);
        let (width_mm, height_mm) = needed_mm(&drawing);
        let fits = |paper: &Paper| paper.width_mm >= width_mm && paper.height_mm >= height_mm;
        let ways = |paper: Paper| {
            let wide = drawing.pattern().width_m() > drawing.pattern().height_m();
            if wide == (paper.width_mm > paper.height_mm) {
                [paper, paper.across()]
            } else {
                [paper.across(), paper]
            }
        };
        let smallest = || Paper::usual().flat_map(ways).find(fits);
        let found = match paper {
            Some(paper) => ways(paper).into_iter().find(fits),
            None => smallest(),
        };
        match found {
            Some(paper) => Ok(Self::laid_out(board, &drawing, paper)),
            None => Err(does_not_fit(board, &drawing, paper, smallest())),
        }
    }

    fn laid_out(board: &Board, drawing: &Drawing, paper: Paper) -> Self {
        let pattern = drawing.pattern();
        let mm = 1e3;
        let pattern_mm = (pattern.width_m() * mm, pattern.height_m() * mm);
        let left = (paper.width_mm - pattern_mm.0) / 2.0;
        let footer = paper.height_mm - MARGIN_MM - FOOTER_MM;
        // In the middle of what the footer leaves, if there is room, and not nearer to an edge than
        // to the ruler.
        let top = ((footer - GAP_MM + margin_mm(drawing) - pattern_mm.1) / 2.0).max(margin_mm(drawing));
        let (x, y) = (left - pattern.from.x_m * mm, top - pattern.from.y_m * mm);
        let (mut rectangles, mut discs) = (Vec::new(), Vec::new());
        for shape in drawing.shapes() {
            match shape {
                Shape::Rectangle(rectangle) => rectangles.push(RectangleMm {
                    x: x + rectangle.from.x_m * mm,
                    y: y + rectangle.from.y_m * mm,
                    width: rectangle.width_m() * mm,
                    height: rectangle.height_m() * mm,
                }),
                Shape::Disc { center, radius_m } => discs.push(DiscMm {
                    x: x + center.x_m * mm,
                    y: y + center.y_m * mm,
                    radius: radius_m * mm,
                }),
            }
        }
        let width_mm = paper.width_mm - 2.0 * MARGIN_MM;
        let ruler_mm = RULERS_MM.into_iter().find(|ruler| f64::from(*ruler) + 6.0 <= width_mm).unwrap_or(10);
        let mut page = Self { paper, rectangles, discs, texts: Vec::new(), pattern_mm, ruler_mm };
        // A ruler that begins with the board, where there is room for it.
        let left = left.min(paper.width_mm - MARGIN_MM - f64::from(ruler_mm) - 3.0).max(MARGIN_MM);
        page.draw_ruler(left, footer);
        page.write_caption(board, left, footer);
        page
    }

    /// Ticks every millimetre on a line, longer ones every 5 and 10, and numbers.
    fn draw_ruler(&mut self, left: f64, top: f64) {
        const LINE_MM: f64 = 0.15;
        const LONGEST_MM: f64 = 4.0;
        let base = top + LONGEST_MM;
        self.rectangles.push(RectangleMm {
            x: left - LINE_MM / 2.0,
            y: base,
            width: f64::from(self.ruler_mm) + LINE_MM,
            height: LINE_MM,
        });
        for tick in 0..=self.ruler_mm {
            let length = match tick {
                _ if tick % 10 == 0 => LONGEST_MM,
                _ if tick % 5 == 0 => 2.8,
                _ => 1.6,
            };
            self.rectangles.push(RectangleMm {
                x: left + f64::from(tick) - LINE_MM / 2.0,
                y: base - length,
                width: LINE_MM,
                height: length,
            });
            if tick % 50 == 0 || tick == self.ruler_mm {
                let text = if tick == self.ruler_mm { format!("{tick} mm") } else { tick.to_string() };
                let digits = tick.to_string().len() as f64;
                // The number stands in the middle below its tick, the first one at the left end.
                let back = if tick == 0 { 0.0 } else { digits * DIGIT_WIDTH * TEXT_MM / 2.0 };
                self.texts.push(TextMm {
                    x: left + f64::from(tick) - back,
                    y: base + 3.2,
                    size: TEXT_MM,
                    text,
                });
            }
        }
    }

    fn write_caption(&mut self, board: &Board, left: f64, top: f64) {
        let lines = [
            format!(
                "{board}, {}. Print at 100 %, no scaling; the ruler must measure {} mm.",
                self.pattern_text(),
                self.ruler_mm
            ),
            format!("odograph calibrate VIDEO --board {board} -o camera.yaml"),
        ];
        let longest = lines.iter().map(String::len).max().unwrap_or(1) as f64;
        let width = self.paper.width_mm - 2.0 * MARGIN_MM;
        let size = TEXT_MM.min(width / (LETTER_WIDTH * longest));
        // Beginning with the ruler, unless that is too far to the right.
        let x = left.min(self.paper.width_mm - MARGIN_MM - LETTER_WIDTH * size * longest).max(MARGIN_MM);
        for (line, text) in lines.into_iter().enumerate() {
            self.texts.push(TextMm { x, y: top + 11.0 + 3.8 * line as f64, size, text });
        }
    }

    /// The size of the pattern, for people.
    pub fn pattern_text(&self) -> String {
        format!("pattern {} x {} mm", tenths(self.pattern_mm.0), tenths(self.pattern_mm.1))
    }

    /// The paper and its orientation, for people.
    pub fn paper_text(&self) -> String {
        let way = if self.paper.width_mm > self.paper.height_mm { "landscape" } else { "portrait" };
        format!("{}, {way}", self.paper)
    }

    /// The length of the ruler, millimetres.
    pub fn ruler_mm(&self) -> u32 {
        self.ruler_mm
    }
}

/// White at the edge of the paper: that of printers, and some of what the board needs around it,
/// since a print does not always lie on something white.
fn margin_mm(drawing: &Drawing) -> f64 {
    MARGIN_MM.max(0.25e3 * drawing.quiet_m())
}

/// The size of the smallest paper that is enough.
fn needed_mm(drawing: &Drawing) -> (f64, f64) {
    let (width_mm, height_mm) = (1e3 * drawing.pattern().width_m(), 1e3 * drawing.pattern().height_m());
    let margin_mm = margin_mm(drawing);
    // Lengths in binary are off by less than a picometre; that is no reason to take a larger sheet.
    let tolerance_mm = 1e-9;
    (
        width_mm + 2.0 * margin_mm - tolerance_mm,
        height_mm + margin_mm + GAP_MM + FOOTER_MM + MARGIN_MM - tolerance_mm,
    )
}

fn does_not_fit(board: &Board, drawing: &Drawing, paper: Option<Paper>, larger: Option<Paper>) -> Error {
    let largest = paper.or_else(|| Paper::usual().last());
    let on = largest.map_or_else(String::new, |paper| paper.to_string());
    let (width_mm, height_mm) = needed_mm(drawing);
    let smaller = largest.and_then(|paper| shrunk(board, paper));
    let smaller = smaller.map(|board| format!("--board {board}"));
    let larger = match (paper, larger) {
        (Some(_), Some(larger)) => Some(format!("--paper {}", larger.argument())),
        _ => None,
    };
    let advice: Vec<String> = smaller.into_iter().chain(larger).collect();
    let advice = match advice.is_empty() {
        true => String::from("take fewer squares"),
        false => format!("{} would", advice.join(" or ")),
    };
    Error::usage(format!(
        "{board} needs {} x {} mm with its margins and its ruler, which does not fit on {on}; {advice}",
        tenths(width_mm),
        tenths(height_mm),
    ))
}

/// The board with the largest squares, in whole millimetres if possible, that fits on a paper,
/// portrait or landscape.
fn shrunk(board: &Board, paper: Paper) -> Option<Board> {
    let fits = |board: &Board| {
        let (width_mm, height_mm) = needed_mm(&Drawing::new(board));
        [paper, paper.across()].iter().any(|paper| paper.width_mm >= width_mm && paper.height_mm >= height_mm)
    };
    // What a user gives for a board is its side of a tag for an AprilGrid, its spacing for all
    // others.
    let (length_m, count) = match board.kind() {
        BoardKind::AprilGrid { tag_m } => (tag_m, board.columns().max(board.rows())),
        _ => (board.spacing_m(), board.columns().max(board.rows())),
    };
    let most_mm = (1e3 * length_m).min(2.0 * paper.width_mm.max(paper.height_mm) / count as f64);
    let scaled = |mm: f64| {
        let scale = mm * 1e-3 / length_m;
        // Markers and gaps to a tenth of a millimetre.
        let tenth = |length_m: f64| (length_m * scale * 1e4).round() / 1e4;
        let kind = match board.kind() {
            BoardKind::Charuco { marker_m, dictionary } => {
                BoardKind::Charuco { marker_m: tenth(marker_m), dictionary }
            }
            BoardKind::AprilGrid { .. } => BoardKind::AprilGrid { tag_m: mm * 1e-3 },
            kind => kind,
        };
        let spacing_m = match board.kind() {
            BoardKind::AprilGrid { tag_m } => mm * 1e-3 + tenth(board.spacing_m() - tag_m),
            _ => mm * 1e-3,
        };
        Board::new(kind, board.columns(), board.rows(), spacing_m).ok().filter(fits)
    };
    let whole = (1..=most_mm as u32).rev().find_map(|mm| scaled(f64::from(mm)));
    whole.or_else(|| (1..10).rev().find_map(|tenths| scaled(f64::from(tenths) / 10.0)))
}

/// A length with at most one decimal.
fn tenths(mm: f64) -> f64 {
    (mm * 10.0).round() / 10.0
}

#[cfg(test)]
mod tests;
