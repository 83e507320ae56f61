//! Where a run writes.

use odograph::error::{Error, Result};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// What a run does with a map.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum MapUse {
    /// Makes a new one, `map.gpkg` in the run's folder.
    #[default]
    New,
    /// Continues the map in this file, or begins it where there is none.
    Continue(PathBuf),
    /// Looks into the map in this file, which stays as it is: the run only finds out where the
    /// camera is.
    LookInto(PathBuf),
}

impl MapUse {
    /// The file, unless the map is a new one in the run's folder.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::New => None,
            Self::Continue(path) | Self::LookInto(path) => Some(path),
        }
    }

    /// Whether the map stays as it is.
    pub fn is_read_only(&self) -> bool {
        matches!(self, Self::LookInto(_))
    }
}

/// Where a run writes, how much it may overwrite, and how many threads it takes.
#[derive(Debug, Clone)]
pub(crate) struct Output {
    /// `None`: a temporary folder, which is removed at the end.
    pub folder: Option<PathBuf>,
    pub force: bool,
    pub map: MapUse,
    /// A bag of ROS 2 to write, an MCAP file.
    pub bag: Option<PathBuf>,
    /// `None`: as many as help.
    pub threads: Option<usize>,
    /// Fewer frames than this are no recording.
    pub least_frames: usize,
}

impl Default for Output {
    fn default() -> Self {
        Self { folder: None, force: false, map: MapUse::New, bag: None, threads: None, least_frames: 2 }
    }
}

impl Output {
    /// Number of threads: three by default, for decoding, tracking and mapping.
    pub fn threads(&self) -> usize {
        self.threads.unwrap_or(3)
    }

    /// Fails if the bag is there already and may not be overwritten.
    pub fn check_bag(&self) -> Result<()> {
        match &self.bag {
            Some(bag) if bag.exists() && !self.force => Err(Error::usage(format!(
                "{} is already there; choose another name, or --force to overwrite it",
                bag.display()
            ))),
            _ => Ok(()),
        }
    }

    /// The folder, with the guard that removes it where it is temporary.
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
