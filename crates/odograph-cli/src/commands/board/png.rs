//! A page as a PNG picture.

use super::page::{DiscMm, Page, RectangleMm};
use super::svg;
use crate::{files, report};
use odograph::error::{Error, Result};
use odograph::image::GrayImage;

/// The most pixels of a picture: A0 at 500 per inch.
const MAX_PIXELS: f64 = 400e6;

/// The picture, with its resolution in the file. Every pixel is as dark as the share of it that is
/// black.
pub fn png(page: &Page, dpi: u16) -> Result<Vec<u8>> {
    let scale = f64::from(dpi) / 25.4;
    let (width, height) = ((page.paper.width_mm * scale).round(), (page.paper.height_mm * scale).round());
    if width * height > MAX_PIXELS {
        return Err(Error::usage(format!(
            "a picture of {width} x {height} pixels is too large; take a lower --dpi, or a .pdf, which is exact at any size"
        )));
    }
    let mut image = GrayImage::new(width as usize, height as usize);
    image.samples_mut().fill(255);
    for RectangleMm { x, y, width, height } in &page.rectangles {
        let (columns, rows) = (covered(*x, *width, scale), covered(*y, *height, scale));
        for (row, down) in rows {
            for (column, across) in &columns {
                darken(&mut image, *column, row, down * across);
            }
        }
    }
    for disc in &page.discs {
        draw_disc(&mut image, disc, scale);
    }
    write_text(&mut image, page, scale)?;
    files::png_to_print(&image, (f64::from(dpi) / 0.0254).round() as u32)
}

fn darken(image: &mut GrayImage, column: usize, row: usize, share: f64) {
    let width = image.width();
    if column < width && row < image.height() {
        let sample = &mut image.samples_mut()[row * width + column];
        *sample = sample.saturating_sub((255.0 * share).round() as u8);
    }
}

/// The pixels along one direction that a length covers, each with its covered share.
fn covered(from_mm: f64, length_mm: f64, scale: f64) -> Vec<(usize, f64)> {
    let (from, to) = ((from_mm * scale).max(0.0), ((from_mm + length_mm) * scale).max(0.0));
    (from as usize..to.ceil() as usize)
        .map(|pixel| (pixel, to.min(pixel as f64 + 1.0) - from.max(pixel as f64)))
        .collect()
}

fn draw_disc(image: &mut GrayImage, disc: &DiscMm, scale: f64) {
    let (x, y, radius) = (disc.x * scale, disc.y * scale, disc.radius * scale);
    let span = |center: f64| (center - radius).max(0.0) as usize..(center + radius).ceil() as usize;
    for row in span(y) {
        // The mean of the exact cover of 16 lines in the row.
        let lines: Vec<f64> = (0..16)
            .map(|line| row as f64 + (f64::from(line) + 0.5) / 16.0 - y)
            .map(|down| (radius * radius - down * down).max(0.0).sqrt())
            .collect();
        for column in span(x) {
            let left = column as f64;
            let cover = |half: &f64| ((x + half).min(left + 1.0) - (x - half).max(left)).max(0.0);
            darken(image, column, row, lines.iter().map(cover).sum::<f64>() / 16.0);
        }
    }
}

/// Text is drawn in a separate strip, which is then copied onto the picture.
fn write_text(image: &mut GrayImage, page: &Page, scale: f64) -> Result<()> {
    let least = |of: fn(&super::page::TextMm) -> f64| page.texts.iter().map(of).fold(f64::INFINITY, f64::min);
    let (left_mm, top_mm) = (least(|text| text.x), least(|text| text.y - text.size));
    let (left, top) = ((left_mm * scale).floor(), (top_mm * scale).floor());
    // No line is longer than this; a strip as wide as a large sheet would only be white.
    let width = (image.width() as f64 - left).min(250.0 * scale).floor();
    let height = image.height() as f64 - top;
    let strip = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\">{}</svg>",
        svg::texts(&page.texts, left / scale, top / scale, scale)
    );
    let strip = report::gray_picture(&strip, width as u32)?;
    for row in 0..strip.height().min(image.height() - top as usize) {
        for (column, sample) in strip.row(row).iter().enumerate() {
            darken(image, left as usize + column, top as usize + row, 1.0 - f64::from(*sample) / 255.0);
        }
    }
    Ok(())
}
