//! The output folder: nothing is overwritten without permission, no file is half-written, and
//! computed frames are on disk if the program is killed.

use crate::begun_run::{self, begun_file};
use crate::files::{self, MadeFolders};
use crate::growing_table::GrowingTable;
use crate::kept_frames::KeptFrames;
use crate::output::{MapUse, RunOutput};
use crate::plan::RunPlan;
use crate::statistics::RunStatistics;
use crate::unfinished::UnfinishedRun;
use odograph::error::{Error, Result};
use odograph::formats::trajectory_file::{FRAMES_HEADER, frame_line, tum_header, tum_line};
use odograph::pose_frame::{PoseFrame, PoseFrames};
use odograph::trajectory::{FrameEstimate, StampedPose};
use odograph_map::{MapClaim, MapFile, SessionOrigin};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

/// The map of a run in its folder.
pub const MAP_FILE: &str = "map.gpkg";

/// Every file that a run writes.
pub const RUN_FILES: [&str; 20] = [
    "odometry.tum",
    MAP_FILE,
    "trajectory.tum",
    "trajectory.csv",
    "trajectory-smoothed.tum",
    "trajectory-smoothed.csv",
    "carrier.tum",
    "trajectory.geojson",
    "trajectory-utm.csv",
    "map.svg",
    "map.png",
    "mosaic.png",
    "mosaic.pgw",
    "mosaic-utm.tif",
    "report.html",
    "run.toml",
    "camera-found.yaml",
    "rig-found.toml",
    "mask.png",
    "stats.json",
];

/// The folder of a run while it is being filled.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    /// The incremental trajectory; replaced by `trajectory.csv` at the end.
    growing: GrowingTable,
    /// Whether `trajectory.csv` is written.
    has_path: bool,
    /// Whether it is written down what is run.
    begun: bool,
    /// Whether a map of an earlier run is there.
    had_map: bool,
    /// Origin of the session, where the robot has a name.
    origin: Option<SessionOrigin>,
    /// Claims on the folder's map, which keeps other runs out of the folder, and on the continued
    /// map.
    claims: Vec<MapClaim>,
    /// The files that were written, in order.
    written: Vec<PathBuf>,
    /// Folders created for this run, which are removed again where nothing is in them; dropped
    /// last.
    _made: MadeFolders,
}

impl Drop for OutputFolder {
    /// A run without a frame on disk leaves no files. One that ends by itself has said why.
    fn drop(&mut self) {
        if self.begun {
            begun_run::end(&self.path);
        }
        if !self.has_path && !self.growing.has_frames() {
            self.growing.remove();
            if !self.had_map {
                let _ = self.claims[0].remove_map();
            }
            self.claims.clear();
        }
    }
}

impl OutputFolder {
    /// Prepares the folder and claims the map that will be written. Fails where results exist that
    /// may not be replaced, where another program writes, or where nothing can be written.
    pub fn new(path: &Path, output: &RunOutput) -> Result<Self> {
        let force = output.force;
        files::check_output_folder(path)?;
        let own_map = path.join(MAP_FILE);
        let origin = output.origin()?;
        check_free(path, force)?;
        let made = MadeFolders::new(path)?;
        let claims = claims(&own_map, &output.map)?;
        // Another run may have ended here since.
        check_free(path, force)?;
        let growing = GrowingTable::create(path)?;
        let had_map = MapFile::is_there(&own_map);
        Ok(Self {
            path: path.to_owned(),
            growing,
            has_path: false,
            begun: false,
            had_map,
            origin,
            claims,
            written: Vec::new(),
            _made: made,
        })
    }

    /// The claim on the map that this run writes, if any.
    pub fn claim_on(&self, map: &Path) -> Option<&MapClaim> {
        self.claims.iter().find(|claim| claim.is_on(map))
    }

    /// Writes down what is run, so that it can be run again where this program is killed.
    pub fn begin(&mut self, plan: &RunPlan, output: &RunOutput) -> Result<()> {
        self.begun = true;
        begun_run::begin(&self.path, plan, output, self.origin.as_ref())
    }

    /// The run starts again: what was recorded is replaced by what is recorded from now on.
    pub fn begin_again(&mut self) -> Result<()> {
        self.growing.begin_again()?;
        // A site that has something of the session before has other keyframes than those to come.
        self.origin = self.origin.as_ref().map(SessionOrigin::following);
        Ok(())
    }

