//! The report page of a run: self-contained and deterministic.

use super::charts::over_time;
use super::evaluation_plot;
use super::figures::{RunFigures, because, sigmas, weakest};
use super::ground_view::{path_over_ground, place_over_map, script};
use super::other_sensors::other_sensors;
use super::parts::{card, distance_text, head, lengths_text, number, warnings};
use odograph::camera::Distortion;
use odograph::drawing::scale::{duration_text, length_text};
use odograph::drawing::svg::escape;
use odograph::drawing::{MapDrawing, ReckonedStretch};
use odograph::trajectory::{FrameSummary, PlaceSummary};
use odograph_session::{ComparedReference, ReportInput, ReportLocalization};
use std::fmt::Write;

/// Maximum number of rows in the table of losses; further ones are only counted.
const MAX_ROWS: usize = 100;

/// The report as one HTML file without external references.
pub fn html(input: &ReportInput<'_>) -> String {
    let figures = RunFigures::new(input.frames);
    let mut page = head(input.title, input.source, "");
    let interrupted = input.interruption.map_or(String::new(), |interruption| {
        format!("<b>The run was {interruption}</b>; nothing after that is known. ")
    });
    let is_whole = input.interruption.is_none();
    let lead = input.localization.as_ref().map_or_else(|| lead(&figures, input.reckoned, is_whole), found);
    let _ = writeln!(page, "<p class=\"lead\">{interrupted}{lead}</p>");
    warnings(input.warnings, &mut page);
    match &input.localization {
        Some(localization) => {
            place_over_map(input, localization, &mut page);
            place_cards(localization, &mut page);
        }
        None => path_over_ground(input, &mut page),
    }
    // A picture has no path.
    if input.localization.is_none() || input.frames.len() > 1 {
        cards(&figures, is_whole, &mut page);
        over_time(input.frames, &figures, &mut page);
        drawing(input, &mut page);
        beside(input.reference, &mut page);
        doubts(input.frames, &figures, &mut page);
    }
    other_sensors(input.sensors, &mut page);
    parameters(input, &mut page);
    let _ = write!(
        page,
        "<footer>Made by odograph {}. Lengths are in metres over ground; x is forward and y is left at the start, headings count \
         counter-clockwise. Times count from the first frame.</footer>\n</main>\n",
        env!("CARGO_PKG_VERSION")
    );
    script(input.frames, &mut page);
    page.push_str("</body>\n</html>\n");
    page
}

/// The result of looking for a place in a map.
fn found(localization: &ReportLocalization<'_>) -> String {
    let Some(place) = localization.place else {
        return format!("<b>No place is certain</b> – {}.", escape(localization.reason));
    };
    format!("<b>Found</b> at {}.", position_text(place.x_m, place.y_m))
}

/// The place with its standard deviations, or a table of the possible ones.
fn place_cards(localization: &ReportLocalization<'_>, page: &mut String) {
    if let Some(place) = localization.place {
        page.push_str("<div class=\"cards\">\n");
        let deviations = lengths_text([place.sd_x_m, place.sd_y_m]);
        for (name, value_m, deviation) in [("x", place.x_m, &deviations[0]), ("y", place.y_m, &deviations[1])]
        {
            let says = format!("± {deviation}, one standard deviation, in the frame of the map.");
            card(name, &format!("{} m", number(value_m, 4)), &says, page);
        }
        let says = format!("± {}°, counter-clockwise from x of the map.", number(place.sd_heading_deg, 3));
        card("Heading", &format!("{}°", number(place.heading_deg, 2)), &says, page);
        let says = format!("{} away, of session {}.", length_text(place.keyframe_distance_m), place.session);
        card("Nearest keyframe", &place.keyframe.to_string(), &says, page);
        page.push_str("</div>\n");
    } else if !localization.alike.is_empty() {
        page.push_str(
            "<h2>Possible places</h2>\n<div class=\"box scroll\"><table><tr><th class=\"number\">probability</th><th class=\"number\">x</th>\
             <th class=\"number\">y</th><th class=\"number\">heading</th><th>keyframe</th></tr>\n",
        );
        for place in localization.alike {
            let _ = writeln!(
                page,
                "<tr><td class=\"number\">{:.0} %</td><td class=\"number\">{} m</td><td class=\"number\">{} m</td>\
                 <td class=\"number\">{}°</td><td>{} of session {}</td></tr>",
                100.0 * place.probability,
                number(place.x_m, 3),
                number(place.y_m, 3),
                number(place.heading_deg, 1),
                place.keyframe,
                place.session
            );
        }
        page.push_str("</table></div>\n");
    }
}

