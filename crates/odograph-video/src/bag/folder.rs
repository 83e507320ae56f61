//! The folder of a rosbag2 recording: which files it consists of, and in what order.

use super::files::BagFormat;
use crate::pictures::{name_of, natural_order};
use crate::regular_file::read_regular_file;
use odograph::error::{Error, Result};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Largest description, bytes.
const MAX_METADATA: u64 = 16 << 20;

/// What is read of `metadata.yaml`.
#[derive(Deserialize)]
struct Metadata {
    rosbag2_bagfile_information: BagMetadata,
}

#[derive(Deserialize)]
struct BagMetadata {
    #[serde(default)]
    relative_file_paths: Vec<String>,
}

/// The files of a recording in a folder, in their order, and warnings about those that are not
/// read, one sentence each; `None` if the folder is not one.
///
/// They are those that `metadata.yaml` names. Where it is missing, damaged, or names none that is
/// there (a recorder that was killed writes it too late), they are the recordings in the folder,
/// which must be parts of one.
pub(super) fn files(folder: &Path) -> Result<Option<(Vec<PathBuf>, Vec<String>)>> {
    let named = named_files(folder);
    let Ok(entries) = std::fs::read_dir(folder) else { return Ok(None) };
    let mut files: Vec<PathBuf> =
        entries.flatten().map(|entry| entry.path()).filter(|path| is_part(path)).collect();
    files.sort_by(|a, b| natural_order(&name_of(a), &name_of(b)));
    if let Some(named) = &named {
        let (there, missing): (Vec<PathBuf>, Vec<PathBuf>) =
            named.iter().cloned().partition(|path| path.is_file());
        if let Some(first) = there.first() {
            files.retain(|path| series(path) == series(first) && !there.contains(path));
            let mut warnings = Vec::new();
            if !missing.is_empty() {
                let missing = names(&missing);
                warnings.push(format!(
                    "metadata.yaml names {missing}, not in this folder; what was recorded there is missing"
                ));
            }
            if !files.is_empty() {
                let unread = names(&files);
                warnings.push(format!(
                    "metadata.yaml does not name {unread}, left out; remove metadata.yaml to read all parts"
                ));
            }
            return Ok(Some((there, warnings)));
        }
    }
    let Some(first) = files.first() else {
        return match named {
            Some(_) => Err(Error::input(
                "metadata.yaml describes a rosbag2 recording, but its files are not in this folder; copy them into it",
            )),
            None => Ok(None),
        };
    };
    if let Some(other) = files.iter().find(|path| series(path) != series(first)) {
        return Err(Error::input(format!(
            "there are several recordings in this folder, such as {} and {}; give one of them, or all with --resume",
            name_of(first),
            name_of(other)
        )));
    }
    Ok(Some((files, Vec::new())))
}

/// Names of files for people.
fn names(files: &[PathBuf]) -> String {
    let names: Vec<String> = files.iter().map(|path| name_of(path)).collect();
    names.join(", ")
}

/// The files that the description names, whether they are there or not; `None` without a
/// description.
fn named_files(folder: &Path) -> Option<Vec<PathBuf>> {
    let text = read_regular_file(&folder.join("metadata.yaml"), MAX_METADATA).ok()?;
    let text = String::from_utf8(text).ok()?;
    let metadata: Metadata = crate::guard::guarded("YAML", || serde_saphyr::from_str(&text)).ok()?.ok()?;
    let named = metadata.rosbag2_bagfile_information.relative_file_paths;
    // Old recorders name the folder as well, and a folder may have been renamed.
    Some(named.iter().filter_map(|path| Some(folder.join(Path::new(path).file_name()?))).collect())
}

/// Whether a file is a recording by its ending and its content.
fn is_part(path: &Path) -> bool {
    let name = name_of(path).to_lowercase();
    let endings = [".mcap", ".db3", ".bag", ".bag.active", ".mcap.zstd", ".db3.zstd"];
    !name.starts_with('.')
        && endings.iter().any(|ending| name.ends_with(ending))
        && path.is_file()
        && matches!(BagFormat::of_file(path), Ok(Some(_)))
}

/// The name of a file without the number of the part and the endings.
fn series(path: &Path) -> String {
    let name = name_of(path);
    let stem = name.split('.').next().unwrap_or("");
    let (series, number) = stem.rsplit_once('_').unwrap_or((stem, ""));
    if !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit()) {
        series.to_owned()
    } else {
        stem.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_one_recording_differ_in_a_number() {
        let of = |name: &str| series(Path::new(name));
        assert_eq!(of("drive_0.mcap"), of("drive_12.mcap.zstd"));
        assert_ne!(of("monday.mcap"), of("tuesday.mcap"));
        assert_eq!(of("2024_01_05.bag.active"), "2024_01");
    }

    #[test]
    fn a_description_names_the_files_in_order_and_none_outside() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path();
        assert!(files(folder).unwrap().is_none());
        for name in ["b_0.mcap", "b_1.mcap", "b_10.mcap"] {
            std::fs::write(folder.join(name), b"\x89MCAP0\r\n").unwrap();
        }
        std::fs::write(folder.join("b_2.mcap"), "not one").unwrap();
        let read = || {
            let (files, warnings) = files(folder).unwrap().unwrap();
            (files.iter().map(|path| name_of(path)).collect::<Vec<_>>(), warnings)
        };
        assert_eq!(read(), (["b_0.mcap", "b_1.mcap", "b_10.mcap"].map(str::to_owned).to_vec(), vec![]));
        let text = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - old/b_1.mcap\n    - ../b_0.mcap\n    - \
                    gone.mcap\n";
        std::fs::write(folder.join("metadata.yaml"), text).unwrap();
        let (found, warnings) = read();
        assert_eq!(found, ["b_1.mcap", "b_0.mcap"]);
        assert_eq!(
            warnings,
            [
                "metadata.yaml names gone.mcap, not in this folder; what was recorded there is missing",
                "metadata.yaml does not name b_10.mcap, left out; remove metadata.yaml to read all parts"
            ]
        );
        std::fs::write(folder.join("metadata.yaml"), "rosbag2_bagfile_information: [cut").unwrap();
        assert_eq!(read().0.len(), 3);
        std::fs::write(folder.join("other.mcap"), b"\x89MCAP0\r\n").unwrap();
        assert!(files(folder).unwrap_err().to_string().contains("several recordings"));
    }
}
