//! The report page of a calibration: the verdict first, then its basis.

use super::drawing::PageDrawing;
use super::lens::{self, ExpectedError, pixels_text};
use super::views::{self, ShownView};
use crate::drawing_png;
use crate::parts::{card, head, number, warnings};
use odograph::camera::Camera;
use odograph::drawing::scale::label;
use odograph::drawing::svg::escape;
use odograph::error::Result;
use odograph_calibration::selection::Guidance;
use odograph_calibration::{LensModel, ModelComparison, Parameter, Verdict};
use std::fmt::Write;

/// Width of the drawings as image files, pixels.
const PICTURE_WIDTH_PX: u32 = 1440;

/// Statistics of the board detection.
#[derive(Debug, Clone, Default)]
pub struct BoardDetections {
    /// Number of frames or images searched.
    pub looked_at: u64,
    /// Number of those with the board.
    pub with_board: u64,
    /// Reasons for failed detections with their counts, the most frequent first.
    pub reasons: Vec<(String, u64)>,
    /// The first images without the board, with the reason; empty for videos.
    pub pictures_without: Vec<(String, String)>,
}

/// Contents of the report.
pub struct CalibrationReport<'a> {
    /// Name of what was calibrated; any text.
    pub title: &'a str,
    /// Description of the input; any text.
    pub source: &'a str,
    /// The board's specification as text.
    pub board: String,
    /// Whether the views are images rather than video frames.
    pub pictures: bool,
    /// Where the board was found.
    pub found: &'a BoardDetections,
    /// The calibrated camera.
    pub camera: &'a Camera,
    /// Its lens model.
    pub model: LensModel,
    /// Focal length on the optical axis, horizontal, and its standard deviation, pixels: what is
    /// commonly called the focal length.
    pub focal_px: (f64, f64),
    /// The parameters with their standard deviations.
    pub parameters: &'a [Parameter],
    /// Root mean square residual over the used views, pixels.
    pub rms_px: f64,
    /// The same over views that were not used for fitting, pixels.
    pub hold_out_rms_px: f64,
    /// The lens models that were compared.
    pub candidates: &'a [ModelComparison],
    /// Whether the calibration can be used.
    pub verdict: Verdict,
    /// Why; sentences.
    pub reasons: &'a [String],
    /// All views given to the calibration, used or not.
    pub views: &'a [ShownView<'a>],
    /// Expected error of a ray, root mean square over the image, pixels: the figure that the camera
    /// file has.
    pub expected_error_px: f64,
    /// The same by place.
    pub expected_error: &'a ExpectedError,
    /// The calibration with the bend of the board estimated, if the board seems to be bent.
    pub bent_board: Option<BentBoard<'a>>,
    /// What is still missing.
    pub guidance: &'a Guidance,
    /// Warnings about the input; sentences.
    pub warnings: &'a [String],
    /// Name of the camera file.
    pub camera_file: &'a str,
}

/// What there is beside a calibration that took the board for flat.
#[derive(Debug, Clone, Copy)]
pub struct BentBoard<'a> {
    /// Name of its camera file, in the folder of the report.
    pub file: &'a str,
    /// Root mean square residual over the used views, pixels.
    pub rms_px: f64,
    /// Expected error of a ray over the image, pixels.
    pub expected_error_px: f64,
}

/// A drawing with its file name, title and caption.
struct Named {
    file: &'static str,
    title: &'static str,
    says: String,
    drawing: PageDrawing,
}

/// The display name of a lens model.
pub fn lens_name(model: LensModel) -> &'static str {
    match model {
        LensModel::Pinhole => "pinhole, no distortion",
        LensModel::BrownConrady4 => "Brown–Conrady, 4 coefficients",
        LensModel::BrownConrady5 => "Brown–Conrady, 5 coefficients",
        LensModel::BrownConrady8 => "Brown–Conrady, rational, 8 coefficients",
        LensModel::KannalaBrandt4 => "Kannala–Brandt fisheye, 4 coefficients",
        LensModel::DoubleSphere => "double sphere, 2 coefficients",
    }
}

