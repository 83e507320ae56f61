//! Checks that the files that options name to be written are neither inputs nor results of the run:
//! with permission to overwrite, it would destroy them.

use crate::builder::{CameraChoice, MountChoice, RunBuilder};
use crate::folder::RUN_FILES;
use odograph::error::{Error, Result};
use std::path::{Path, PathBuf};

impl RunBuilder {
    /// Fails if one of `outputs` is a file that the run reads, a map that it continues, or one of
    /// the results in its folder.
    pub(crate) fn check_separate<'a>(&self, outputs: impl IntoIterator<Item = &'a Path>) -> Result<()> {
        let inputs: Vec<PathBuf> = self.inputs().into_iter().filter_map(resolved).collect();
        let folder = self.output.folder.as_deref();
        let results = || RUN_FILES.iter().filter_map(|name| resolved(&folder?.join(name)));
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

/// The canonical path of a file; if it does not exist, that of its folder with its name.
fn resolved(path: &Path) -> Option<PathBuf> {
    path.canonicalize().ok().or_else(|| {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        Some(folder.canonicalize().ok()?.join(path.file_name()?))
    })
}
