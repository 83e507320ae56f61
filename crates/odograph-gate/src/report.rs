//! The output of the gate: Markdown tables and a summary line.

use crate::baseline::{BaselineVerdict, Comparison, GateResults, RowFigures};
use crate::figures::{Figures, MEASURES, Measure, measure};
use std::fmt::Write;

/// Table of all measured rows.
pub fn table(measured: &GateResults) -> String {
    let shown = |m: &&Measure| measured.rows.iter().any(|row| row.figures.get(m.key).is_some());
    let columns: Vec<&Measure> = MEASURES.iter().filter(shown).collect();
    let mut text = rows_table("row", &measured.rows, &columns);
    for one in MEASURES.iter() {
        if let Some(value) = measured.process.get(one.key) {
            let _ = writeln!(text, "{}: {value:.*}", one.title, one.decimals);
        }
    }
    text
}

/// Table of rows with the given columns.
pub fn rows_table(first_column: &str, rows: &[RowFigures], columns: &[&Measure]) -> String {
    let mut text = format!("| {first_column} |");
    columns.iter().for_each(|measure| text += &format!(" {} |", measure.title));
    text += &format!("\n|---|{}\n", "---|".repeat(columns.len()));
    for row in rows {
        text += &format!("| {} |", row.name);
        columns.iter().for_each(|measure| text += &format!(" {} |", cell(measure, &row.figures)));
        text += "\n";
    }
    text
}

fn cell(measure: &Measure, figures: &Figures) -> String {
    let shown = |value: f64| {
        let decimals = if value.abs() < 1000.0 { measure.decimals } else { 0 };
        format!("{value:.decimals$}")
    };
    figures.get(measure.key).map_or("–".to_owned(), shown)
}

/// The results that became worse or better, and the summary line.
pub fn comparison(comparison: &Comparison, measured: &GateResults) -> String {
    let mut text = String::new();
    for (verdict, heading) in [(BaselineVerdict::Worse, "Worse"), (BaselineVerdict::Better, "Better")] {
        let changes: Vec<_> = comparison.changes.iter().filter(|c| c.verdict == verdict).collect();
        if changes.is_empty() {
            continue;
        }
        let _ = writeln!(text, "{heading} than the baseline:\n\n| row | figure | baseline | now |");
        text += "|---|---|---|---|\n";
        for change in changes {
            let title = measure(change.key).map_or(change.key, |measure| measure.title);
            let shown = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value}"));
            let (old, new) = (shown(change.old), shown(change.new));
            let _ = writeln!(text, "| {} | {title} | {old} | {new} |", change.row);
        }
        text += "\n";
        if verdict == BaselineVerdict::Better {
            text += "Store them with --update-baseline, together with the change that made them better.\n";
        }
    }
    for failed in &measured.failed {
        let _ = writeln!(text, "FAILED: {}: {}", failed.name, failed.reason);
    }
    text + &closing_line(comparison, measured)
}

fn closing_line(comparison: &Comparison, measured: &GateResults) -> String {
    let mut line = format!("gate: {} rows passed, {} worse", comparison.passed, comparison.worse);
    for (count, what) in [(measured.failed.len(), "failed"), (comparison.not_compared, "not compared")] {
        if count > 0 {
            let _ = write!(line, ", {count} {what}");
        }
    }
    if let Some(first) = measured.skipped.first() {
        let _ = write!(line, ", {} skipped ({})", measured.skipped.len(), first.reason);
    }
    line
}
