//! Command-line arguments.

use crate::field;
use crate::rows::{self, BenchmarkRow, Follow};
use clap::Parser;
use std::path::PathBuf;

/// Measures a fixed set of recordings and compares the figures with a stored baseline.
#[derive(Debug, Parser)]
#[command(name = "gate", version)]
pub struct GateArguments {
    /// Only rows whose name contains one of these words.
    pub words: Vec<String>,
    /// The rows of the field instead of the gate's: disturbances of all kinds, for comparison with
    /// other programs over several seeds.
    #[arg(long)]
    pub field: bool,
    /// Tracks the rendered rows as `odograph live` does: frame by frame, without a second pass.
    #[arg(long)]
    pub live: bool,
    /// Number of clips rendered and tracked in parallel; by default all available cores.
    #[arg(long)]
    pub threads: Option<usize>,
    /// Number of seeds of every rendered row; by default that of the row. Results for other seeds
    /// than the baseline's are shown, not compared.
    #[arg(long)]
    pub seeds: Option<u64>,
    /// First seed.
    #[arg(long, default_value_t = 0)]
    pub first_seed: u64,
    /// Writes the results to this file, in the format of the baseline.
    #[arg(long)]
    pub json: Option<PathBuf>,
    /// The stored results.
    #[arg(long, default_value = "bench/baseline.json")]
    pub baseline: PathBuf,
    /// Stores the results instead of comparing them; rows that were not measured keep their values.
    #[arg(long)]
    pub update_baseline: bool,
    /// Writes each clip of the selected rendered rows into a folder of its own here (Y4M, camera,
    /// rig, ground truth) and measures nothing.
    #[arg(long)]
    pub export: Option<PathBuf>,
    /// Rewrites the tables between `gate:begin` and `gate:end` in docs/accuracy.md and
    /// docs/reliability.md from the stored results and measures nothing.
    #[arg(long)]
    pub tables: bool,
}

impl GateArguments {
    /// Whether the row of that name is selected.
    pub fn asks_for(&self, name: &str) -> bool {
        self.words.is_empty() || self.words.iter().any(|word| name.contains(word.as_str()))
    }

    /// The rendered rows that are selected.
    pub fn rows(&self) -> Vec<BenchmarkRow> {
        let rows = if self.field { field::rows() } else { rows::rows() };
        let asked_for = rows.into_iter().filter(|row| self.asks_for(row.name));
        let as_asked =
            |row: BenchmarkRow| if self.live { BenchmarkRow { follow: Follow::Live, ..row } } else { row };
        asked_for.map(as_asked).collect()
    }

    /// Number of threads, at least 1.
    pub fn thread_count(&self) -> usize {
        let available = || std::thread::available_parallelism().map_or(1, usize::from);
        self.threads.unwrap_or_else(available).max(1)
    }
}
