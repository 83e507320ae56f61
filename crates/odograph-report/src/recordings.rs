//! The page over many recordings: what became of each.

use super::parts::{card, distance_text, head, warnings};
use odograph::drawing::scale::duration_text;
use odograph::drawing::svg::escape;
use odograph_session::batch::{RecordingResult, RunStatus};
use serde_json::Value;
use std::fmt::Write;

/// Maximum number of failures in the box at the top; the table has them all.
const MAX_FAILURES: usize = 20;

/// The results of many recordings as one HTML file, which links to their reports.
pub fn recordings_html(results: &[RecordingResult]) -> String {
    let totals = Totals::of(results);
    let mut page = head("Recordings", &format!("{} recordings", results.len()), "");
    let _ = writeln!(page, "<p class=\"lead\">{}</p>", totals.lead(results.len()));
    warnings(&failures(results), &mut page);
    totals.cards(results.len(), &mut page);
    table(results, &mut page);
    let _ = write!(
        page,
        "<footer>Made by odograph {}. <a href=\"results.csv\">results.csv</a> has all figures of all \
         recordings.</footer>\n</main>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION")
    );
    page
}

/// Sums over all recordings.
#[derive(Default)]
struct Totals {
    done: usize,
    /// Of those, the ones with most frames without a pose.
    tracking_failed: usize,
    failed: usize,
    distance_m: f64,
    duration_s: f64,
    frames: f64,
    with_pose: f64,
}

impl Totals {
    fn of(results: &[RecordingResult]) -> Self {
        let mut totals = Self::default();
        for result in results {
            totals.done += usize::from(result.status().is_some_and(RunStatus::is_complete));
            totals.tracking_failed += usize::from(result.status() == Some(RunStatus::TrackingFailed));
            totals.failed += usize::from(result.status().is_some_and(RunStatus::is_failure));
            totals.distance_m += figure(result, "distance_m").unwrap_or(0.0);
            totals.duration_s += figure(result, "duration_s").unwrap_or(0.0);
            totals.frames += figure(result, "frames").unwrap_or(0.0);
            totals.with_pose += figure(result, "frames_with_pose").unwrap_or(0.0);
        }
        totals
    }

    fn lead(&self, of: usize) -> String {
        let left = of - self.done - self.failed;
        let begin = match self.done == of {
            true => format!("<b>All {of} recordings</b> were run."),
            false => format!("<b>{} of {of} recordings</b> were run.", self.done),
        };
        let failed = count(self.failed, "failed", "failed");
        let left = count(left, "is not done yet", "are not done yet");
        let untracked = count(self.tracking_failed, "has", "have");
        let untracked =
            if untracked.is_empty() { untracked } else { format!("{untracked} few frames with a pose.") };
        [begin, sentence(failed), sentence(left), untracked]
            .into_iter()
            .filter(|text| !text.is_empty())
            .collect::<Vec<_>>()
            .join(" ")
    }

    fn cards(&self, of: usize, page: &mut String) {
        page.push_str("<div class=\"cards\">\n");
        card("Done", &format!("{} of {of}", self.done), "Recordings that were run to their end.", page);
        card("Failed", &self.failed.to_string(), "Recordings that could not be run.", page);
        card("Distance", &distance_text(self.distance_m), "Length of all measured paths.", page);
        card("Duration", &duration_text(self.duration_s), "Of all recordings that were run.", page);
        let share = 100.0 * self.with_pose / self.frames.max(1.0);
        card(
            "Frames with a pose",
            &format!("{} %", tenths(share)),
            &format!("{} of {} frames.", self.with_pose, self.frames),
            page,
        );
        page.push_str("</div>\n");
    }
}

fn count(number: usize, one: &str, several: &str) -> String {
    match number {
        0 => String::new(),
        1 => format!("One {one}"),
        number => format!("{number} {several}"),
    }
}

fn sentence(words: String) -> String {
    if words.is_empty() { words } else { words + "." }
}

/// Why recordings failed, the first of them.
fn failures(results: &[RecordingResult]) -> Vec<String> {
    let failed = results.iter().filter(|result| result.status().is_some_and(RunStatus::is_failure));
    let mut sentences: Vec<String> =
        failed.map(|result| format!("{}: {}", result.name, result.error())).collect();
    let more = sentences.len().saturating_sub(MAX_FAILURES);
    sentences.truncate(MAX_FAILURES);
    sentences.extend((more > 0).then(|| format!("and {more} more, which the table lists")));
    sentences
}

