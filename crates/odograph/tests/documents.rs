//! What the documents say about the source code: the files and folders that they name exist.

#![allow(clippy::unwrap_used)] // a test fails by panicking

use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Paths of source files and folders in code quotes: `flow/track.rs`, `motion/dense/`.
fn quoted_paths(text: &str) -> Vec<&str> {
    let quoted = text.split('`').skip(1).step_by(2);
    let is_path = |text: &str| {
        let named = text.chars().all(|c| c.is_alphanumeric() || "_-/.".contains(c));
        named && (text.ends_with(".rs") || text.ends_with('/'))
    };
    quoted.filter(|text| is_path(text)).collect()
}

/// Folders that the list of crates names: each crate at the start of a line, with its rooms
/// indented below it.
fn listed_folders(architecture: &str) -> Vec<PathBuf> {
    let list = architecture.split("## Crates").nth(1).and_then(|rest| rest.split("```").nth(1)).unwrap();
    let (mut base, mut folders) = (PathBuf::new(), Vec::new());
    for line in list.lines().skip(1) {
        let mut names = line.split_whitespace().filter(|name| name.ends_with('/'));
        if line.starts_with(' ') {
            folders.extend(names.map(|name| base.join("src").join(name)));
        } else if let Some(folder) = names.next() {
            base = PathBuf::from(folder);
            folders.push(base.clone());
        }
    }
    folders
}

#[test]
fn files_and_folders_named_in_the_documents_exist() {
    let mut missing = String::new();
    let documents = ["ARCHITECTURE.md", "docs/glossary.md", "docs/math/README.md"];
    for document in documents {
        let text = fs::read_to_string(root().join(document)).unwrap();
        let paths = quoted_paths(&text);
        assert!(paths.len() > 10, "{document} names {} paths", paths.len());
        for path in paths {
            let places = ["crates/odograph/src", "crates", ""];
            if !places.iter().any(|place| root().join(place).join(path).exists()) {
                missing += &format!("\n{document}: {path}");
            }
        }
    }
    let architecture = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let folders = listed_folders(&architecture);
    assert!(folders.len() > 30, "{folders:?}");
    for folder in folders.iter().filter(|folder| !root().join(folder).is_dir()) {
        missing += &format!("\nARCHITECTURE.md: {}", folder.display());
    }
    assert!(missing.is_empty(), "no such file or folder:{missing}\n");
}

#[test]
fn only_paths_of_source_code_are_taken_from_a_document() {
    let text = "`flow/track.rs`, `motion/dense/` and `Sim2`, `a / b/`, `run.toml`; no/code.rs";
    assert_eq!(quoted_paths(text), ["flow/track.rs", "motion/dense/"]);
    let list = "## Crates\n\n```text\ncrates/one/  first\n  a b/ c/ (words)\nbench/  x\n```\n";
    let folders: Vec<_> = listed_folders(list).iter().map(|folder| folder.display().to_string()).collect();
    assert_eq!(folders, ["crates/one/", "crates/one/src/b/", "crates/one/src/c/", "bench/"]);
}
