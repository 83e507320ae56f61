//! Sessions whose run did not end.

use crate::complaint::WithContext;
use crate::file::MapFile;
use odograph::error::Result;

/// A session with keyframes and without a path, which a run writes at its end: the run was killed,
/// or goes on ([`MapClaim::is_held`](crate::MapClaim::is_held)).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnfinishedSession {
    /// Index of the session, from 0.
    pub id: u32,
    /// Source of the run: a file, folder or stream.
    pub source: String,
    /// Number of its keyframes.
    pub keyframes: u64,
}

impl MapFile {
    /// The sessions whose run did not end, in order. Those of robots with a name are left out:
    /// their paths are not sent to a site.
    pub fn unfinished_sessions(&self) -> Result<Vec<UnfinishedSession>> {
        let mut statement = self
            .connection
            .prepare(
                "SELECT count(*) FROM keyframes WHERE session = ?1
                 AND NOT EXISTS (SELECT 1 FROM odograph_frame WHERE session = ?1)",
            )
            .while_reading(&self.complaint)?;
        let mut unfinished = Vec::new();
        for session in self.sessions()?.into_iter().filter(|session| session.origin.is_none()) {
            let keyframes =
                statement.query_row([session.id], |row| row.get(0)).while_reading(&self.complaint)?;
            if keyframes > 0 {
                unfinished.push(UnfinishedSession { id: session.id, source: session.source, keyframes });
            }
        }
        Ok(unfinished)
    }
}
