//! What a command left in its folder: files that are complete, and files that should not be there.

use std::fs;
use std::path::{Path, PathBuf};

/// Endings of files that exist only while a program runs, or after it was killed.
const PASSING: [&str; 6] = [".part", ".new", ".lock", "-wal", "-shm", "-journal"];

/// All files below a folder, sorted.
pub fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() { found.extend(files(&path)) } else { found.push(path) }
    }
    found.sort();
    found
}

/// Whether a file exists only while a program runs.
pub fn is_passing(path: &Path) -> bool {
    let name = path.to_string_lossy();
    PASSING.iter().any(|ending| name.ends_with(ending))
}

/// What is wrong with a file under its final name; `None` if it is complete. Maps are checked
/// elsewhere.
pub fn damage(path: &Path) -> Option<String> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(error) => return Some(format!("{} cannot be read: {error}", path.display())),
    };
    let ends = |with: &[u8]| bytes.trim_ascii_end().ends_with(with);
    let complete = match path.extension().and_then(|extension| extension.to_str()) {
        Some("png") => bytes.starts_with(b"\x89PNG") && bytes.ends_with(b"IEND\xae\x42\x60\x82"),
        Some("json") => serde_json::from_slice::<serde_json::Value>(&bytes).is_ok(),
        Some("html") => ends(b"</html>"),
        Some("svg") => ends(b"</svg>"),
        Some("tum" | "csv" | "toml" | "pgw" | "yaml") => bytes.ends_with(b"\n"),
        _ => true,
    };
    (!complete).then(|| format!("{} is half-written: {} bytes", path.display(), bytes.len()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test may panic

    use super::*;

    #[test]
    fn half_written_files_are_recognised() {
        let folder = tempfile::tempdir().unwrap();
        let damaged = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            fs::write(&path, bytes).unwrap();
            damage(&path).is_some()
        };
        for (name, whole) in [
            ("a.json", &b"{\"frames\": 1}\n"[..]),
            ("a.html", b"<html></html>\n"),
            ("a.svg", b"<svg></svg>"),
            ("a.tum", b"0 0 0 0 0 0 0 1\n"),
            ("a.png", b"\x89PNG\r\n\x1a\n....IEND\xae\x42\x60\x82"),
        ] {
            assert!(!damaged(name, whole), "{name}");
            assert!(damaged(name, &whole[..whole.len() / 2]), "half of {name}");
        }
        assert!(is_passing(Path::new("map.gpkg-wal")) && !is_passing(Path::new("map.gpkg")));
    }
}
