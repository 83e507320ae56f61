//! Tables in documents, generated from the baseline between `<!-- gate:begin NAME -->` and `<!--
//! gate:end -->`.

use crate::baseline::{Baseline, RowFigures};
use crate::figures::{Figures, Measure, measure};
use crate::recordings;
use crate::report::rows_table;
use odograph::error::{Error, Result};
use std::collections::BTreeMap;
use std::path::Path;

/// Documents with generated tables, relative to the root of the checkout.
const DOCUMENTS: [&str; 2] = ["docs/accuracy.md", "docs/reliability.md"];

/// Rewrites the tables of all documents from the baseline.
pub fn rewrite(baseline: &Path) -> Result<()> {
    let baseline = Baseline::read_or_empty(baseline)?;
    for document in DOCUMENTS {
        let failed = |error: std::io::Error| Error::output(format!("{document}: {error}"));
        let text = std::fs::read_to_string(document).map_err(failed)?;
        let new = with_tables(&text, &baseline)?;
        if new != text {
            std::fs::write(document, new).map_err(failed)?;
            println!("{document} rewritten");
        }
    }
    Ok(())
}

/// Returns a document with its tables generated from the baseline.
fn with_tables(document: &str, baseline: &Baseline) -> Result<String> {
    let mut text = String::new();
    let mut rest = document;
    while let Some((before, after)) = rest.split_once("<!-- gate:begin ") {
        let unended = || Error::input("a gate:begin has no gate:end");
        let (name, after) = after.split_once(" -->").ok_or_else(unended)?;
        let (_, after) = after.split_once("<!-- gate:end -->").ok_or_else(unended)?;
        let table = table(name, baseline)?;
        text += &format!("{before}<!-- gate:begin {name} -->\n{table}<!-- gate:end -->");
        rest = after;
    }
    Ok(text + rest)
}

/// Figures of the field's rows, and those of `bench/opencv_reference.py --field` over the same
/// clips.
const FIELD: &str = include_str!("../../../bench/field.json");
const FIELD_OF_OPENCV: &str = include_str!("../../../bench/field-opencv.json");

/// The rows of the field beside the plain OpenCV program.
fn field_table() -> Result<String> {
    let unreadable = |error: serde_json::Error| Error::input(format!("bench/field*.json: {error}"));
    let ours: Baseline = serde_json::from_str(FIELD).map_err(unreadable)?;
    let theirs: BTreeMap<String, Figures> = serde_json::from_str(FIELD_OF_OPENCV).map_err(unreadable)?;
    let mut text = String::from(
        "| row | error over each metre, % | OpenCV | at the end, mm | OpenCV | stated σ, mm | NEES |\n\
         |---|---|---|---|---|---|---|\n",
    );
    for row in &ours.rows {
        let other = theirs.get(&row.name).cloned().unwrap_or_default();
        let cell = |figures: &Figures, key, decimals: usize| {
            figures.get(key).map_or("–".to_owned(), |value| format!("{value:.decimals$}"))
        };
        let cells = [
            cell(&row.figures, "drift_percent", 4),
            cell(&other, "drift_percent", 4),
            cell(&row.figures, "end_mm", 2),
            cell(&other, "end_mm", 2),
            cell(&row.figures, "end_sigma_mm", 2),
            cell(&row.figures, "nees", 1),
        ];
        text += &format!("| {} | {} |\n", row.name, cells.join(" | "));
    }
    Ok(text)
}

/// Figures of `odograph-reliability`.
const KILLS: &str = include_str!("../../../bench/kills.json");

/// The commands that were killed, and what was checked after it.
fn kills_table() -> Result<String> {
    let unreadable = || Error::input("bench/kills.json is not what odograph-reliability writes");
    let kills: serde_json::Value = serde_json::from_str(KILLS).map_err(|_| unreadable())?;
    let commands = kills["commands"].as_object().ok_or_else(unreadable)?;
    let mut text = String::from("| command |");
    KILL_COLUMNS.iter().for_each(|(_, title)| text += &format!(" {title} |"));
    text += &format!("\n|---{}|\n", "|---".repeat(KILL_COLUMNS.len()));
    let mut sums = [0; KILL_COLUMNS.len()];
    for (name, figures) in commands {
        text += &format!("| `{name}` |");
        for ((key, _), sum) in KILL_COLUMNS.iter().zip(&mut sums) {
            let value = figures[*key].as_u64().ok_or_else(unreadable)?;
            *sum += value;
            text += &format!(" {value} |");
        }
        text.push('\n');
    }
    text += "| all |";
    sums.iter().for_each(|sum| text += &format!(" {sum} |"));
    Ok(text + "\n")
}

