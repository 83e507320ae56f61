//! Frames of the overlay video of a run: the image with its tracked corners, the status, figures
//! and the path so far.

mod inset;
mod lettering;

use crate::figures::in_words;
use inset::PathInset;
use lettering::Lettering;
use odograph::camera::Camera;
use odograph::drawing::canvas::{Canvas, Colour};
use odograph::error::Result;
use odograph::formats::decimal::Rounded;
use odograph::geometry::{Pixel, wrap_angle};
use odograph::image::RgbImage;
use odograph::trajectory::TrackStatus;
use odograph_session::{FramePainter, OverlayFrame};

/// Width of the video, pixels: smaller images are enlarged, as letters need room, and larger ones
/// reduced, by whole factors.
const NARROWEST_PX: usize = 640;
const WIDEST_PX: usize = 1280;

/// Colours that people with any colour vision tell apart (M. Okabe and K. Ito, "Color Universal
/// Design", 2008); shapes differ, too.
const AGREES: Colour = [86, 180, 233];
const DISAGREES: Colour = [230, 159, 0];
const LOST: Colour = [255, 130, 60];
const INK: Colour = [255, 255, 255];
const SHADE: Colour = [12, 16, 22];
/// Opacity of the panels under letters.
const SHADE_OPACITY: f32 = 0.72;

/// Draws the frames of an overlay video.
pub struct OverlayPainter {
    camera: Camera,
    zoom: Zoom,
    lettering: Lettering,
    inset: PathInset,
}

/// Whole factor between the image and its picture in the video.
#[derive(Clone, Copy)]
struct Zoom {
    up: usize,
    down: usize,
}

impl Zoom {
    fn of(width: usize) -> Self {
        Self { up: NARROWEST_PX.div_ceil(width).max(1), down: width.div_ceil(WIDEST_PX).max(1) }
    }

    /// Length in the video of a length in the image, pixels; what is left over is cut off.
    fn length(self, pixels: usize) -> usize {
        (pixels / self.down * self.up).max(1)
    }

    /// Where a pixel of the image is.
    fn place(self, pixel: Pixel) -> (f32, f32) {
        let at = |x: f64| ((x + 0.5) * self.up as f64 / self.down as f64 - 0.5) as f32;
        (at(pixel.x), at(pixel.y))
    }
}

impl OverlayPainter {
    /// For the frames of a camera.
    ///
    /// # Errors
    /// If letters cannot be drawn.
    pub fn new(camera: &Camera) -> Result<Self> {
        let zoom = Zoom::of(camera.width());
        let (width, height) = (zoom.length(camera.width()), zoom.length(camera.height()));
        let letters_px = (width.min(height * 4 / 3) / 38).clamp(14, 32);
        Ok(Self {
            camera: camera.clone(),
            zoom,
            lettering: Lettering::new(letters_px as u32)?,
            inset: PathInset::new(camera, 2 * width.min(height) / 5),
        })
    }

    fn draw(&mut self, frame: &OverlayFrame<'_>) -> Canvas {
        let image = frame.image.rgb();
        let mut canvas = match self.zoom.down {
            1 => Canvas::enlarged(&image, self.zoom.up),
            down => Canvas::reduced(&image, down),
        };
        let unit = self.lettering.height_px() as f32 / 16.0;
        for track in frame.tracks {
            draw_track(&mut canvas, self.zoom.place(track.pixel), track.inlier, unit);
        }
        self.draw_status(&mut canvas, frame);
        self.draw_figures(&mut canvas, frame, unit);
        self.inset.add(frame, &self.camera);
        self.inset.draw(&mut canvas, &self.lettering);
        canvas
    }

