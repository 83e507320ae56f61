//! The half-recorded session that a killed run has left in a map.

use odograph::error::{Error, Result};
use odograph_map::{MapClaim, MapFile};
use std::path::Path;

/// The half-recorded session of a killed run.
#[derive(Debug, Clone)]
pub(crate) struct HalfSession {
    /// Its index; `None` where the map was new.
    pub session: Option<u32>,
    /// Source of the run.
    pub source: String,
}

impl HalfSession {
    /// Whether the map has it.
    ///
    /// # Errors
    /// If the map cannot be read, or has been continued since.
    pub fn is_in(&self, map: &Path) -> Result<bool> {
        if !MapFile::is_there(map) {
            return Ok(false);
        }
        let sessions = MapFile::open_read_only(map)?.sessions()?;
        let half = self.session.unwrap_or(0);
        match sessions.last() {
            Some(last) if last.id > half || (last.id == half && last.source != self.source) => {
                Err(Error::input(format!(
                    "{} has been continued since this run was killed, so that its part of the map cannot be replaced; \
                     run the recording into another folder",
                    map.display()
                )))
            }
            last => Ok(last.is_some_and(|last| last.id == half)),
        }
    }

    /// Removes it from its map, so that the run that begins again has the map as it was.
    ///
    /// # Errors
    /// As [`HalfSession::is_in`], and if the map cannot be written.
    pub fn remove(&self, claim: &MapClaim) -> Result<()> {
        if !self.is_in(claim.path())? {
            return Ok(());
        }
        let mut file = MapFile::open_claimed(claim.clone())?;
        match self.session {
            Some(session) => file.remove_session(session).and_then(|()| file.close()),
            None => file.close().and_then(|()| claim.remove_map()),
        }
    }
}
