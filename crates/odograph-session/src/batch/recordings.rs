//! The recordings in a folder, and the names of their results.

use odograph_video::{is_recording_folder, is_robot_recording};
use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Extensions of video files.
const VIDEO_EXTENSIONS: [&str; 15] = [
    "mp4", "m4v", "mov", "mkv", "webm", "avi", "y4m", "264", "h264", "avc", "265", "h265", "hevc", "mpg",
    "ts",
];
/// Extensions of robot recordings.
const BAG_EXTENSIONS: [&str; 3] = ["mcap", "bag", "db3"];
/// Extensions of images: a folder with any of them is one recording, a sequence of images.
const PICTURE_EXTENSIONS: [&str; 8] = ["png", "jpg", "jpeg", "tif", "tiff", "pgm", "ppm", "pnm"];

/// One of several recordings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recording {
    /// Its file or folder.
    pub source: String,
    /// Name of its results, with `/` where it is in a folder of the given one.
    pub name: String,
}

/// Where recordings are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Search<'a> {
    /// Videos in a folder, not in its folders.
    Videos,
    /// Every recording in a folder and in its folders, except for those of the results.
    Tree {
        /// The folder of the results.
        results: &'a Path,
    },
}

impl Recording {
    /// The recordings of a call: those in each given folder that is not a recording itself, and all
    /// else as it is.
    pub fn listed<'a>(sources: impl Iterator<Item = &'a String>, search: Search<'_>) -> Vec<Self> {
        let results = match search {
            Search::Videos => None,
            Search::Tree { results } => results.canonicalize().ok(),
        };
        let is_deep = search != Search::Videos;
        let mut taken = HashSet::new();
        let mut listed = Vec::new();
        for source in sources {
            let folder = Path::new(source);
            let mut found =
                Found { is_deep, results: results.as_deref(), seen: HashSet::new(), recordings: Vec::new() };
            // A folder of that name is `./-`.
            if source != "-" && !is_one_recording(folder) {
                found.search(folder);
            }
            if found.recordings.is_empty() {
                let name = free_name(own_name(folder), &mut taken);
                listed.push(Self { source: source.clone(), name });
            }
            for path in found.recordings {
                let beside = path.strip_prefix(folder).unwrap_or(&path);
                let within = beside.parent().unwrap_or(Path::new("")).join(own_name(&path));
                let name = free_name(within.to_string_lossy().into_owned(), &mut taken);
                listed.push(Self { source: path.display().to_string(), name });
            }
        }
        listed
    }
}

/// A search through folders.
struct Found<'a> {
    is_deep: bool,
    results: Option<&'a Path>,
    /// Folders that were searched: links may lead back.
    seen: HashSet<PathBuf>,
    recordings: Vec<PathBuf>,
}

impl Found<'_> {
    /// Adds the recordings in a folder, in the order of their names.
    fn search(&mut self, folder: &Path) {
        let Ok(whole) = folder.canonicalize() else { return };
        if self.results == Some(&whole) || !self.seen.insert(whole) {
            return;
        }
        for path in visible(folder) {
            if has_extension(&path, &VIDEO_EXTENSIONS) {
                self.recordings.push(path);
            } else if self.is_deep && path.is_dir() {
                let is_result = path.join("run.toml").is_file() && path.join("trajectory.csv").is_file();
                match is_one_recording(&path) {
                    _ if is_result => {}
                    true => self.recordings.push(path),
                    false => self.search(&path),
                }
            } else if self.is_deep && has_extension(&path, &BAG_EXTENSIONS) && is_robot_recording(&path) {
                self.recordings.push(path);
            }
        }
    }
}

/// Whether a folder is one recording: pictures, or a rosbag2 folder.
fn is_one_recording(folder: &Path) -> bool {
    let inside = visible(folder);
    let has = |extensions: &[&str]| inside.iter().any(|path| has_extension(path, extensions));
    has(&PICTURE_EXTENSIONS) || !has(&VIDEO_EXTENSIONS) && is_recording_folder(folder)
}

/// What is in a folder and not hidden, by name; nothing for a file.
fn visible(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let names = entries.flatten().filter(|entry| !entry.file_name().to_string_lossy().starts_with('.'));
    let mut paths: Vec<PathBuf> = names.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    extensions.contains(&extension.as_str()) && path.is_file()
}

/// The name of a file without its ending, or of a folder.
fn own_name(path: &Path) -> String {
    let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
    name.map_or_else(|| "recording".to_owned(), |name| name.to_string_lossy().into_owned())
}

/// The name, with a number from the second of that name on.
fn free_name(name: String, taken: &mut HashSet<String>) -> String {
    let numbered = (2..).map(|number| format!("{name}-{number}"));
    let free = std::iter::once(name.clone()).chain(numbered).find(|name| taken.insert(name.clone()));
    free.unwrap_or(name)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    fn names(sources: &[&Path], search: Search<'_>) -> Vec<String> {
        let sources: Vec<String> = sources.iter().map(|source| source.display().to_string()).collect();
        Recording::listed(sources.iter(), search).into_iter().map(|recording| recording.name).collect()
    }

    #[test]
    fn recordings_of_one_name_have_folders_of_their_own() {
        let sources = ["a/drive.mp4", "b/drive.mkv", "b/other.mp4", "c/drive.mp4"].map(Path::new);
        assert_eq!(names(&sources, Search::Videos), ["drive", "drive-2", "other", "drive-3"]);
    }

    #[test]
    fn folders_are_searched_and_results_are_not() {
        let place = tempfile::tempdir().unwrap();
        let here = place.path();
        let put = |name: &str| {
            let path = here.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "\u{89}MCAP0\r\n").unwrap();
        };
        for name in
            ["two.mp4", "hall/one.MOV", "hall/notes.txt", "hall/.hidden.mp4", "hall/east/frames/1.png"]
        {
            put(name);
        }
        for name in ["done/one.mp4", "earlier/run.toml", "earlier/trajectory.csv", "earlier/map.png"] {
            put(name);
        }
        let results = here.join("done");
        let tree = Search::Tree { results: &results };
        let found = names(&[here], tree);
        assert_eq!(found, ["hall/east/frames", "hall/one", "two"]);
        // Pictures are frames, and their folder is one recording.
        assert_eq!(names(&[&here.join("hall/east/frames")], tree), ["frames"]);
        assert_eq!(names(&[here], Search::Videos), ["two"]);
    }
}