    /// A line at the top: whether the frame was tracked, or why not, and which frame it is.
    fn draw_status(&self, canvas: &mut Canvas, frame: &OverlayFrame<'_>) {
        let line_px = self.lettering.line_px();
        let margin = line_px / 3;
        canvas.shade((0, 0), (canvas.width(), line_px + 2 * margin), SHADE, SHADE_OPACITY);
        let (text, colour) = match frame.camera.status {
            TrackStatus::Tracked if frame.tracks.is_empty() && frame.camera.frame > 0 => {
                ("tracking: a copy of the frame before".to_owned(), AGREES)
            }
            TrackStatus::Tracked => ("tracking".to_owned(), AGREES),
            TrackStatus::Lost { reason } => (format!("lost: {}", short(in_words(reason))), LOST),
        };
        self.lettering.write(canvas, (margin, margin), &text, colour);
        let which = format!("frame {}   {:.2} s", frame.camera.frame, frame.camera.time_s);
        let left = canvas.width().saturating_sub(margin + self.lettering.width_px(&which));
        // A long reason has the line for itself.
        if left > 2 * margin + self.lettering.width_px(&text) {
            self.lettering.write(canvas, (left, margin), &which, INK);
        }
    }

    /// Speed, height and heading, and what the marks mean, at the lower left.
    fn draw_figures(&self, canvas: &mut Canvas, frame: &OverlayFrame<'_>, unit: f32) {
        let (written, camera) = (&frame.written.estimate, &frame.camera.estimate);
        let unknown = || "–".to_owned();
        let figures = [
            ("speed", written.as_ref().map(|known| format!("{:.2} m/s", known.velocity.speed_m_s()))),
            ("height", camera.as_ref().map(|known| format!("{:.3} m", known.pose.height_m))),
            (
                "heading",
                written.as_ref().map(|known| degrees(wrap_angle(known.pose.heading_rad).to_degrees())),
            ),
        ];
        let agreeing = frame.tracks.iter().filter(|track| track.inlier).count();
        let counts = [
            (true, format!("{agreeing} corners agree")),
            (false, format!("{} do not", frame.tracks.len() - agreeing)),
        ];
        let (line_px, letters) = (self.lettering.line_px(), &self.lettering);
        let margin = line_px / 3;
        let column = letters.width_px("heading") + line_px / 2;
        let mark = line_px;
        let figures_px = column + letters.width_px("−180.0°").max(letters.width_px("00.00 m/s"));
        let widest = figures_px.max(mark + letters.width_px("0000 corners agree"));
        let size = (widest + 2 * margin, 5 * line_px + 2 * margin);
        let (left, top) = (margin, canvas.height().saturating_sub(size.1 + margin));
        canvas.shade((left, top), size, SHADE, SHADE_OPACITY);
        let (x, mut y) = (left + margin, top + margin);
        for (name, value) in figures {
            letters.write(canvas, (x, y), name, INK);
            letters.write(canvas, (x + column, y), &value.unwrap_or_else(unknown), INK);
            y += line_px;
        }
        for (agrees, text) in counts {
            let at = (x as f32 + 0.35 * line_px as f32, y as f32 + 0.5 * line_px as f32);
            draw_track(canvas, at, agrees, unit);
            letters.write(canvas, (x + mark, y), &text, INK);
            y += line_px;
        }
    }
}

/// A reason without its examples in brackets.
fn short(reason: &str) -> &str {
    reason.split(" (").next().unwrap_or(reason)
}

/// An angle with its sign and a true minus.
fn degrees(angle: f64) -> String {
    format!("{:+.1}°", Rounded(angle)).replace('-', "−")
}

/// A corner: a disc where it agrees with the motion, a cross where it does not; with a dark edge,
/// as ground is of any brightness.
fn draw_track(canvas: &mut Canvas, (x, y): (f32, f32), agrees: bool, unit: f32) {
    if agrees {
        canvas.disc((x, y), 3.0 * unit, SHADE);
        canvas.disc((x, y), 2.1 * unit, AGREES);
    } else {
        let arm = 3.6 * unit;
        let strokes = [((x - arm, y - arm), (x + arm, y + arm)), ((x - arm, y + arm), (x + arm, y - arm))];
        for (half, colour) in [(1.9 * unit, SHADE), (1.0 * unit, DISAGREES)] {
            strokes.iter().for_each(|(from, to)| canvas.stroke(*from, *to, half, colour));
        }
    }
}

impl FramePainter for OverlayPainter {
    fn size(&self) -> (usize, usize) {
        (self.zoom.length(self.camera.width()), self.zoom.length(self.camera.height()))
    }

    fn paint(&mut self, frame: &OverlayFrame<'_>) -> RgbImage {
        self.draw(frame).into_image()
    }
}

#[cfg(test)]
mod tests;
