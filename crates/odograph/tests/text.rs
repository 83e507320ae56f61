//! Rules for text, checked on the checkout: links and paths in documents lead somewhere, the README
//! fits two screens, and comments are at most 100 columns wide.

#![allow(clippy::unwrap_used)] // a test fails by panicking

use std::fs;
use std::path::{Path, PathBuf};

/// Largest width of a line, in characters.
const COLUMNS: usize = 100;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

/// All files below a folder with this extension, sorted. Hidden folders and build results are left
/// out.
fn files(folder: &Path, extension: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
        let path = entry.path();
        let name = entry.file_name().to_string_lossy().into_owned();
        if path.is_dir() && !name.starts_with('.') && name != "target" && name != "shared" {
            found.extend(files(&path, extension));
        } else if path.extension().is_some_and(|it| it == extension) {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// The path as it is named in messages.
fn shown(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).display().to_string()
}

/// The text between every pair of `open` and `close` within a line.
fn between<'a>(text: &'a str, open: &'a str, close: char) -> impl Iterator<Item = &'a str> {
    text.lines()
        .flat_map(move |line| line.split(open).skip(1))
        .filter_map(move |rest| Some(rest.split_once(close)?.0))
}

/// The text in backticks.
fn quoted(text: &str) -> impl Iterator<Item = &str> {
    text.lines().flat_map(|line| line.split('`').skip(1).step_by(2))
}

/// The anchors of a document: its headings in lower case, spaces as hyphens, without punctuation.
fn anchors(text: &str) -> Vec<String> {
    let headings =
        text.lines().filter_map(|line| Some(line.strip_prefix('#')?.trim_start_matches('#').trim()));
    let anchor = |heading: &str| {
        let kept = heading.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
        kept.map(|c| if c == ' ' { '-' } else { c.to_ascii_lowercase() }).collect()
    };
    headings.map(anchor).collect()
}

#[test]
fn links_of_documents_lead_somewhere() {
    let mut broken = Vec::new();
    for document in files(&root(), "md") {
        let text = fs::read_to_string(&document).unwrap();
        for link in between(&text, "](", ')').filter(|link| !link.contains("://")) {
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = match file {
                "" => document.clone(),
                file => document.parent().unwrap().join(file),
            };
            let leads = target.exists()
                && (anchor.is_empty()
                    || anchors(&fs::read_to_string(&target).unwrap())
                        .iter()
                        .any(|heading| heading == anchor));
            if !leads {
                broken.push(format!("{}: {link}", shown(&document)));
            }
        }
    }
    assert!(broken.is_empty(), "broken links:\n{}", broken.join("\n"));
}

#[test]
fn paths_in_documents_and_comments_exist() {
    let root = root();
    // Derivations and glossary name files below this folder.
    let library = root.join("crates/odograph/src");
    let mut missing = Vec::new();
    let mut look = |file: &Path, path: &str| {
        let plain = path.chars().all(|c| c.is_ascii_alphanumeric() || "/._-".contains(c));
        let rooted = ["docs/", "crates/", "bench/"].iter().any(|start| path.starts_with(start));
        let source = path.contains('/') && path.ends_with(".rs") && file.starts_with(root.join("docs"));
        let here = [root.as_path(), &library, &root.join("crates"), &root.join("crates/odograph-cli")];
        if plain && (rooted || source) && !here.iter().any(|folder| folder.join(path).exists()) {
            missing.push(format!("{}: {path}", shown(file)));
        }
    };
    for document in files(&root, "md") {
        let text = fs::read_to_string(&document).unwrap();
        quoted(&text).for_each(|path| look(&document, path));
    }
    for source in files(&root.join("crates"), "rs") {
        let text = fs::read_to_string(&source).unwrap();
        let comments = text.lines().filter(|line| line.trim_start().starts_with("//"));
        for line in comments {
            quoted(line).filter(|path| path.starts_with("docs/")).for_each(|path| look(&source, path));
        }
    }
    assert!(missing.is_empty(), "files that do not exist:\n{}", missing.join("\n"));
}

#[test]
fn readme_is_short() {
    let text = fs::read_to_string(root().join("README.md")).unwrap();
    assert!(text.lines().count() <= 120, "the README has {} lines", text.lines().count());
}

#[test]
fn lines_of_comments_and_documents_are_narrow() {
    let root = root();
    let mut wide = Vec::new();
    let mut check = |file: &Path, number: usize, line: &str| {
        if line.chars().count() > COLUMNS {
            wide.push(format!("{}:{}", shown(file), number + 1));
        }
    };
    for source in files(&root.join("crates"), "rs") {
        let text = fs::read_to_string(&source).unwrap();
        let mut in_code = false;
        for (number, line) in text.lines().enumerate() {
            let is_comment = line.trim_start().starts_with("//");
            in_code = is_comment && in_code != line.trim_start_matches([' ', '/', '!']).starts_with("```");
            if is_comment && !in_code {
                check(&source, number, line);
            }
        }
    }
    for document in ["README.md", "CHANGELOG.md"] {
        let text = fs::read_to_string(root.join(document)).unwrap();
        text.lines().enumerate().for_each(|(number, line)| check(&root.join(document), number, line));
    }
    for document in files(&root.join("docs"), "md") {
        let text = fs::read_to_string(&document).unwrap();
        let mut in_code = false;
        for (number, line) in text.lines().enumerate() {
            in_code ^= line.trim_start().starts_with("```");
            // Rows of tables and commands cannot be wrapped.
            if !in_code && !line.starts_with('|') {
                check(&document, number, line);
            }
        }
    }
    assert!(wide.is_empty(), "wider than {COLUMNS} columns:\n{}", wide.join("\n"));
}

#[test]
fn every_derivation_is_cited_by_the_code() {
    let root = root();
    let code: String =
        files(&root.join("crates"), "rs").iter().map(|file| fs::read_to_string(file).unwrap()).collect();
    let pages = files(&root.join("docs/math"), "md").into_iter().filter(|page| !page.ends_with("README.md"));
    let uncited: Vec<_> = pages
        .map(|page| format!("docs/math/{}", page.file_name().unwrap().to_string_lossy()))
        .filter(|page| !code.contains(page.as_str()))
        .collect();
    assert!(uncited.is_empty(), "no comment cites {uncited:?}");
}

#[test]
fn anchors_follow_the_headings() {
    assert_eq!(anchors("# A budget\ntext\n## Never late (1)\n"), ["a-budget", "never-late-1"]);
}
