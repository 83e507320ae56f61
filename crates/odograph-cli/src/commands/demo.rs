//! `odograph demo`: the bundled drive, end to end.

use super::evaluate::over_ground_m;
use super::run::{ConsoleObserver, print_summary};
use crate::browser::OpeningBrowser;
use crate::console::quoted;
use crate::{Outcome, console, files};
use odograph::error::{Error, Result};
use odograph::evaluation::{self, Alignment, EvaluationOptions};
use odograph::formats::trajectory_file;
use odograph_report::HtmlReporter;
use odograph_session::{RUN_FILES, RunBuilder};
use std::path::{Path, PathBuf};

const CLIP: &[u8] = include_bytes!("../../demo/drive.mp4");
const CAMERA: &str = include_str!("../../demo/camera.yaml");
const RIG: &str = include_str!("../../demo/rig.toml");
const TRUTH: &str = include_str!("../../demo/truth.tum");

/// What the demo unpacks into `input/`: clip, camera, rig and truth.
const INPUTS: [(&str, &[u8]); 4] = [
    ("drive.mp4", CLIP),
    ("camera.yaml", CAMERA.as_bytes()),
    ("rig.toml", RIG.as_bytes()),
    ("truth.tum", TRUTH.as_bytes()),
];

/// Track a bundled recording and show the results.
///
/// The clip is rendered over photographed floors (a shaky, turning, lens-distorted camera), so its
/// truth is known exactly and the result is compared with it.
#[derive(Debug, clap::Args)]
pub struct DemoArguments {
    /// Folder for the clip and the results.
    #[arg(short, long, value_name = "FOLDER", default_value = "odograph-demo")]
    pub output: PathBuf,
    /// Overwrite results that are already there.
    #[arg(long)]
    pub force: bool,
    /// Threads to use; the results are the same for any number. [default: as many as help]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Say nothing but errors.
    #[arg(short, long)]
    pub quiet: bool,
    /// Print stats.json to standard output instead of a summary.
    #[arg(long)]
    pub json: bool,
    /// Open the report in the browser of this machine.
    #[arg(long)]
    pub open: bool,
}

/// Fails if the folder has results, or other inputs under the demo's names.
fn check_free(folder: &Path, force: bool) -> Result<()> {
    let results = RUN_FILES.iter().map(|name| folder.join(name)).filter(|path| path.exists());
    let input = |(name, bytes): (&str, &[u8])| {
        let path = folder.join("input").join(name);
        let there = odograph_video::read_regular_file(&path, bytes.len() as u64);
        (path.exists() && !there.is_ok_and(|there| there == bytes)).then_some(path)
    };
    match results.chain(INPUTS.into_iter().filter_map(input)).next().filter(|_| !force) {
        Some(there) => Err(Error::usage(format!(
            "{} is already there; choose another folder with -o, or --force to overwrite it",
            there.display()
        ))),
        None => Ok(()),
    }
}

/// How this program was called, quoted for a shell: `odograph` if it is on the path.
fn program() -> String {
    let called = std::env::args_os().next().map(PathBuf::from);
    let by_path = called.filter(|path| path.parent().is_some_and(|folder| !folder.as_os_str().is_empty()));
    by_path.map_or_else(|| "odograph".to_owned(), |path| quoted(&path))
}

/// A folder beside the demo's that does not exist yet, so that the printed command works.
fn free(folder: &Path) -> PathBuf {
    let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let again = |number: u32| {
        folder.with_file_name(format!(
            "{name}-again{}",
            if number == 1 { String::new() } else { number.to_string() }
        ))
    };
    (1..).map(again).find(|folder| !folder.exists()).unwrap_or_else(|| again(1))
}

/// Runs the command.
pub fn demo(arguments: DemoArguments) -> Result<Outcome> {
    let folder = &arguments.output;
    files::check_output_folder(folder)?;
    check_free(folder, arguments.force)?;
    let unpacked = folder.join("input");
    let _made = files::MadeFolders::new(&unpacked)?;
    for (name, bytes) in INPUTS {
        files::write(&unpacked.join(name), bytes)?;
    }
    let [clip, camera, rig, truth] = INPUTS.map(|(name, _)| unpacked.join(name));
    let is_chatty = !arguments.quiet && !arguments.json;
    if is_chatty {
        console::print(&format!(
            "A drive of half a minute over photographed floors; this is what you would type for a recording of your own:\n\n  \
             {} run {} --camera {} --rig {} -o {}\n\n",
            program(),
            quoted(&clip),
            quoted(&camera),
            quoted(&rig),
            quoted(&free(folder))
        ))?;
    }
    let run = RunBuilder::new(clip.display().to_string())
        .camera_file(camera)
        .rig_file(rig)
        .folder(folder)
        .overwriting(arguments.force)
        .reporter(HtmlReporter);
    let run = arguments.threads.iter().fold(run, |run, threads| run.threads(usize::from(*threads)));
    let followed = run.run(&ConsoleObserver::new(arguments.quiet))?;
    print_summary(&followed, arguments.quiet, arguments.json)?;
    let outcome = Outcome::from(followed.end);
    if is_chatty && outcome != Outcome::Interrupted {
        compare(folder, &truth)?;
    }
    if arguments.open {
        OpeningBrowser::at(folder.join("report.html")).wait();
    }
    Ok(outcome)
}

/// Prints the error of the path, as the command that it names finds it.
fn compare(folder: &Path, truth: &Path) -> Result<()> {
    let estimate = trajectory_file::parse_tum(&files::read_text(&folder.join("trajectory.tum"))?)?;
    let options = EvaluationOptions { alignment: Alignment::Se3, ..Default::default() };
    let true_path = trajectory_file::parse_tum(TRUTH)?;
    let found = evaluation::evaluate(&estimate, &true_path, &options)?;
    console::print(&format!(
        "Against the truth, a path of {:.2} m: after alignment by rotation and shift {:.1} mm off on average; with the \
         first poses aligned {:.1} mm at the end.\n  {} evaluate {} {}\n",
        over_ground_m(true_path.poses.iter().map(|pose| {
            let place = pose.world_from_camera.translation;
            [place.x, place.y]
        })),
        1e3 * found.absolute.translation.mean,
        1e3 * found.final_position_error_m,
        program(),
        quoted(&folder.join("trajectory.tum")),
        quoted(truth)
    ))
}
