//! Paths of a plan, in `run.toml` relative to that file's folder, so that it can be repeated from
//! any working directory and moved together with its recording.

use crate::plan::RunPlan;
use odograph::error::{Error, Result};
use std::path::{Component, Path, PathBuf};

impl RunPlan {
    /// The plan for a file in `folder`.
    pub(crate) fn seen_from(&self, folder: &Path) -> Self {
        let mut plan = self.clone();
        plan.each_path(|path| relative(path, folder));
        plan
    }

    /// A plan from a file in `folder`, with paths relative to the working directory.
    pub(crate) fn brought_from(mut self, folder: &Path) -> Self {
        self.each_path(|path| {
            let joined = folder.join(path);
            // Earlier versions wrote paths as they were typed.
            joined.exists().then(|| shortened(&joined))
        });
        self
    }

    /// Fails if TOML cannot hold the name of a file.
    pub(crate) fn check_names(&self) -> Result<()> {
        let mut names = Vec::new();
        self.clone().each_path(|path| {
            names.push(path.to_owned());
            None
        });
        names.iter().try_for_each(|name| check_name(name))
    }

    /// Applies `change` to every path of a file; a source that is no file is not changed.
    fn each_path(&mut self, mut change: impl FnMut(&Path) -> Option<PathBuf>) {
        let source = &mut self.source.path;
        // A folder named as standard input is `./-`.
        if source != "-"
            && let Some(other) = change(Path::new(source.as_str()))
            && let Some(text) = other.to_str()
        {
            let slash = if source.ends_with('/') { "/" } else { "" };
            *source = format!("{text}{slash}");
        }
        let sensors = &mut self.sensors;
        let files = [
            &mut self.reference,
            &mut self.mask,
            &mut self.source.timestamps,
            &mut sensors.gyro,
            &mut sensors.heading,
            &mut sensors.wheel,
            &mut sensors.range,
            &mut sensors.gnss,
        ];
        let control = self.markers.as_mut().and_then(|markers| markers.control.as_mut());
        for path in files.into_iter().flatten().chain(control) {
            if let Some(other) = change(path) {
                *path = other;
            }
        }
    }
}

/// Fails if a name is not UTF-8 text, as all of TOML is.
pub(crate) fn check_name(name: &Path) -> Result<()> {
    match name.to_str() {
        Some(_) => Ok(()),
        None => Err(Error::usage(format!(
            "the name {} is not UTF-8 text; rename the file or folder, or make a link to it",
            name.display()
        ))),
    }
}

/// A path relative to a folder; `None` where it is absolute, where nothing exists there (address of
/// a stream, standard input), and where there is no relative path.
fn relative(path: &Path, folder: &Path) -> Option<PathBuf> {
    if path.is_absolute() || !path.exists() {
        return None;
    }
    let (to, from) = (whole(path)?, folder.canonicalize().ok()?);
    let shared = to.components().zip(from.components()).take_while(|(a, b)| a == b).count();
    let is_name = |component: &Component<'_>| matches!(component, Component::Normal(_));
    let up = from.components().skip(shared);
    let down = to.components().skip(shared);
    if !up.clone().chain(down.clone()).all(|component| is_name(&component)) {
        return None;
    }
    Some(up.map(|_| Component::ParentDir).chain(down).collect())
}

/// The absolute path; a link keeps its own name.
fn whole(path: &Path) -> Option<PathBuf> {
    match path.file_name() {
        Some(name) => {
            let folder =
                path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            Some(folder.canonicalize().ok()?.join(name))
        }
        None => path.canonicalize().ok(),
    }
}

/// A path without components `name/..`, where it leads to the same place.
fn shortened(path: &Path) -> PathBuf {
    let mut short = PathBuf::new();
    for component in path.components() {
        let goes_back = component == Component::ParentDir
            && short.components().next_back().is_some_and(|last| matches!(last, Component::Normal(_)));
        if goes_back {
            short.pop();
        } else {
            short.push(component);
        }
    }
    let same = matches!((whole(&short), whole(path)), (Some(a), Some(b)) if a == b);
    if same { short } else { path.to_owned() }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn paths_lead_from_the_folder_to_the_file() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        fs::create_dir_all(at("a/b")).unwrap();
        fs::create_dir_all(at("c")).unwrap();
        fs::write(at("c/drive.mp4"), "").unwrap();
        let there = at("a/b").join("../../c/drive.mp4");
        assert_eq!(shortened(&there), at("c/drive.mp4"));
        assert_eq!(relative(&there, &at("a/b")), None, "whole paths stay");
        assert_eq!(relative(Path::new("no such file"), &at("a/b")), None);
        // Tests run in the crate's folder.
        let here = std::env::current_dir().unwrap();
        assert_eq!(
            relative(Path::new("Cargo.toml"), &here.join("src/live")),
            Some("../../Cargo.toml".into())
        );
        assert_eq!(relative(Path::new("./src/"), &here), Some("src".into()));
        assert_eq!(shortened(Path::new("src/../Cargo.toml")), Path::new("Cargo.toml"));
        assert_eq!(shortened(Path::new("../odograph-session/src")), Path::new("../odograph-session/src"));
    }
}