/// Summary of the run in one or two sentences; one that is not whole has frames up to some point.
fn lead(figures: &RunFigures, reckoned: &[ReckonedStretch], is_whole: bool) -> String {
    if figures.with_pose == 0 {
        return "No frame could be tracked. The reasons are listed below.".into();
    }
    let measured = format!(
        "<b>{}</b> travelled in {}.",
        distance_text(figures.distance_m),
        duration_text(figures.duration_s)
    );
    let there = match reckoned.len() {
        0 => "no path is drawn there",
        n if n < figures.lost.len() => "a dashed path is that of the other sensors, where they have one",
        _ => "the dashed path there is that of the other sensors",
    };
    let kept = match figures.lost.len() {
        0 if is_whole => "Every frame was tracked.".into(),
        0 => "Every frame up to there was tracked.".into(),
        1 => format!("Tracking was lost once, for {}; {there}.", duration_text(figures.lost_s())),
        n => {
            format!(
                "Tracking was lost {n} times, for {} altogether; {there}.",
                duration_text(figures.lost_s())
            )
        }
    };
    format!("{measured} {kept}")
}

fn cards(figures: &RunFigures, is_whole: bool, page: &mut String) {
    page.push_str("<div class=\"cards\">\n");
    card(
        "Distance",
        &distance_text(figures.distance_m),
        "Length of the measured path; lost stretches do not count.",
        page,
    );
    let until = match is_whole {
        true => "From the first frame to the last.",
        false => "From the first frame to the last before the run was interrupted.",
    };
    card("Duration", &duration_text(figures.duration_s), until, page);
    let share = 100.0 * figures.with_pose as f64 / figures.frames.max(1) as f64;
    // Rounded down, so that 100 % appears only if all frames have a pose.
    card(
        "Frames with a pose",
        &format!("{:.1} %", (10.0 * share).floor() / 10.0),
        &format!("{} of {} frames.", figures.with_pose, figures.frames),
        page,
    );
    let times = match figures.lost.len() {
        0 => "never".into(),
        1 => "once".into(),
        n => format!("{n} times"),
    };
    let lost = match figures.lost.len() {
        0 if is_whole => "Every frame has a pose.".into(),
        0 => "Every frame up to the interruption has a pose.".into(),
        _ => format!("{} altogether without a pose.", duration_text(figures.lost_s())),
    };
    card("Lost", &times, &lost, page);
    if let Some(speed) = figures.mean_speed_m_s {
        card(
            "Mean speed",
            &format!("{}/s", length_text(speed)),
            "Distance divided by the time it was tracked.",
            page,
        );
    }
    if let (Some(last), Some(away_m)) = (&figures.last, figures.start_to_end_m()) {
        end_cards(figures.distance_m, last, away_m, page);
    }
    page.push_str("</div>\n");
}

/// Cards about the last position, `away_m` from the first.
fn end_cards(distance_m: f64, last: &PlaceSummary, away_m: f64, page: &mut String) {
    card(
        "End position",
        &position_text(last.x_m, last.y_m),
        &format!(
            "x forward, y left of the start; the heading there is {}°.",
            number(last.heading_rad.to_degrees(), 1)
        ),
        page,
    );
    let share = match distance_m {
        d if d > 0.0 => {
            let percent = 100.0 * away_m / d;
            // Two digits of what is small.
            let decimals = if percent < 1.0 { 3 } else { 1 };
            format!(", {percent:.decimals$} % of the distance")
        }
        _ => String::new(),
    };
    card(
        "From start to end",
        &length_text(away_m),
        &format!("Straight from the first position to the last{share}."),
        page,
    );
    let (position_m, heading_rad) = sigmas(last);
    card(
        "Uncertainty at the end",
        &format!("± {}", length_text(position_m)),
        &format!(
            "And ± {}° of heading: one standard deviation, as in the plots, since the start or the last loss, if \
             camera and height are right.",
            number(heading_rad.to_degrees(), 3)
        ),
        page,
    );
}

