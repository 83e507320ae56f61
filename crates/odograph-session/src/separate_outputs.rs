//! Checks that the files that options name to be written are neither inputs nor results of the run:
//! with permission to overwrite, it would destroy them.

use crate::builder::{CameraChoice, MountChoice, RunBuilder};
use crate::folder::{MAP_FILE, RUN_FILES};
use odograph::error::{Error, Result};
use std::path::{Path, PathBuf};

impl RunBuilder {
    /// Fails if one of `outputs` is a file that the run reads, a map that it continues, or one of
    /// the results in its folder; or if its map is one of the other results.
    pub(crate) fn check_separate<'a>(&self, outputs: impl IntoIterator<Item = &'a Path>) -> Result<()> {
        let inputs: Vec<PathBuf> = self.inputs().into_iter().filter_map(resolved).collect();
        let folder = self.output.folder.as_deref();
        let results = || RUN_FILES.iter().filter_map(|name| resolved(&folder?.join(name)));
        if let Some(map) = self.output.map.path()
            && let Some(place) = resolved(map)
            && results().any(|result| result == place && !result.ends_with(MAP_FILE))
        {
            return Err(Error::usage(format!(
                "{} is one of the results of this run and cannot be its map; give the map another name",
                map.display()
            )));
        }
        for output in outputs {
            let Some(place) = resolved(output) else { continue };
            let what = if inputs.contains(&place) {
                "a file that this run reads"
            } else if results().any(|result| result == place) {
                "one of the results of this run"
            } else {
                continue;
            };
            return Err(Error::usage(format!(
                "{} is {what}; give what is written another name",
                output.display()
            )));
        }
        Ok(())
    }

    /// The files that the run reads.
    fn inputs(&self) -> Vec<&Path> {
        let camera = match &self.camera {
            Some(CameraChoice::File(path)) => Some(path),
            _ => None,
        };
        let mount = match &self.mount {
            Some(MountChoice::File(path)) => Some(path),
            _ => None,
        };
        let sensors = &self.sensors;
        let files = [
            camera,
            mount,
            self.source.timestamps.as_ref(),
            self.mask.as_ref(),
            self.reference.as_ref(),
            self.markers.as_ref().and_then(|markers| markers.control.as_ref()),
            sensors.gyro.as_ref(),
            sensors.heading.as_ref(),
            sensors.wheel.as_ref(),
            sensors.range.as_ref(),
            sensors.gnss.as_ref(),
        ];
        let files = files.into_iter().flatten().map(PathBuf::as_path);
        files.chain(self.output.map.path()).chain([Path::new(&self.source.path)]).collect()
    }
}

/// The canonical path of a file; if it does not exist, that of the innermost of its folders that
/// does, with the rest of its path.
fn resolved(path: &Path) -> Option<PathBuf> {
    path.canonicalize().ok().or_else(|| {
        let folder = path.parent()?;
        let folder = match folder.as_os_str().is_empty() {
            true => Path::new(".").canonicalize().ok()?,
            false => resolved(folder)?,
        };
        match path.file_name() {
            Some(name) => Some(folder.join(name)),
            None => folder.parent().map(Path::to_owned), // it ends with ..
        }
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    #[test]
    fn a_path_that_does_not_exist_is_resolved_too() {
        let place = tempfile::tempdir().unwrap();
        let here = place.path().canonicalize().unwrap();
        for path in ["a", "b/../a", "b/c/../../a", "./a", "b/c/d/../../../a"] {
            assert_eq!(resolved(&place.path().join(path)), Some(here.join("a")), "{path}");
        }
        assert_eq!(resolved(&place.path().join("b/c")), Some(here.join("b/c")));
        assert_eq!(resolved(Path::new("")), None);
    }
}
