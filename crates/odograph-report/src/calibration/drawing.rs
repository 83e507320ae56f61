//! SVG drawings for the report. On the page its style sheet colours them; as image files they
//! contain their own styles.

use crate::parts::STYLE;
use odograph::drawing::scale::{label, multiples, round_step};
use odograph::drawing::svg::{coordinate, escape, text_width};
use odograph::geometry::Pixel;
use std::fmt::Write;

/// Width of a drawing of the image, drawing units.
const WIDTH: f64 = 720.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = WIDTH - 10.0;
const TOP: f64 = 14.0;
const BELOW: f64 = 30.0;
/// Tall images are drawn narrower, to fit the screen.
const HIGHEST: f64 = 720.0;

/// A drawing: SVG elements, and their size in drawing units.
pub struct PageDrawing {
    pub width: f64,
    pub height: f64,
    pub body: String,
}

impl PageDrawing {
    /// The drawing as an element of a page.
    pub fn inline(&self, name: &str) -> String {
        format!(
            "<svg class=\"plot\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\">\n{}</svg>",
            coordinate(self.width),
            coordinate(self.height),
            escape(name),
            self.body
        )
    }

    /// The drawing as a complete SVG file in light colours, with its title and caption above it.
    pub fn file(&self, name: &str, says: &str) -> String {
        const LINE: f64 = 20.0;
        let lines = lines(says, self.width - 28.0);
        let head = 38.0 + LINE * lines.len() as f64;
        let mut caption = String::new();
        for (number, line) in lines.iter().enumerate() {
            let y = coordinate(49.0 + LINE * number as f64);
            let _ = writeln!(caption, "<text x=\"14\" y=\"{y}\">{}</text>", escape(line));
        }
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"plot\" width=\"{0}\" height=\"{1}\" viewBox=\"0 0 {0} {1}\" \
             font-family=\"Roboto, sans-serif\">\n<style>{2}</style>\n<rect width=\"{0}\" height=\"{1}\" fill=\"#fff\"/>\n\
             <text class=\"name\" x=\"14\" y=\"28\">{3}</text>{caption}<g transform=\"translate(0 {head})\">\n{4}</g>\n</svg>\n",
            coordinate(self.width),
            coordinate(self.height + head + 8.0),
            light_style(),
            escape(name),
            self.body
        )
    }
}

/// Breaks a text into lines of at most `width` drawing units.
fn lines(text: &str, width: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if text_width(&format!("{line} {word}"), 14.0) <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// The style-sheet rules for drawings, with the light-mode values of their variables.
fn light_style() -> String {
    let sheets = [STYLE, super::STYLE];
    let lines = || sheets.iter().flat_map(|sheet| sheet.lines());
    // Declarations before the first media query are those of the light mode.
    let light = sheets.iter().flat_map(|sheet| sheet.split("@media").next());
    let values: Vec<(&str, &str)> = light
        .flat_map(|part| part.split([';', '{', '}']))
        .filter_map(|declaration| declaration.trim().split_once(": "))
        .filter(|(name, _)| name.starts_with("--"))
        .collect();
    let rules = lines().filter(|line| line.starts_with(".plot "));
    let mut style: String = rules.map(|rule| format!("{rule}\n")).collect();
    for (name, value) in values {
        style = style.replace(&format!("var({name})"), value);
    }
    style
}

/// The frame of an image drawing, with pixel coordinates along its sides.
pub struct ImageFrame {
    pub size: (usize, usize),
    scale: f64,
    left: f64,
    right: f64,
    bottom: f64,
}

impl ImageFrame {
    pub fn new(size: (usize, usize)) -> Self {
        let (width, height) = (size.0 as f64, size.1 as f64);
        let scale = ((RIGHT - LEFT) / width).min(HIGHEST / height);
        Self { size, scale, left: LEFT, right: LEFT + width * scale, bottom: TOP + height * scale }
    }

    /// Position of a pixel in the drawing.
    pub fn at(&self, pixel: Pixel) -> (f64, f64) {
        (self.left + (pixel.x + 0.5) * self.scale, TOP + (pixel.y + 0.5) * self.scale)
    }

    /// Drawing units per pixel.
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Left, right, top and bottom of the image in the drawing.
    pub fn sides(&self) -> (f64, f64, f64, f64) {
        (self.left, self.right, TOP, self.bottom)
    }

    /// Draws the frame and its labels over `content`; `more` is additional height below it, drawing
    /// units.
    pub fn drawing(&self, content: &str, more: f64) -> PageDrawing {
        let mut body = content.to_owned();
        let (left, right, bottom) = (self.left, self.right, self.bottom);
        let _ = writeln!(
            body,
            "<rect class=\"base hollow\" x=\"{}\" y=\"{TOP}\" width=\"{}\" height=\"{}\"/>",
            coordinate(left),
            coordinate(right - left),
            coordinate(bottom - TOP)
        );
        let step = round_step(self.size.0.max(self.size.1) as f64, 9.0);
        for value in multiples(0.0, self.size.0 as f64 - 1.0, step) {
            let (x, _) = self.at(Pixel::new(value, 0.0));
            let _ = writeln!(
                body,
                "<text text-anchor=\"middle\" x=\"{}\" y=\"{}\">{}</text>",
                coordinate(x),
                coordinate(bottom + 19.0),
                if value == 0.0 { "0 px".to_owned() } else { label(value, step) }
            );
        }
        for value in multiples(0.0, self.size.1 as f64 - 1.0, step) {
            let (_, y) = self.at(Pixel::new(0.0, value));
            let _ = writeln!(
                body,
                "<text text-anchor=\"end\" x=\"{}\" y=\"{}\">{}</text>",
                coordinate(left - 8.0),
                coordinate(y + 5.0),
                label(value, step)
            );
        }
        PageDrawing { width: right + (WIDTH - RIGHT), height: bottom + BELOW + more, body }
    }
}
