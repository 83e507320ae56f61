//! The results of all recordings in one table.

use super::manifest::{Attempt, RunStatus};
use super::recordings::Recording;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::sync::Arc;

/// What became of one recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordingResult {
    /// Name of the results.
    pub name: String,
    /// The recording as it was given.
    pub source: String,
    /// Its last attempt; `None` if it was not begun.
    pub attempt: Option<Arc<Attempt>>,
}

impl RecordingResult {
    /// How the last attempt ended; `None` if it has not.
    pub fn status(&self) -> Option<RunStatus> {
        self.attempt.as_ref().and_then(|attempt| attempt.ended.as_ref()).map(|ended| ended.how)
    }

    /// The status in a word.
    pub fn word(&self) -> &'static str {
        match (&self.attempt, self.status()) {
            (_, Some(status)) => status.word(),
            (Some(_), None) => "begun",
            (None, None) => "waiting",
        }
    }

    /// Why it failed; empty if it did not.
    pub fn error(&self) -> &str {
        let ended = self.attempt.as_ref().and_then(|attempt| attempt.ended.as_ref());
        ended.and_then(|ended| ended.error.as_deref()).unwrap_or_default()
    }

    /// The statistics of the run.
    pub fn statistics(&self) -> Option<&Value> {
        self.attempt.as_ref()?.ended.as_ref()?.statistics.as_ref()
    }
}

/// The results of recordings and of those with attempts, in the order of their names.
pub(super) fn of(recordings: &[Recording], last: &BTreeMap<String, Arc<Attempt>>) -> Vec<RecordingResult> {
    let listed = recordings.iter().map(|recording| (&recording.name, &recording.source));
    let begun = last.values().map(|attempt| (&attempt.name, &attempt.source));
    let all: BTreeMap<&String, &String> = listed.chain(begun).collect();
    let result = |(name, source): (&String, &String)| RecordingResult {
        name: name.clone(),
        source: source.clone(),
        attempt: last.get(name).cloned(),
    };
    all.into_iter().map(result).collect()
}

/// Columns of the table before those of the statistics.
const COLUMNS: [&str; 7] =
    ["recording", "status", "error", "source", "attempts", "recording_sha256", "odograph_version"];

/// The statistics that stand first; all others follow by name.
const FIRST: [&str; 5] = ["frames", "frames_with_pose", "duration_s", "distance_m", "losses"];

/// The table as CSV (RFC 4180 with lines that end as on Unix): a line for each recording, with all
/// figures of its `stats.json`. The name of a figure within another is joined by points. Of a list
/// of objects the table has only their number.
pub fn csv(results: &[RecordingResult]) -> String {
    let figures: Vec<BTreeMap<String, String>> = results
        .iter()
        .map(|result| {
            let mut cells = BTreeMap::new();
            if let Some(statistics) = result.statistics() {
                flatten("", statistics, &mut cells);
            }
            cells
        })
        .collect();
    let named: BTreeSet<&str> = figures.iter().flat_map(|cells| cells.keys().map(String::as_str)).collect();
    let first = FIRST.into_iter().filter(|name| named.contains(name));
    let names: Vec<&str> = first.chain(named.iter().copied().filter(|name| !FIRST.contains(name))).collect();
    let mut table = String::new();
    line(COLUMNS.into_iter().chain(names.iter().copied()), &mut table);
    for (result, cells) in results.iter().zip(&figures) {
        let attempt = result.attempt.as_ref();
        let attempts = attempt.map_or_else(String::new, |attempt| attempt.number.to_string());
        let inputs = attempt.map(|attempt| &attempt.inputs);
        let own = [
            result.name.as_str(),
            result.word(),
            result.error(),
            &result.source,
            &attempts,
            inputs.and_then(|inputs| inputs.recording.as_deref()).unwrap_or_default(),
            inputs.map_or("", |inputs| inputs.odograph.as_str()),
        ];
        let cell = |name: &&str| cells.get(*name).map_or("", String::as_str);
        line(own.into_iter().chain(names.iter().map(cell)), &mut table);
    }
    table
}

/// Adds the figures in a value, each under its name.
fn flatten(name: &str, value: &Value, cells: &mut BTreeMap<String, String>) {
    let text = match value {
        Value::Object(inside) => {
            for (key, value) in inside {
                let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                flatten(&name, value, cells);
            }
            return;
        }
        Value::Array(list) if list.iter().any(Value::is_object) => list.len().to_string(),
        Value::Array(list) => list.iter().map(scalar).collect::<Vec<_>>().join("; "),
        value => scalar(value),
    };
    cells.insert(name.to_owned(), text);
}

fn scalar(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

fn line<'a>(cells: impl Iterator<Item = &'a str>, table: &mut String) {
    for (index, cell) in cells.enumerate() {
        if index > 0 {
            table.push(',');
        }
        let quoted = cell.contains([',', '"', '\n', '\r']);
        let _ = match quoted {
            true => write!(table, "\"{}\"", cell.replace('"', "\"\"")),
            false => write!(table, "{cell}"),
        };
    }
    table.push('\n');
}

#[cfg(test)]
mod tests {
    use super::super::manifest::Ended;
    use super::*;
    use odograph::error::Error;
    use serde_json::json;

    #[test]
    fn the_table_has_every_recording_and_every_figure() {
        let attempt = |name: &str, ended| Attempt {
            name: name.to_owned(),
            source: format!("{name}.mp4"),
            number: 2,
            worker: String::new(),
            inputs: super::super::Inputs {
                odograph: "1.0".to_owned(),
                recording: Some("abc".to_owned()),
                ..Default::default()
            },
            ended: Some(ended),
        };
        let statistics = json!({
            "frames": 3, "loops": { "closed": 1, "turn_per_m": [0.5, 0.25] }, "sensors": [{}, {}],
            "warnings": ["dark, mostly", "blur"], "peak_memory_bytes": null,
        });
        let done = Ended { how: RunStatus::Done, error: None, statistics: Some(statistics) };
        let failed = Ended::failed(&Error::input("b.mp4: \"no\" video"));
        let last = [("a", done), ("b", failed)];
        let last = last.map(|(name, ended)| (name.to_owned(), Arc::new(attempt(name, ended))));
        let last = last.into_iter().collect();
        let waiting = Recording { source: "c.mp4".to_owned(), name: "c".to_owned() };
        let text = csv(&of(&[waiting], &last));
        let expected = "\
recording,status,error,source,attempts,recording_sha256,odograph_version,frames,loops.closed,loops.turn_per_m,\
peak_memory_bytes,sensors,warnings
a,done,,a.mp4,2,abc,1.0,3,1,0.5; 0.25,,2,\"dark, mostly; blur\"
b,failed,\"b.mp4: \"\"no\"\" video\",b.mp4,2,abc,1.0,,,,,,
c,waiting,,c.mp4,,,,,,,,,
";
        assert_eq!(text, expected);
    }
}
