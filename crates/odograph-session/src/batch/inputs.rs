//! What determines the bytes of a run: the program, its options, and the recording.

use super::hash;
use crate::builder::{CameraChoice, MountChoice, RunBuilder};
use odograph::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Program, options and recording of a run, as hashes.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Inputs {
    /// Version of the program.
    pub odograph: String,
    /// Hash of the options, and of the files that they name.
    pub parameters: String,
    /// Hash of the recording; `None` where it cannot be read.
    pub recording: Option<String>,
    /// Size of the recording, bytes.
    pub bytes: u64,
    /// Last change of the recording, nanoseconds since 1970.
    pub changed_ns: u64,
}

impl Inputs {
    /// The inputs of a run over a recording. The recording is only read if it has another size or
    /// time than in `earlier` inputs.
    pub(super) fn of(source: &str, parameters: &str, earlier: Option<&Self>) -> Self {
        let path = Path::new(source);
        let (bytes, changed_ns) = hash::size_and_change(path).unwrap_or_default();
        let unchanged = earlier.filter(|earlier| (earlier.bytes, earlier.changed_ns) == (bytes, changed_ns));
        let recording = unchanged.and_then(|earlier| earlier.recording.clone());
        Self {
            odograph: env!("CARGO_PKG_VERSION").to_owned(),
            parameters: parameters.to_owned(),
            recording: recording.or_else(|| hash::of_path(path).ok()),
            bytes,
            changed_ns,
        }
    }

    /// Whether a run with them gives the same bytes.
    pub fn are_same(&self, other: &Self) -> bool {
        self.recording == other.recording && self.are_options_same(other)
    }

    /// Whether program and options are the same.
    pub(super) fn are_options_same(&self, other: &Self) -> bool {
        (&self.odograph, &self.parameters) == (&other.odograph, &other.parameters)
    }
}

/// The hash of the options of a run that its results depend on, and of the files that they name.
///
/// # Errors
/// If such a file cannot be read.
pub fn parameters(run: &RunBuilder) -> Result<String> {
    // Named one by one, so that no new option is forgotten.
    let RunBuilder {
        source,
        repeats: _,
        resumed: _,
        camera,
        mount,
        frame,
        readout_s,
        mask,
        markers,
        motion,
        sensors,
        budget_ms,
        loops,
        reference,
        reference_topic,
        output,
        reporter: _,
    } = run;
    let mut plan = source.clone();
    plan.path.clear();
    let mut text = format!(
        "{plan:?} {frame:?} {readout_s:?} {motion:?} {sensors:?} {budget_ms:?} {loops} {reference_topic:?} {:?} {:?}\n",
        markers.as_ref().map(|markers| &markers.family),
        output.robot,
    );
    let mut files: Vec<(&str, &PathBuf)> = Vec::new();
    match camera {
        Some(CameraChoice::File(path)) => files.push(("camera", path)),
        other => text.push_str(&format!("{other:?}\n")),
    }
    match mount {
        Some(MountChoice::File(path)) => files.push(("rig", path)),
        other => text.push_str(&format!("{other:?}\n")),
    }
    let control = markers.as_ref().and_then(|markers| markers.control.as_ref());
    let others = [("mask", mask.as_ref()), ("control", control), ("reference", reference.as_ref())];
    files.extend(others.into_iter().filter_map(|(option, path)| Some((option, path?))));
    for (option, file) in files {
        let hash = hash::of_path(file).map_err(|error| {
            Error::input(format!("{} cannot be read: {error}", file.display())).caused_by(error)
        })?;
        text.push_str(&format!("{hash}  {option}\n"));
    }
    Ok(hash::of_bytes(text.as_bytes()))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn options_and_the_content_of_their_files_count() {
        let place = tempfile::tempdir().unwrap();
        let (camera, copy) = (place.path().join("camera.yaml"), place.path().join("copy.yaml"));
        fs::write(&camera, "one").unwrap();
        fs::copy(&camera, &copy).unwrap();
        let run = |source: &str, camera: &Path| RunBuilder::new(source).camera_file(camera).height_m(1.0);
        let hash = parameters(&run("a.mp4", &camera)).unwrap();
        assert_eq!(parameters(&run("b.mp4", &copy)).unwrap(), hash);
        assert_ne!(parameters(&run("a.mp4", &camera).height_m(1.1)).unwrap(), hash);
        assert_ne!(parameters(&run("a.mp4", &camera).without_loops()).unwrap(), hash);
        assert_eq!(parameters(&run("a.mp4", &camera).threads(7)).unwrap(), hash);
        fs::write(&camera, "two").unwrap();
        assert_ne!(parameters(&run("a.mp4", &camera)).unwrap(), hash);
        let missing = parameters(&run("a.mp4", Path::new("none.yaml"))).unwrap_err().to_string();
        assert!(missing.starts_with("none.yaml cannot be read: "), "{missing}");
    }

    #[test]
    fn a_recording_is_read_again_if_it_has_changed() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("drive.mp4");
        let source = path.display().to_string();
        fs::write(&path, "one").unwrap();
        let first = Inputs::of(&source, "", None);
        // A value that is not a hash shows that the file was not read.
        let earlier = Inputs { recording: Some("known".to_owned()), ..first.clone() };
        assert_eq!(Inputs::of(&source, "", Some(&earlier)).recording.as_deref(), Some("known"));
        fs::write(&path, "three").unwrap();
        assert!(!Inputs::of(&source, "", Some(&first)).are_same(&first));
        let gone = Inputs::of("no such file", "", Some(&first));
        assert!(gone.recording.is_none() && !gone.are_same(&first));
    }
}