impl CalibrationReport<'_> {
    /// All files of the report folder by name: the page, and its drawings as PNG.
    ///
    /// # Errors
    /// If a drawing cannot be rendered.
    pub fn files(&self) -> Result<Vec<(&'static str, Vec<u8>)>> {
        let drawings = self.drawings();
        let mut files = vec![("report.html", self.html(&drawings).into_bytes())];
        for named in &drawings {
            files.push((
                named.file,
                drawing_png(&named.drawing.file(named.title, &named.says), PICTURE_WIDTH_PX)?,
            ));
        }
        Ok(files)
    }

    fn used(&self) -> usize {
        self.views.iter().filter(|view| view.why_not.is_none()).count()
    }

    fn size(&self) -> (usize, usize) {
        (self.camera.width(), self.camera.height())
    }

    fn drawings(&self) -> Vec<Named> {
        let (residuals, times, mean_times) = views::residuals(self.size(), self.views);
        let round = |times: f64| label(times, times.min(1.0));
        let moved = lens::greatest_displacement_px(self.camera).map_or_else(String::new, |moved| {
            format!(" At the border it moves a point by up to {}.", pixels_text(moved))
        });
        vec![
            Named {
                file: "expected-error.png",
                title: "Expected error",
                says: format!(
                    "How far a ray through each place of the image is likely to be off, from the covariance.{}",
                    self.expected_error.key()
                ),
                drawing: self.expected_error.drawing(),
            },
            Named {
                file: "residuals.png",
                title: "Residuals",
                says: format!(
                    "Blue: each corner's error, {} times as long. Orange: its mean over a cell, {} times.",
                    round(times),
                    round(mean_times)
                ),
                drawing: residuals,
            },
            Named {
                file: "coverage.png",
                title: "Coverage",
                says: format!(
                    "Every corner seen in the views (orange: left out). The stronger the colour of a cell, the more it has seen; those with a dashed border, none. {:.0} % have seen one.",
                    100.0 * self.guidance.coverage.share()
                ),
                drawing: views::coverage(self.size(), self.views, &self.guidance.coverage),
            },
            Named {
                file: "distortion.png",
                title: "Distortion",
                says: format!(
                    "Straight lines through this lens (blue) and through a pinhole (dashed).{moved}"
                ),
                drawing: lens::distortion(self.camera),
            },
            Named {
                file: "views.png",
                title: "Error of each view",
                says: "Root mean square over its corners; dashed: over all. Orange: left out.".into(),
                drawing: views::errors(self.views, self.rms_px),
            },
        ]
    }

    fn html(&self, drawings: &[Named]) -> String {
        let mut page = head(self.title, self.source, super::STYLE);
        self.verdict(&mut page);
        warnings(self.warnings, &mut page);
        self.cards(&mut page);
        self.next_time(&mut page);
        let figure = |named: &Named, tall: bool, page: &mut String| {
            let mut svg = named.drawing.inline(named.title);
            if tall {
                svg = svg.replacen("class=\"plot\"", "class=\"plot tall\"", 1);
            }
            let _ = writeln!(
                page,
                "<figure><figcaption><b>{}</b><span>{}</span></figcaption>\n{svg}</figure>",
                named.title, named.says
            );
        };
        page.push_str("<h2>Why it can be trusted, or not</h2>\n<div class=\"plots\">\n");
        drawings
            .iter()
            .filter(|named| named.file != "views.png")
            .for_each(|named| figure(named, false, &mut page));
        page.push_str("</div>\n");
        self.how_to_read(&mut page);
        self.parameters(&mut page);
        self.candidates(&mut page);
        page.push_str("<h2>The views</h2>\n");
        drawings
            .iter()
            .filter(|named| named.file == "views.png")
            .for_each(|named| figure(named, true, &mut page));
        self.thumbnails(&mut page);
        self.left_out(&mut page);
        let _ = write!(
            page,
            "<footer>Made by odograph {}. Pixels count from the centre of the top left one, x to the right and y down. \
             ± is one standard deviation.</footer>\n</main>\n</body>\n</html>\n",
            env!("CARGO_PKG_VERSION")
        );
        page
    }

    fn verdict(&self, page: &mut String) {
        let (class, word, says) = match self.verdict {
            Verdict::Good => ("good", "Good.", "This camera file is reliable."),
            Verdict::Usable => ("usable", "Usable.", "This camera file is usable, and could be better."),
            Verdict::DoItAgain => ("again", "Do it again.", "This camera file should not be used."),
        };
        let _ = write!(page, "<div class=\"box verdict {class}\"><p><b>{word}</b> {says}</p>");
        if !self.reasons.is_empty() {
            page.push_str("<ul>");
            for reason in self.reasons {
                let _ = write!(page, "<li>{}</li>", escape(&capital(reason)));
            }
            page.push_str("</ul>");
        }
        if let Some(BentBoard { file, rms_px, expected_error_px }) = self.bent_board {
            let _ = write!(
                page,
                "<p>The same views with the bend of the board estimated have an error of the corners of {} and an expected error of \
                 {}: <a href=\"{file}\">{file}</a> is that camera file.</p>",
                pixels_text(rms_px),
                pixels_text(expected_error_px)
            );
        }
        page.push_str("</div>\n");
    }

    fn cards(&self, page: &mut String) {
        let of = if self.pictures { "pictures" } else { "frames" };
        let kind = if self.pictures { "picture" } else { "frame" };
        page.push_str("<div class=\"cards\">\n");
        let ((focal_px, deviation_px), found) = (self.focal_px, self.found);
        let (fx, fy) = self.camera.focal_px();
        let chosen = if self.candidates.len() > 1 { "chosen as described below" } else { "as asked for" };
        card(
            "Error of the corners",
            &pixels_text(self.rms_px),
            &format!(
                "Root mean square over the used views; {} in views that were held out.",
                pixels_text(self.hold_out_rms_px)
            ),
            page,
        );
        let worst = self
            .expected_error
            .worst_px()
            .map_or_else(String::new, |worst| format!("; at the worst place {}", pixels_text(worst)));
        card(
            "Expected error of a ray",
            &pixels_text(self.expected_error_px),
            &format!("Root mean square over the image{worst}."),
            page,
        );
        card(
            "Views",
            &format!("{}", self.used()),
            &format!(
                "Used, out of {} {of} with the board in {} {of} looked at.",
                found.with_board, found.looked_at
            ),
            page,
        );
        card(
            "Focal length",
            &format!("{} px", number(focal_px, 1)),
            &format!("± {}; {} px down the image.", pixels_text(deviation_px), number(focal_px * fy / fx, 1)),
            page,
        );
        if let Some((across, down)) = lens::field_of_view_rad(self.camera) {
            card(
                "Field of view",
                &format!("{}° × {}°", number(across.to_degrees(), 1), number(down.to_degrees(), 1)),
                &format!(
                    "Across and down an image of {}×{} pixels.",
                    self.camera.width(),
                    self.camera.height()
                ),
                page,
            );
        }
        card("Lens model", short_name(self.model), &format!("{}; {chosen}.", lens_name(self.model)), page);
        card(
            "Board",
            &escape(&self.board).replace(':', ":<wbr>"),
            &format!("Looked for in every {kind}."),
            page,
        );
        page.push_str("</div>\n");
    }

    /// The section with hints for a better calibration.
    fn next_time(&self, page: &mut String) {
        if self.guidance.missing.is_empty() {
            return;
        }
        let even = if self.verdict == Verdict::Good { "even " } else { "" };
        let _ = write!(page, "<h2>What would make it {even}better</h2>\n<div class=\"box\"><ul>");
        for hint in self.guidance.missing.iter().take(6) {
            let _ = write!(page, "<li>{}.</li>", escape(&capital(&hint.to_string())));
        }
        page.push_str("</ul></div>\n");
    }

    fn how_to_read(&self, page: &mut String) {
        page.push_str(
            "<p class=\"read\">The <b>expected error</b> shows how certain each ray is: read its scale, \
             because the colours are relative. <b>Residuals</b> that point in all directions are the \
             noise of finding corners; orange arrows that line up over a \
             region mean that the lens model does not fit there, or that the board is not flat. Where the <b>coverage</b> has holes, \
             the calibration rests on the lens model alone.</p>\n",
        );
    }

    fn parameters(&self, page: &mut String) {
        page.push_str(
            "<h2>The camera</h2>\n<div class=\"box scroll\"><table class=\"figures\"><tr><th></th><th class=\"number\">value</th>\
             <th class=\"number\">±</th></tr>\n",
        );
        for parameter in self.parameters {
            let (name, unit) = in_words(parameter.name);
            // The value is rounded to about two digits of its standard deviation.
            let step = match parameter.deviation {
                d if d.is_finite() && d > 0.0 => 10f64.powf((d.log10() - 0.5).floor()).clamp(1e-9, 0.1),
                _ => 1e-6,
            };
            let _ = writeln!(
                page,
                "<tr><th>{name}</th><td class=\"number\">{}{unit}</td><td class=\"number\">{}{unit}</td></tr>",
                label(parameter.value, step),
                label(parameter.deviation, step)
            );
        }
        let _ = writeln!(
            page,
            "</table></div>\n<p>The covariance of all of them, and every digit, are in {}.{}</p>",
            escape(self.camera_file),
            match self.model {
                LensModel::DoubleSphere =>
                    " Focal lengths, xi and alpha are strongly correlated: many such triples describe \
                     nearly the same lens.",
                _ => "",
            }
        );
    }

    fn candidates(&self, page: &mut String) {
        if self.candidates.len() < 2 {
            return;
        }
        page.push_str(
            "<h2>Lens models that were tried</h2>\n<p>Chosen is the one whose rays are surest over the whole image: the expected error of \
             a ray, which grows with every coefficient, and the misfit, which views that the model had not seen show. More \
             coefficients always fit better.</p>\n\
             <div class=\"box scroll\"><table class=\"figures\"><tr><th>Model</th><th class=\"number\">fitted views</th>\
             <th class=\"number\">held-out views</th><th class=\"number\">expected error</th>\
             <th class=\"number\">with misfit</th></tr>\n",
        );
        for candidate in self.candidates {
            let chosen = candidate.model == self.model;
            let class = if chosen { " chosen" } else { "" };
            let pixels = |value: f64| if value.is_finite() { pixels_text(value) } else { "failed".into() };
            let _ = writeln!(
                page,
                "<tr><td class=\"name{class}\">{}{}</td><td class=\"number\">{}</td><td class=\"number\">{}</td>\
                 <td class=\"number\">{}</td><td class=\"number{class}\">{}</td></tr>",
                if chosen { "→ " } else { "" },
                lens_name(candidate.model),
                pixels(candidate.rms_px),
                pixels(candidate.hold_out_rms_px),
                pixels(candidate.expected_error_px),
                pixels(candidate.with_misfit_px),
            );
        }
        page.push_str("</table></div>\n");
    }

    /// The views as small pictures, each with its error or why it was left out.
    fn thumbnails(&self, page: &mut String) {
        let shown = self.views.iter().filter_map(|view| Some((view, view.thumbnail?)));
        let mut figures = String::new();
        for (view, thumbnail) in shown {
            let name = escape(&view.name);
            let (class, says) = match view.why_not {
                Some(_) => (" out", "left out"),
                None => ("", "used"),
            };
            let _ = writeln!(
                figures,
                "<figure class=\"view{class}\">{}<figcaption>{name}<span>{says}, {}</span></figcaption></figure>",
                thumbnail.element(&name),
                pixels_text(view.rms_px)
            );
        }
        if !figures.is_empty() {
            let _ = writeln!(page, "<div class=\"views\">\n{figures}</div>");
        }
    }

    /// Views that were detected but not used, and images without a detection.
    fn left_out(&self, page: &mut String) {
        let removed =
            self.views.iter().filter_map(|view| Some((view.name.as_str(), view.why_not.as_deref()?)));
        let without = self.found.pictures_without.iter().map(|(name, why)| (name.as_str(), why.as_str()));
        let rows: Vec<(&str, &str)> = removed.chain(without).collect();
        if !rows.is_empty() {
            page.push_str("<p>Left out:</p>\n<div class=\"box scroll\"><table>\n");
            for (name, why) in rows {
                let _ = writeln!(
                    page,
                    "<tr><td class=\"wrap\">{}</td><td>{}</td></tr>",
                    escape(name),
                    escape(why)
                );
            }
            page.push_str("</table></div>\n");
        }
        if !self.found.reasons.is_empty() && self.found.pictures_without.is_empty() {
            page.push_str("<p>Frames without the board: ");
            let lines: Vec<String> =
                self.found.reasons.iter().map(|(why, count)| format!("{count} × {}", escape(why))).collect();
            let _ = writeln!(page, "{}.</p>", lines.join(", "));
        }
    }
}

fn short_name(model: LensModel) -> &'static str {
    match model {
        LensModel::Pinhole => "pinhole",
        LensModel::BrownConrady4 => "brown4",
        LensModel::BrownConrady5 => "brown5",
        LensModel::BrownConrady8 => "brown8",
        LensModel::KannalaBrandt4 => "fisheye",
        LensModel::DoubleSphere => "double-sphere",
    }
}

/// The display name of a parameter, and its unit.
fn in_words(name: &str) -> (String, &'static str) {
    match name {
        "f" => ("Focal length".into(), " px"),
        "fx" => ("Focal length across, fx".into(), " px"),
        "fy" => ("Focal length down, fy".into(), " px"),
        "cx" => ("Principal point across, cx".into(), " px"),
        "cy" => ("Principal point down, cy".into(), " px"),
        "bend_x" | "bend_xy" | "bend_y" => (format!("Board: {name}"), " m"),
        "stretch" | "shear" => (format!("Board: {name}"), ""),
        other => (format!("Lens: {other}"), ""),
    }
}

fn capital(sentence: &str) -> String {
    let mut characters = sentence.chars();
    characters.next().map_or_else(String::new, |first| first.to_uppercase().chain(characters).collect())
}
