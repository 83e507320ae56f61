//! `odograph view`: a finished run, or a map, in the browser.

pub(super) mod map;

use super::live::{Offer, ServeArguments, Serving};
use crate::{Outcome, console, files};
use odograph::error::{Error, Result};
use odograph::mosaic::Mosaic;
use odograph_live::{GroundPicture, Hub, Introduction, Mark, Phase, Status, TiledGround, TrackRecord};
use odograph_map::MapFile;
use odograph_session::live::show_map_of_run;
use odograph_session::{RunPlan, UnfinishedRun};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

/// Look at a finished run or a map in the browser.
///
/// Shows the path on the mosaic, plots, and a slider over its time.
#[derive(Debug, clap::Args)]
pub struct ViewArguments {
    /// The folder of a run, of `run` or `live`, also of one that was killed; or a map file.
    ///
    /// Of a file in the folder of a run, such as report.html, the run is shown.
    #[arg(value_name = "FOLDER|MAP")]
    pub folder: PathBuf,
    #[command(flatten)]
    pub serve: ServeArguments,
    /// Say nothing but errors.
    #[arg(short, long)]
    pub quiet: bool,
}

/// No table of a run is larger: a week at 30 frames a second, bytes.
const MAX_TABLE: u64 = 4 << 30;
/// No mosaic that was written by this program has more pixels.
const MAX_PIXELS: usize = 64 << 20;

/// Runs the command.
pub fn view(arguments: ViewArguments) -> Result<Outcome> {
    let mut serve = arguments.serve.clone();
    serve.serve.get_or_insert_with(|| ([127, 0, 0, 1], 8080).into());
    let ended = Arc::new(AtomicBool::new(false));
    let run = run_of_file(&arguments.folder);
    let shown = run.as_deref().unwrap_or(&arguments.folder);
    let serving = match shown.is_file() {
        true => serve_map(shown, &serve, &ended)?,
        false => serve_run(shown, &serve)?,
    };
    if run.is_some() && !arguments.quiet {
        let file = console::name(&arguments.folder);
        console::note(&format!("{file} is a file of a run; the page shows the whole run"));
    }
    if let Some(unfinished) = UnfinishedRun::in_folder(shown).filter(|_| !arguments.quiet) {
        console::note(&format!("{} {}", shown.display(), unfinished.description(shown)));
    }
    serving.show_address(" (Ctrl-C ends)", arguments.quiet);
    serving.stay();
    ended.store(true, Ordering::Relaxed);
    Ok(Outcome::Done)
}

/// The folder of the run that a file is of, such as its `report.html`; `None` for a map.
fn run_of_file(file: &Path) -> Option<PathBuf> {
    let folder = match file.parent()? {
        here if here == Path::new("") => Path::new("."),
        folder => folder,
    };
    let is_map =
        || file.extension().is_some_and(|ending| ending == "gpkg") || MapFile::open_read_only(file).is_ok();
    (file.is_file() && folder.join("trajectory.csv").is_file() && !is_map()).then(|| folder.to_owned())
}

/// What the page calls it.
fn title(path: &Path) -> String {
    let name =
        path.canonicalize().ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    name.unwrap_or_else(|| path.display().to_string())
}

fn serve_run(folder: &Path, serve: &ServeArguments) -> Result<Serving> {
    let records = records(folder)?;
    let plan = plan(folder);
    let (width, height) =
        plan.as_ref().map_or((640, 480), |plan| (plan.camera.width(), plan.camera.height()));
    let introduction = Introduction {
        title: title(folder),
        source: plan.as_ref().map_or_else(String::new, |plan| plan.source.path.clone()),
        width,
        height,
        height_m: plan.as_ref().map_or(1.0, |plan| plan.rig.height_m),
        live: false,
        recovered: UnfinishedRun::in_folder(folder).is_some(),
        calibration: false,
    };
    let ground: Arc<dyn TiledGround> = match GroundPicture::of_run(folder, MAX_PIXELS)? {
        Some(picture) => Arc::new(picture),
        None => Arc::new(Mutex::new(Mosaic::new(Default::default()))),
    };
    let hub = Arc::new(Hub::new(introduction, ground));
    let serving = Serving::start(serve, hub, Offer::of_run(folder))?;
    show(&serving, &records, marks(folder, &records));
    show_map_of_run(serving.hub(), folder);
    Ok(serving)
}