/// Formats a position as `x, y unit`, to the millimetre or three digits.
fn position_text(x_m: f64, y_m: f64) -> String {
    let (unit, size_m, decimals) = match x_m.abs().max(y_m.abs()) {
        far if far >= 10_000.0 => ("km", 1000.0, 3),
        far if far >= 100.0 => ("m", 1.0, 2),
        far if far >= 0.1 => ("m", 1.0, 3),
        _ => ("mm", 0.001, 1),
    };
    format!("{}, {} {unit}", number(x_m / size_m, decimals), number(y_m / size_m, decimals))
}

/// The drawing of the path.
fn drawing(input: &ReportInput<'_>, page: &mut String) {
    let (loops, landmarks) = (input.loops, input.landmarks);
    let reckoned = input.reckoned;
    let narrow = MapDrawing { width: 460.0, loops, landmarks, reckoned, ..MapDrawing::default() };
    let narrow = narrow.svg(input.frames);
    let _ = writeln!(
        page,
        "<h2>The map</h2>\n<figure><figcaption><span>The path seen from above, coloured from blue at the start to orange at \
         the end. Darts point where the top of the image points.</span></figcaption>\n\
         <div class=\"wide\">{}</div><div class=\"narrow\">{narrow}</div></figure>",
        input.map_svg
    );
}

fn beside(reference: Option<&ComparedReference>, page: &mut String) {
    let Some(reference) = reference else { return };
    let evaluation = &reference.evaluation;
    let errors = &evaluation.absolute.translation;
    let [rmse, median, max] = lengths_text([errors.rmse, errors.median, errors.max]);
    let scale = evaluation.scale.map_or(String::new(), scale_sentence);
    let _ = writeln!(
        page,
        "<h2>Beside {}</h2>\n<figure><figcaption><span>{} frames have a time in it, over {} of its \
         length. After alignment by rotation, shift and scale, the path of the run is <b>{}</b> off (root \
         mean square; median {}, at most {}).{scale}</span></figcaption>\n{}</figure>",
        escape(&reference.name),
        evaluation.pairs.len(),
        length_text(evaluation.truth_length_m),
        rmse,
        median,
        max,
        evaluation_plot::in_page(evaluation, &reference.reference)
    );
}

/// What the scale of an alignment means: the factor by which the path of a run was multiplied.
fn scale_sentence(scale: f64) -> String {
    let percent = 100.0 * (1.0 / scale - 1.0);
    let sentence = format!(" The scale of the alignment is {scale:.5}");
    if percent.abs() < EQUAL_PERCENT {
        return sentence + ": both have the same length.";
    }
    let size = if percent < 0.0 { "short" } else { "long" };
    let decimals = if percent.abs() < 1.0 { 3 } else { 1 };
    format!(
        "{sentence}: <b>by the reference, every length of the run is {:.decimals$} % too {size}</b>, as it is with a \
         height or a focal length that is wrong.",
        percent.abs()
    )
}

/// Lengths that differ by less are the same, percent: a good calibration knows no more.
const EQUAL_PERCENT: f64 = 0.01;

