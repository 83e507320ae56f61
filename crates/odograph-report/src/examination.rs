//! The page of an examination: what limits the accuracy of a recording, with the frames that show
//! it.

use super::parts::{head, warnings};
use odograph::drawing::scale::duration_text;
use odograph::drawing::svg::{coordinate, data_uri, escape};
use odograph_session::{Diagnosis, ExaminedFrame, Finding, Judgement};
use odograph_video::jpeg_from_gray;
use std::fmt::Write;

/// JPEG quality (1 to 100): noise and blocks must be those of the recording.
const QUALITY: u8 = 90;

const STYLE: &str = "
.judgement { font-weight: 600; white-space: nowrap; }
.judgement.good { color: var(--green); } .judgement.limits { color: var(--orange); }
.judgement.spoils { color: #d6336c; } .judgement.unknown { color: var(--muted); }
td { vertical-align: top; }
.frames { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 12px; }
.frames .picture { position: relative; }
.frames .picture svg { position: absolute; inset: 0; height: 100%; }
.frames circle { fill: none; stroke: #38bdf8; stroke-width: 2; vector-effect: non-scaling-stroke; }
.frames circle.out { stroke: #ff9a57; }
";

/// The page as one HTML file without external references; `name` is that of the recording.
pub fn examination_html(name: &str, diagnosis: &Diagnosis) -> String {
    let mut page = head(name, &diagnosis.description, STYLE);
    let of_all = diagnosis.frames.map_or_else(String::new, |frames| format!(" of {frames}"));
    let _ = writeln!(
        page,
        "<p class=\"lead\">{} {}{of_all} frames were looked at, spread over {}.</p>",
        verdict(&diagnosis.findings),
        diagnosis.frames_looked_at,
        duration_text(diagnosis.duration_s)
    );
    warnings(&diagnosis.warnings, &mut page);
    page.push_str(
        "<h2>What was examined</h2>\n<div class=\"box scroll\"><table>\n<tr><th>Judgement</th><th>of</th><th>measured</th>\
         <th>what to do</th></tr>\n",
    );
    // The worst first; those of one judgement in the order in which to read them.
    let mut findings: Vec<&Finding> = diagnosis.findings.iter().collect();
    findings.sort_by_key(|finding| std::cmp::Reverse(finding.judgement));
    for Finding { topic, judgement, measured, advice, .. } in findings {
        let _ = writeln!(
            page,
            "<tr><td class=\"judgement {0}\">{0}</td><td>{topic}</td><td>{1}</td><td>{2}</td></tr>",
            judgement.name(),
            escape(measured),
            escape(advice.as_deref().unwrap_or_default())
        );
    }
    page.push_str("</table></div>\n");
    if !diagnosis.pictures.is_empty() {
        page.push_str(
            "<h2>Frames that show it</h2>\n<p class=\"quiet\">Rings: corners that agree on the motion of the ground; orange \
             ones do not.</p>\n<div class=\"frames\">\n",
        );
        diagnosis.pictures.iter().for_each(|frame| picture(frame, &mut page));
        page.push_str("</div>\n");
    }
    let _ = write!(
        page,
        "<footer>Made by odograph {}. good: nothing to do; unknown: the recording does not show it; limits: less accurate \
         than it could be; spoils: wrong, or lost.</footer>\n</main>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION")
    );
    page
}

/// The examination in a sentence.
fn verdict(findings: &[Finding]) -> String {
    let topics = |judgement: Judgement| {
        let of = findings.iter().filter(|finding| finding.judgement == judgement);
        of.map(|finding| finding.topic).collect::<Vec<_>>().join(", ")
    };
    match (topics(Judgement::Spoils), topics(Judgement::Limits)) {
        (spoils, _) if !spoils.is_empty() => format!("<b>The result will be wrong, or lost</b>: {spoils}."),
        (_, limits) if !limits.is_empty() => {
            format!("<b>The result will be less accurate than it could be</b>: {limits}.")
        }
        _ => "<b>Nothing limits the accuracy.</b>".to_owned(),
    }
}

/// A frame with its corners.
fn picture(frame: &ExaminedFrame, page: &mut String) {
    let Ok(jpeg) = jpeg_from_gray(&frame.gray, QUALITY) else { return };
    let (width, height) = (frame.gray.width(), frame.gray.height());
    let radius = coordinate(width.max(height) as f64 / 120.0);
    let mut rings = String::new();
    for (pixel, agrees) in &frame.corners {
        // Pixel centres are at integers.
        let (x, y) = (coordinate(pixel.x + 0.5), coordinate(pixel.y + 0.5));
        let class = if *agrees { "" } else { " class=\"out\"" };
        let _ = write!(rings, "<circle{class} cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"/>");
    }
    let shows = escape(&frame.shows);
    let _ = writeln!(
        page,
        "<figure><figcaption><b>Frame {}, {:.2} s</b><span>{shows}</span></figcaption>\n<div class=\"picture\">\
         <img width=\"{width}\" height=\"{height}\" alt=\"{shows}\" src=\"{}\">\
         <svg viewBox=\"0 0 {width} {height}\" aria-hidden=\"true\">{rings}</svg></div></figure>",
        frame.number,
        frame.time_s,
        data_uri("image/jpeg", &jpeg)
    );
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::geometry::Pixel;
    use odograph::image::GrayImage;

    fn finding(topic: &'static str, judgement: Judgement) -> Finding {
        Finding {
            topic,
            value: None,
            unit: "",
            judgement,
            measured: "a < b".into(),
            advice: Some("do".into()),
        }
    }

    #[test]
    fn the_worst_is_first_and_frames_have_their_corners() {
        let shows = "Lost because of darkness.".to_owned();
        let corners = vec![(Pixel::new(3.0, 4.0), true), (Pixel::new(9.0, 4.0), false)];
        let frame = ExaminedFrame { number: 7, time_s: 0.25, shows, gray: GrayImage::new(32, 24), corners };
        let mut diagnosis = Diagnosis {
            description: "Y4M, 32x24".into(),
            frames: Some(100),
            frames_looked_at: 50,
            duration_s: 3.0,
            findings: vec![
                finding("exposure", Judgement::Good),
                finding("motion blur", Judgement::Limits),
                finding("texture", Judgement::Spoils),
            ],
            warnings: vec![],
            pictures: vec![frame],
        };
        let page = examination_html("a & b", &diagnosis);
        assert!(
            page.contains("<b>The result will be wrong, or lost</b>: texture. 50 of 100 frames"),
            "{page}"
        );
        let place = |text: &str| page.find(text).expect(text);
        assert!(place("<td>texture</td>") < place("<td>motion blur</td>"));
        assert!(place("<td>motion blur</td>") < place("<td>exposure</td>"));
        assert!(page.contains("a &lt; b") && page.contains("<title>a &amp; b"), "{page}");
        assert!(page.contains("<b>Frame 7, 0.25 s</b><span>Lost because of darkness.</span>"), "{page}");
        assert!(
            page.contains("<circle cx=\"3.5\" cy=\"4.5\"")
                && page.contains("<circle class=\"out\" cx=\"9.5\"")
        );
        diagnosis.findings.truncate(1);
        diagnosis.pictures.clear();
        let good = examination_html("good", &diagnosis);
        assert!(
            good.contains("<b>Nothing limits the accuracy.</b>") && !good.contains("Frames that show it")
        );
    }
}