const KILL_COLUMNS: [(&str, &str); 9] = [
    ("killed", "SIGKILL"),
    ("interrupted", "SIGTERM, SIGINT"),
    ("ended_before", "had ended"),
    ("early", "within 150 ms"),
    ("maps_checked", "maps checked"),
    ("keyframes_checked", "keyframes"),
    ("frames_checked", "frames"),
    ("run_again", "run again"),
    ("failed", "failed checks"),
];

/// Figures of `fuzz/run.py`.
const FUZZ: &str = include_str!("../../../bench/fuzz.json");

/// The fuzz targets, how long they ran and what that found.
fn fuzz_table() -> Result<String> {
    let unreadable = || Error::input("bench/fuzz.json is not what fuzz/run.py writes");
    let fuzz: serde_json::Value = serde_json::from_str(FUZZ).map_err(|_| unreadable())?;
    let targets = fuzz["targets"].as_object().ok_or_else(unreadable)?;
    let mut text = String::from(
        "| target | executions | processor minutes | features | memory, MB | failures | inputs that once failed |\n\
         |---|---|---|---|---|---|---|\n",
    );
    let (mut executions, mut seconds, mut failures, mut kept) = (0, 0, 0, 0);
    for (name, figures) in targets {
        let number = |key: &str| figures[key].as_u64().ok_or_else(unreadable);
        let (ran, took_s, failed, inputs) =
            (number("executions")?, number("processor_s")?, number("failures")?, number("regressions")?);
        let (features, memory_mb) = (number("features")?, number("memory_mb")?);
        text += &format!(
            "| `{name}` | {ran} | {:.1} | {features} | {memory_mb} | {failed} | {inputs} |\n",
            took_s as f64 / 60.0
        );
        (executions, seconds, failures, kept) =
            (executions + ran, seconds + took_s, failures + failed, kept + inputs);
    }
    text += &format!("| all | {executions} | {:.1} | | | {failures} | {kept} |\n", seconds as f64 / 60.0);
    Ok(text)
}

/// The table of that name.
fn table(name: &str, baseline: &Baseline) -> Result<String> {
    if name == "field" {
        return field_table();
    }
    if name == "kills" {
        return kills_table();
    }
    if name == "fuzz" {
        return fuzz_table();
    }
    let is_real = |row: &&RowFigures| recordings::all().iter().any(|real| real.name == row.name);
    let (rows, keys): (Vec<&RowFigures>, &[&str]) = match name {
        "rendered" => (
            baseline.rows.iter().filter(|row| !is_real(row)).collect(),
            &["posed_percent", "drift_percent", "heading_deg_per_m", "end_mm", "end_sigma_mm", "nees"],
        ),
        "real" => (baseline.rows.iter().filter(is_real).collect(), &["posed_percent", "lost", "ate_mm"]),
        _ => return Err(Error::usage(format!("no table is called {name}"))),
    };
    let columns: Vec<&Measure> = keys.iter().filter_map(|key| measure(key)).collect();
    let rows: Vec<RowFigures> = rows.into_iter().cloned().collect();
    Ok(rows_table("row", &rows, &columns))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rows::BenchmarkRow;
    use crate::{field, recordings, rows};

    #[test]
    fn documents_contain_the_tables_of_the_baseline() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let baseline = Baseline::read_or_empty(&root.join("bench/baseline.json")).unwrap();
        for document in DOCUMENTS {
            let text = std::fs::read_to_string(root.join(document)).unwrap();
            assert!(text.contains("<!-- gate:begin "), "{document} has no generated table");
            let wanted = with_tables(&text, &baseline).unwrap();
            assert!(text == wanted, "{document}: run `cargo run --release -p odograph-gate -- --tables`");
        }
    }

    #[test]
    fn rows_with_stored_results_can_be_measured() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let measured = |rows: Vec<BenchmarkRow>| -> Vec<&str> { rows.iter().map(|row| row.name).collect() };
        let recorded = recordings::all();
        let in_gate: Vec<&str> = measured(rows::rows())
            .into_iter()
            .chain(recorded.iter().map(|recording| recording.name))
            .collect();
        for (file, known) in [("bench/baseline.json", in_gate), ("bench/field.json", measured(field::rows()))]
        {
            for row in Baseline::read_or_empty(&root.join(file)).unwrap().rows {
                assert!(
                    known.contains(&row.name.as_str()),
                    "{file} has `{}`, which the gate has not",
                    row.name
                );
            }
        }
    }
}