/// Where it was lost, and the frames with few inliers; nothing if it was sure everywhere.
fn doubts(frames: &[FrameSummary], figures: &RunFigures, page: &mut String) {
    let weak = unsure(frames);
    if figures.lost.is_empty() && weak.is_empty() {
        return;
    }
    page.push_str("<h2>Where it was unsure</h2>\n");
    if figures.lost.is_empty() {
        page.push_str("<p>It was never lost.</p>\n");
    } else {
        page.push_str(
            "<div class=\"box scroll\"><table><tr><th>Lost</th><th>for</th><th>because</th></tr>\n",
        );
        for stretch in figures.lost.iter().take(MAX_ROWS) {
            let _ = writeln!(
                page,
                "<tr><td class=\"time\">{:.2} – {:.2} s</td><td>{}, {} {}</td><td>{}</td></tr>",
                stretch.from_s,
                stretch.to_s,
                duration_text(stretch.to_s - stretch.from_s),
                stretch.frames,
                if stretch.frames == 1 { "frame" } else { "frames" },
                because(stretch)
            );
        }
        page.push_str("</table></div>\n");
        if figures.lost.len() > MAX_ROWS {
            let _ = writeln!(page, "<p>And {} stretches more.</p>", figures.lost.len() - MAX_ROWS);
        }
    }
    if weak.is_empty() {
        return;
    }
    let start_s = frames.first().map_or(0.0, |frame| frame.time_s);
    page.push_str(
        "<p>These frames had few inliers:</p>\n<div class=\"box scroll\"><table class=\"figures\">\
         <tr><th class=\"number\">Frame</th><th class=\"number\">at</th><th class=\"number\">agreeing</th>\
         <th class=\"number\">of corners</th><th class=\"number\">residual</th></tr>\n",
    );
    for frame in weak {
        let _ = writeln!(
            page,
            "<tr><td class=\"number\">{}</td><td class=\"number\">{:.2} s</td><td class=\"number\">{}</td>\
             <td class=\"number\">{}</td><td class=\"number\">{:.2} px</td></tr>",
            frame.frame,
            frame.time_s - start_s,
            frame.inliers,
            frame.tracks,
            frame.residual_px
        );
    }
    page.push_str("</table></div>\n");
}

/// The weakest frames of a run that have less than a quarter of the usual number of inliers.
fn unsure(frames: &[FrameSummary]) -> Vec<&FrameSummary> {
    let mut inliers: Vec<u32> =
        frames.iter().filter(|frame| frame.place.is_some()).map(|frame| frame.inliers).collect();
    inliers.sort_unstable();
    let usual = inliers.get(inliers.len() / 2).copied().unwrap_or(0);
    let mut weak = weakest(frames, 6);
    weak.retain(|frame| 4 * frame.inliers < usual);
    weak
}

fn parameters(input: &ReportInput<'_>, page: &mut String) {
    let (camera, rig) = (input.camera, input.rig);
    let (fx, fy) = camera.focal_px();
    let (cx, cy) = camera.principal_px();
    let lens = match camera.distortion() {
        Distortion::None => "none (a pinhole)".into(),
        other => {
            let name = match other {
                Distortion::KannalaBrandt { .. } => "Kannala–Brandt fisheye",
                Distortion::DoubleSphere { .. } => "double sphere",
                _ => "Brown–Conrady",
            };
            let values: Vec<String> =
                other.coefficients().iter().map(|c| format!("{c}").replace('-', "−")).collect();
            format!("{name}: {}", values.join(", "))
        }
    };
    let degrees = |angle_rad: f64| format!("{}°", number(angle_rad.to_degrees(), 2));
    let rows = [
        ("Image", format!("{} × {} pixels", camera.width(), camera.height())),
        ("Focal length", format!("{fx:.2}, {fy:.2} px")),
        ("Principal point", format!("{cx:.2}, {cy:.2} px")),
        ("Lens distortion", lens),
        ("Height above the ground", length_text(rig.height_m)),
        ("Roll, pitch, mount yaw", [rig.roll_rad, rig.pitch_rad, rig.yaw_rad].map(degrees).join(", ")),
    ];
    let lever_arm = rig.lever_arm.map(|arm| {
        let axes = [arm.x_m, arm.y_m, arm.z_m].map(length_text).join(", ");
        ("Camera in base_link: forward, left, up", axes)
    });
    page.push_str("<h2>Input and parameters</h2>\n<div class=\"box scroll\"><table>\n");
    for (name, value) in rows.into_iter().chain(lever_arm) {
        let _ = writeln!(page, "<tr><th>{name}</th><td>{}</td></tr>", escape(&value));
    }
    let _ = writeln!(
        page,
        "</table></div>\n<p>Beside this page: {}.</p>\n<details class=\"box\"><summary>All parameters as used: run.toml, \
         with which the run can be repeated</summary><pre>{}</pre></details>",
        files_beside(input),
        escape(input.run_toml)
    );
}

/// Links to the files beside the report.
fn files_beside(input: &ReportInput<'_>) -> String {
    let links: Vec<String> =
        input.files.iter().map(|name| format!("<a href=\"{0}\">{0}</a>", escape(name))).collect();
    links.join(", ")
}