fn table(results: &[RecordingResult], page: &mut String) {
    page.push_str(
        "<h2>Every recording</h2>\n<div class=\"box scroll\"><table class=\"figures\"><tr><th>Recording</th>\
         <th>Status</th><th class=\"number\">Distance</th><th class=\"number\">Duration</th>\
         <th class=\"number\">With a pose</th><th class=\"number\">Losses</th><th class=\"number\">Loops</th>\
         <th class=\"number\">Warnings</th></tr>\n",
    );
    for result in results {
        let name = escape(&result.name);
        let name = match result.statistics() {
            Some(_) => format!("<a href=\"{}/report.html\">{name}</a>", in_address(&result.name)),
            None => name,
        };
        let text = |figure: Option<f64>, text: &dyn Fn(f64) -> String| figure.map_or_else(String::new, text);
        let share = figure(result, "frames_with_pose")
            .zip(figure(result, "frames"))
            .map(|(with_pose, frames)| 100.0 * with_pose / frames.max(1.0));
        let loops = result.statistics().and_then(|all| all.get("loops")?.get("closed")?.as_f64());
        let warned = result.statistics().and_then(|all| all.get("warnings")?.as_array());
        let cells = [
            text(figure(result, "distance_m"), &distance_text),
            text(figure(result, "duration_s"), &duration_text),
            text(share, &|share| format!("{} %", tenths(share))),
            text(figure(result, "losses"), &|losses| losses.to_string()),
            text(loops, &|loops| loops.to_string()),
            warned.map_or_else(String::new, |warned| warned.len().to_string()),
        ];
        let _ = write!(page, "<tr><td>{name}</td><td>{}</td>", result.word());
        for cell in cells {
            let _ = write!(page, "<td class=\"number\">{cell}</td>");
        }
        page.push_str("</tr>\n");
    }
    page.push_str("</table></div>\n");
}

fn figure(result: &RecordingResult, name: &str) -> Option<f64> {
    result.statistics().and_then(|all: &Value| all.get(name)?.as_f64())
}

/// Rounded down to a tenth, so that 100 appears only if it is.
fn tenths(share: f64) -> String {
    format!("{:.1}", (10.0 * share).floor() / 10.0)
}

/// A path as part of an address.
fn in_address(path: &str) -> String {
    let mut address = String::new();
    for byte in path.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'-' | b'.' | b'_' | b'~' => {
                address.push(char::from(byte));
            }
            byte => {
                let _ = write!(address, "%{byte:02X}");
            }
        }
    }
    // A name with a colon at its start would be taken for a scheme.
    if address.starts_with('/') { address } else { format!("./{address}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph_session::batch::{Attempt, Ended, Inputs};
    use serde_json::json;
    use std::sync::Arc;

    #[test]
    fn the_page_says_what_became_of_each() {
        let result = |name: &str, ended: Option<Ended>| RecordingResult {
            name: name.to_owned(),
            source: String::new(),
            attempt: ended.map(|ended| {
                Arc::new(Attempt {
                    name: name.to_owned(),
                    source: String::new(),
                    number: 1,
                    worker: String::new(),
                    inputs: Inputs::default(),
                    ended: Some(ended),
                })
            }),
        };
        let statistics = |distance_m: f64| {
            json!({ "frames": 1000, "frames_with_pose": 999, "distance_m": distance_m, "duration_s": 30.0,
                    "losses": 1, "loops": { "closed": 2 }, "warnings": ["dark"] })
        };
        let done = |distance_m| Ended {
            how: RunStatus::Done,
            error: None,
            statistics: Some(statistics(distance_m)),
        };
        let failed = Ended { how: RunStatus::Failed, error: Some("no <video>".into()), statistics: None };
        let results = [
            result("hall 1/ä<b>", Some(done(1.5))),
            result("broken", Some(failed)),
            result("late", None),
            result("two", Some(done(2.5))),
        ];
        let page = recordings_html(&results);
        assert!(
            page.contains("<b>2 of 4 recordings</b> were run. One failed. One is not done yet.</p>"),
            "{page}"
        );
        assert!(
            page.contains("<a href=\"./hall%201/%C3%A4%3Cb%3E/report.html\">hall 1/ä&lt;b&gt;</a>"),
            "{page}"
        );
        assert!(page.contains("<li>broken: no &lt;video&gt;</li>"), "{page}");
        assert!(page.contains("<tr><td>late</td><td>waiting</td>"), "{page}");
        assert!(page.contains("<b>4.00 m</b>") && page.contains("<b>99.9 %</b>"), "{page}");
        let all = recordings_html(&results[3..]);
        assert!(all.contains("<p class=\"lead\"><b>All 1 recordings</b> were run.</p>"), "{all}");
    }
}
