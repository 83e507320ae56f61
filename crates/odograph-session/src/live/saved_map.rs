//! The map of a run that goes on, as a file of its own.

use crate::files;
use odograph::error::Result;
use odograph::odometry::OdometryConfig;
use odograph::slam;
use odograph_map::{MapClaim, MapFile};
use std::path::{Path, PathBuf};

/// Writes what the map of a run has so far to a new file `map-saved-N.gpkg` in the folder of its
/// results, and optimises it there as the run does at its end; returns its path.
///
/// # Errors
/// If the map has no keyframe yet, or the file cannot be written: then there is none.
pub fn save_map(map: &Path, folder: &Path, odometry: &OdometryConfig) -> Result<PathBuf> {
    let there = MapFile::open_read_only(map)?;
    let named = |number: u32| folder.join(format!("map-saved-{number}.gpkg"));
    let path = (1..).map(named).find(|path| !path.exists()).unwrap_or_else(|| named(0));
    let claim = MapClaim::on(&path)?;
    let beside = files::beside(&path);
    // What a killed program may have left.
    MapFile::remove(&beside)?;
    there.copy_to(&beside)?;
    let optimised = || {
        let mut file = MapFile::open(&beside)?;
        let optimised = slam::optimize(&file.map()?, odometry);
        let poses: Vec<_> =
            optimised.keyframes.iter().map(|known| (known.id, known.pose, known.covariance)).collect();
        file.set_poses(&poses)?;
        file.close()
    };
    optimised().inspect_err(|_| {
        let _ = MapFile::remove(&beside);
    })?;
    MapFile::replace(&claim, &beside)?;
    Ok(path)
}