    /// Origin of the session, where the robot has a name.
    pub fn origin(&self) -> Option<&SessionOrigin> {
        self.origin.as_ref()
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Adds a frame; frames are written to disk at least once per second of video.
    pub fn record(&mut self, frame: &FrameEstimate) -> Result<()> {
        self.growing.record(frame)
    }

    /// Writes recorded frames to disk.
    pub fn flush(&mut self) -> Result<()> {
        self.growing.flush()
    }

    /// Removes a file of an earlier run that this run does not write.
    pub fn remove(&mut self, name: &str) -> Result<()> {
        remove_if_there(&self.path.join(name))
    }

    /// Whether a file of an earlier run has these bytes.
    pub fn holds(&self, name: &str, bytes: &[u8]) -> bool {
        odograph_video::read_regular_file(&self.path.join(name), bytes.len() as u64)
            .is_ok_and(|there| there == bytes)
    }

    /// Writes one file.
    pub fn write(&mut self, name: &str, bytes: &[u8]) -> Result<()> {
        self.replace(name, Some(Ok(bytes)))
    }

    /// Records a file as written. Where it could not be, that of an earlier run is removed, which
    /// would be taken for one of this run.
    fn in_place_of_earlier(&mut self, path: PathBuf, written: Result<()>) -> Result<()> {
        match &written {
            Ok(()) => self.is_written(path),
            Err(_) => drop(fs::remove_file(path)),
        }
        written
    }

    /// Writes one file, or removes that of an earlier run where there is none now.
    pub fn replace(&mut self, name: &str, bytes: Option<Result<impl AsRef<[u8]>>>) -> Result<()> {
        let Some(bytes) = bytes else { return self.remove(name) };
        let path = self.path.join(name);
        let written = bytes.and_then(|bytes| files::write(&path, bytes.as_ref()));
        self.in_place_of_earlier(path, written)
    }

    /// Records the name of a written file.
    pub fn is_written(&mut self, path: PathBuf) {
        if !self.written.contains(&path) {
            self.written.push(path);
        }
    }

    /// Whether this run has written the file.
    pub fn has_written(&self, path: &Path) -> bool {
        self.written.iter().any(|written| written == path)
    }

    /// Returns the files that were written, in order.
    pub fn take_written(&mut self) -> Vec<PathBuf> {
        std::mem::take(&mut self.written)
    }

    /// Writes a file with a `header` and the lines that `fill` gives.
    pub fn write_lines(
        &mut self,
        name: &str,
        header: &str,
        fill: impl FnOnce(&mut dyn FnMut(&str) -> Result<()>) -> Result<()>,
    ) -> Result<()> {
        let path = self.path.join(name);
        let written = files::write_with(&path, |output| lines_into(output, &path, header, fill));
        self.in_place_of_earlier(path, written)
    }

    /// Writes the trajectory of a frame as TUM text from the poses that `fill` gives.
    pub fn write_tum(
        &mut self,
        name: &str,
        of: &PoseFrame,
        fill: impl FnOnce(&mut dyn FnMut(&StampedPose) -> Result<()>) -> Result<()>,
    ) -> Result<()> {
        self.write_lines(name, &tum_header(of), |put| fill(&mut |pose| put(&tum_line(pose))))
    }

    /// Writes trajectories and parameters, before any drawing, because they cannot be recovered
    /// without the recording. Removes the incremental record, which exists only in case of a crash.
    pub fn write_trajectories(
        &mut self,
        frames: &mut KeptFrames,
        of: &PoseFrames,
        run_toml: &str,
    ) -> Result<()> {
        // Under a third name each: what is there under the second one is worth keeping until then.
        let _ = self.flush();
        let written = self.write_paths(frames, of, run_toml);
        if written.is_err() && self.begun && begun_file(&self.path).is_file() {
            // On a full disk the path is worth more than what runs it again.
            begun_run::end(&self.path);
            return self.write_paths(frames, of, run_toml);
        }
        written
    }

    fn write_paths(&mut self, frames: &mut KeptFrames, of: &PoseFrames, run_toml: &str) -> Result<()> {
        let path = self.path.join("trajectory.csv");
        files::fill_by_way_of(&self.path.join("trajectory.csv.new"), &path, |output| {
            lines_into(output, &path, FRAMES_HEADER, |put| {
                frames.each(|frame, _| put(&frame_line(&of.frame(frame))))
            })
        })?;
        self.growing.remove();
        self.is_written(path);
        self.has_path = true;
        self.write_tum("trajectory.tum", of.last(), |put| {
            frames.each(|frame, _| of.stamped(frame).as_ref().map_or(Ok(()), &mut *put))
        })?;
        let path = self.path.join("run.toml");
        files::write_by_way_of(&self.path.join("run.toml.new"), &path, run_toml.as_bytes())?;
        self.is_written(path);
        Ok(())
    }

    /// Writes the statistics, the last file: if it exists the output is complete.
    pub fn finish(&mut self, statistics: &RunStatistics) -> Result<()> {
        self.write("stats.json", (statistics.json()? + "\n").as_bytes())?;
        begun_run::end(&self.path);
        self.begun = false;
        Ok(())
    }
}

fn remove_if_there(file: &Path) -> Result<()> {
    match fs::remove_file(file) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(Error::output(format!("{} cannot be removed: {error}", file.display())).caused_by(error))
        }
        _ => Ok(()),
    }
}

