//! Output of a run.

use crate::files;
use crate::half_session::HalfSession;
use odograph::error::{Error, Result};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Use of a map by a run.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum MapUse {
    /// Creates a new one, `map.gpkg` in the output folder.
    #[default]
    New,
    /// Continues the map in this file, or creates it.
    Continue(PathBuf),
    /// Localizes in the map in this file, which is not changed.
    LookInto(PathBuf),
}

impl MapUse {
    /// The file, unless it is a new one in the output folder.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::New => None,
            Self::Continue(path) | Self::LookInto(path) => Some(path),
        }
    }

    /// Whether the map is read-only.
    pub fn is_read_only(&self) -> bool {
        matches!(self, Self::LookInto(_))
    }
}

/// Output folder, permission to overwrite, and number of threads.
#[derive(Debug, Clone)]
pub(crate) struct RunOutput {
    /// `None`: a temporary folder, which is removed at the end.
    pub folder: Option<PathBuf>,
    pub force: bool,
    pub map: MapUse,
    /// Name of the robot that runs.
    pub robot: Option<String>,
    /// A bag of ROS 2 to write, an MCAP file.
    pub bag: Option<PathBuf>,
    /// `None`: as many as are useful.
    pub threads: Option<usize>,
    /// The session of a killed run, which this run replaces.
    pub half_session: Option<HalfSession>,
    /// Minimum number of frames of a recording.
    pub least_frames: usize,
}

impl Default for RunOutput {
    fn default() -> Self {
        Self {
            folder: None,
            force: false,
            map: MapUse::New,
            robot: None,
            bag: None,
            threads: None,
            half_session: None,
            least_frames: 2,
        }
    }
}

impl RunOutput {
    /// Number of threads: three by default, for decoding, tracking and mapping.
    pub fn threads(&self) -> usize {
        self.threads.unwrap_or(3)
    }

    /// Fails if the bag exists and may not be overwritten, or cannot be written there.
    pub fn check_bag(&self) -> Result<()> {
        self.bag.as_ref().map_or(Ok(()), |bag| files::check_output(bag, self.force))
    }

    /// The folder, with a guard that removes a temporary one.
    pub fn place(&self) -> Result<(PathBuf, Option<TempDir>)> {
        match &self.folder {
            Some(folder) => Ok((folder.clone(), None)),
            None => {
                let nowhere = tempfile::tempdir().map_err(|error| {
                    Error::output(format!("there is no folder for temporary files: {error}")).caused_by(error)
                })?;
                Ok((nowhere.path().to_owned(), Some(nowhere)))
            }
        }
    }
}