fn serve_map(path: &Path, serve: &ServeArguments, ended: &Arc<AtomicBool>) -> Result<Serving> {
    let view = map::MapView::read(path)?;
    let introduction = Introduction {
        title: title(path),
        source: view.source,
        width: view.size.0,
        height: view.size.1,
        height_m: view.height_m,
        live: false,
        recovered: false,
        calibration: false,
    };
    let ground = map::ground(path, MAX_PIXELS, ended)?;
    let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let offer = Offer { folder: folder.to_owned(), files: vec![name] };
    let hub = Arc::new(Hub::new(introduction, ground));
    let serving = Serving::start(serve, hub, offer)?;
    serving.hub().notify("map", &view.graph);
    if view.markers.as_array().is_some_and(|markers| !markers.is_empty()) {
        serving.hub().notify("markers", &view.markers);
    }
    show(&serving, &view.records, view.sessions);
    Ok(serving)
}

fn show(serving: &Serving, records: &[TrackRecord], marks: Vec<Mark>) {
    for record in records {
        serving.hub().add_record(record);
    }
    serving.hub().set_marks(marks);
    serving.hub().set_status(Status {
        phase: Phase::Saved,
        captured: records.len() as u64,
        distance_m: length_m(records),
        ..Status::default()
    });
}

fn records(folder: &Path) -> Result<Vec<TrackRecord>> {
    let table = folder.join("trajectory.csv");
    // A run that was killed has left what it had.
    let growing = files::beside(&table);
    let table = if growing.metadata().is_ok_and(|file| file.len() > 0) { growing } else { table };
    if !table.is_file() {
        let shown = folder.display();
        return Err(Error::input(match folder.read_dir() {
            Err(error) if error.kind() == ErrorKind::PermissionDenied => {
                format!("{shown} cannot be read: {error}")
            }
            _ if folder.exists() => format!(
                "{shown} is neither the folder of a run (it has no trajectory.csv) nor a map file; odograph run makes \
                 both of a recording"
            ),
            _ => {
                format!("{shown}: there is no such folder or file; give the folder of a run, or a map file")
            }
        }));
    }
    TrackRecord::from_csv(&files::read_text_within(&table, MAX_TABLE)?)
        .map_err(|error| error.at(folder.display()))
}

/// The parameters of the run, if they can be read: the page shows more with them.
fn plan(folder: &Path) -> Option<RunPlan> {
    toml::from_str(&files::read_text(&folder.join("run.toml")).ok()?).ok()
}

/// The marks that were set in the run, where there are any.
fn marks(folder: &Path, records: &[TrackRecord]) -> Vec<Mark> {
    let text = files::read_text(&folder.join("marks.csv")).unwrap_or_default();
    let mark = |line: &str| {
        let mut cells = line.splitn(4, ',');
        let mut number = || cells.next()?.parse::<f32>().ok();
        let time_s = number()?;
        let (x_m, y_m) = (number(), number());
        let name = cells.next()?.trim().trim_matches('"').replace("\"\"", "\"");
        let record =
            records.partition_point(|record| record.values[0] < time_s).min(records.len().checked_sub(1)?);
        Some(Mark { record, time_s, x_m, y_m, name })
    };
    text.lines().skip(1).filter_map(mark).collect()
}

/// Length of the path, metres; gaps do not count.
fn length_m(records: &[TrackRecord]) -> f64 {
    let steps = records.windows(2).filter(|pair| pair[0].values[10] == pair[1].values[10]).map(|pair| {
        f64::from(pair[1].values[1] - pair[0].values[1])
            .hypot(f64::from(pair[1].values[2] - pair[0].values[2]))
    });
    steps.filter(|step| step.is_finite()).sum()
}
