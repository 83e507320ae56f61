//! The program's demonstration clip: half a minute over photographed floors.

use odograph_session::{RunBuilder, SourcePlan};
use std::path::{Path, PathBuf};

/// A file of the demonstration.
pub fn input(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../odograph-cli/demo");
    folder.canonicalize().expect("the demonstration is in the repository").join(name)
}

/// The first frames of the clip.
pub fn source(frames: u64) -> SourcePlan {
    SourcePlan { max_frames: Some(frames), ..SourcePlan::new(input("drive.mp4").display().to_string()) }
}

/// A run over the first frames of the clip.
pub fn run(frames: u64) -> RunBuilder {
    RunBuilder::over(source(frames)).camera_file(input("camera.yaml")).rig_file(input("rig.toml"))
}
