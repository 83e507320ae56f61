//! What the command line says.

use clap::Parser;
use std::path::PathBuf;

/// Measures a fixed set of recordings and compares the figures with a stored baseline.
#[derive(Debug, Parser)]
#[command(name = "gate", version)]
pub struct Arguments {
    /// Only rows whose name contains one of these words.
    pub words: Vec<String>,
    /// Clips rendered and followed at once; all available cores by default.
    #[arg(long)]
    pub threads: Option<usize>,
    /// Seeds of every rendered row; by default as many as the row says. Other seeds than the
    /// baseline's are shown, not compared.
    #[arg(long)]
    pub seeds: Option<u64>,
    /// First seed.
    #[arg(long, default_value_t = 0)]
    pub first_seed: u64,
    /// Writes the figures there, in the format of the baseline.
    #[arg(long)]
    pub json: Option<PathBuf>,
    /// The stored figures.
    #[arg(long, default_value = "bench/baseline.json")]
    pub baseline: PathBuf,
    /// Stores what was measured instead of comparing; rows that were not measured stay as they are.
    #[arg(long)]
    pub update_baseline: bool,
    /// Writes each clip of the chosen rendered rows into a folder of its own there (Y4M, camera,
    /// rig, truth) and measures nothing.
    #[arg(long)]
    pub export: Option<PathBuf>,
    /// Rewrites the tables between `gate:begin` and `gate:end` in README.md from the baseline and
    /// measures nothing.
    #[arg(long)]
    pub tables: bool,
}

impl Arguments {
    /// Whether a row of that name is asked for.
    pub fn asks_for(&self, name: &str) -> bool {
        self.words.is_empty() || self.words.iter().any(|word| name.contains(word.as_str()))
    }

    /// Number of threads, at least 1.
    pub fn thread_count(&self) -> usize {
        let available = || std::thread::available_parallelism().map_or(1, usize::from);
        self.threads.unwrap_or_else(available).max(1)
    }
}