/// Moves the results of a run from its folder to their place, `stats.json` last, and removes the
/// folder. What an earlier run has left there is replaced or removed, but not the file of the
/// camera of the run. A run without results leaves the place as it is.
pub(crate) fn move_results(from: &Path, place: &Path, camera: Option<&Path>) -> Result<()> {
    if !from.is_dir() {
        return Ok(());
    }
    files::make_folder(place)?;
    let is_camera = |file: &Path| {
        let same =
            |camera| matches!((fs::canonicalize(camera), fs::canonicalize(file)), (Ok(a), Ok(b)) if a == b);
        camera.is_some_and(same)
    };
    // Until it is there again, the place is that of a run that is not complete.
    remove_if_there(&place.join("stats.json"))?;
    for name in RUN_FILES {
        let (new, old) = (from.join(name), place.join(name));
        match new.exists() {
            true => fs::rename(&new, &old).map_err(|error| Error::not_written(old.display(), error))?,
            false if is_camera(&old) => {}
            false => remove_if_there(&old)?,
        }
    }
    let _ = fs::remove_dir_all(from);
    Ok(())
}

/// Refuses a folder with results, unless they may be replaced.
pub(crate) fn check_free(folder: &Path, force: bool) -> Result<()> {
    if force {
        return Ok(());
    }
    let own_map = folder.join(MAP_FILE);
    let is_there = |file: &PathBuf| if *file == own_map { MapFile::is_there(file) } else { file.exists() };
    let growing = GrowingTable::path_in(folder);
    let has_frames = fs::metadata(&growing).is_ok_and(|file| file.len() > 0);
    let has_frames = has_frames || begun_run::has_half_session(folder);
    let there = RUN_FILES.iter().map(|name| folder.join(name)).find(is_there);
    there.or(has_frames.then_some(growing)).map_or(Ok(()), |there| Err(is_taken(folder, &there)))
}

/// The refusal of a folder with results: of a run that was killed it says what there is to do.
fn is_taken(folder: &Path, there: &Path) -> Error {
    if let Some(unfinished) = UnfinishedRun::in_folder(folder) {
        let (shown, there) = (folder.display(), unfinished.description(folder));
        return Error::usage(match unfinished.goes_on {
            true => format!("{shown} {there}; choose another folder"),
            false => format!(
                "{shown} {there}; odograph view {shown} shows what it has, and --force discards it and begins anew"
            ),
        });
    }
    Error::usage(format!(
        "{} is already there; choose another folder, or --force to overwrite it",
        there.display()
    ))
}

fn claims(own_map: &Path, map: &MapUse) -> Result<Vec<MapClaim>> {
    let mut claims = vec![MapClaim::on(own_map)?];
    if let Some(map) = map.path().filter(|_| !map.is_read_only())
        && !claims[0].is_on(map)
    {
        claims.push(MapClaim::on(map)?);
    }
    Ok(claims)
}

/// Writes a header and the lines that `fill` gives; `path` is named in errors.
fn lines_into(
    output: &mut dyn Write,
    path: &Path,
    header: &str,
    fill: impl FnOnce(&mut dyn FnMut(&str) -> Result<()>) -> Result<()>,
) -> Result<()> {
    let mut put =
        |line: &str| output.write_all(line.as_bytes()).map_err(|error| files::cannot_be_written(path, error));
    put(header)?;
    fill(&mut put)
}
