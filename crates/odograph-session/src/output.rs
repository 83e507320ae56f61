//! Output of a run.

use crate::files;
use crate::half_session::HalfSession;
use odograph::error::{Error, Result};
use odograph_map::SessionOrigin;
use odograph_video::TemporaryFolder;
use std::path::{Path, PathBuf};

/// Use of a map by a run.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum MapUse {
    /// Creates a new one, `map.gpkg` in the output folder.
    #[default]
    New,
    /// Continues the map in this file, or creates it.
    Continue(PathBuf),
    /// Continues the map in this file where the run is recognised in it; otherwise the map has
    /// nothing of the run at its end.
    Extend(PathBuf),
    /// Localizes in the map in this file, which is not changed.
    LookInto(PathBuf),
}

impl MapUse {
    /// The file, unless it is a new one in the output folder.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::New => None,
            Self::Continue(path) | Self::Extend(path) | Self::LookInto(path) => Some(path),
        }
    }

    /// Whether the map is read-only.
    pub fn is_read_only(&self) -> bool {
        matches!(self, Self::LookInto(_))
    }
}

/// The session that a killed run had begun: it is that session again.
#[derive(Debug, Clone)]
pub(crate) struct ResumedSession {
    /// The source as it was typed first.
    pub source: String,
    /// Key of the session of a named robot.
    pub key: Option<String>,
    /// What it has left in a continued map.
    pub half: Option<HalfSession>,
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
    /// What a killed run had begun, which this run replaces.
    pub resumed: Option<ResumedSession>,
    /// A bag of ROS 2 to write, an MCAP file.
    pub bag: Option<PathBuf>,
    /// An overlay video to write, an AVI file.
    pub video: Option<PathBuf>,
    /// `None`: as many as are useful.
    pub threads: Option<usize>,
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
            resumed: None,
            bag: None,
            video: None,
            threads: None,
            least_frames: 2,
        }
    }
}

impl RunOutput {
    /// Number of threads: three by default, for decoding, tracking and mapping.
    pub fn threads(&self) -> usize {
        self.threads.unwrap_or(3)
    }

    /// Whether a place in a map is asked for: one frame is enough then.
    pub fn localizes(&self) -> bool {
        self.least_frames == 1
    }

    /// Whether pictures are drawn: not where they would be removed at once, in a temporary folder,
    /// and the map takes none.
    pub fn draws(&self) -> bool {
        self.folder.is_some() || !self.map.is_read_only()
    }

    /// Name of the source in the map; `typed` is that of this run.
    pub fn source_name(&self, typed: &str) -> String {
        self.resumed.as_ref().map_or(typed, |resumed| &resumed.source).to_owned()
    }

    /// Origin of the session, where the robot has a name.
    pub fn origin(&self) -> Result<Option<SessionOrigin>> {
        let Some(robot) = &self.robot else { return Ok(None) };
        match self.resumed.as_ref().and_then(|resumed| resumed.key.clone()) {
            Some(key) => SessionOrigin { robot: robot.clone(), key }.validated().map(Some),
            None => SessionOrigin::new(robot).map(Some),
        }
    }

    /// Fails if the bag exists and may not be overwritten, or cannot be written there.
    pub fn check_bag(&self) -> Result<()> {
        self.bag.as_ref().map_or(Ok(()), |bag| files::check_output(bag, self.folder.as_deref(), self.force))
    }

    /// The folder, with a guard that removes a temporary one.
    pub fn place(&self) -> Result<(PathBuf, Option<TemporaryFolder>)> {
        match &self.folder {
            Some(folder) => Ok((folder.clone(), None)),
            None => {
                let temporary = TemporaryFolder::new()?;
                Ok((temporary.path().to_owned(), Some(temporary)))
            }
        }
    }
}

/// The error of a run whose files are in a temporary folder, with what to do about that folder.
pub(crate) fn explained(error: Error, temporary: Option<&TemporaryFolder>) -> Error {
    match temporary {
        Some(temporary) => temporary.explain(error),
        None => error,
    }
}
