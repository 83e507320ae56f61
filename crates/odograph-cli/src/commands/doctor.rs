//! `odograph doctor`: what will limit the accuracy of a recording, and what to change.

use super::frame_selection::FrameTimes;
use super::run::{CameraSetup, ConsoleObserver, ProfileChoice};
use crate::files::{self, MadeFolders};
use crate::{Outcome, console};
use odograph::error::{Error, Result};
use odograph_report::examination_html;
use odograph_session::{Diagnosis, Finding, Judgement, RunBuilder, SourcePlan};
use std::path::{Path, PathBuf};

/// Say what limits the accuracy of a recording, and what to change.
///
/// Looks at some 300 frames, spread over the first 9000. One line for each thing that was
/// examined: good, unknown (the recording does not show it), limits (less accurate than it could
/// be) or spoils (wrong, or lost).
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct DoctorArguments {
    /// A video, a folder of pictures, a robot recording, or `-` for Y4M on standard input.
    #[arg(value_name = "FILE")]
    file: String,
    #[command(flatten)]
    setup: CameraSetup,
    #[command(flatten)]
    chosen: ProfileChoice,
    /// Topic with the images, where a robot recording (MCAP, ROS bag) has several.
    #[arg(help_heading = "Recording", long, value_name = "NAME")]
    topic: Option<String>,
    #[command(flatten)]
    times: FrameTimes,
    /// Write a page with the findings and the frames that show them (.html).
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite the page if it exists.
    #[arg(long, requires = "output")]
    force: bool,
    /// Print JSON to standard output.
    #[arg(long)]
    json: bool,
    /// Say nothing but errors and what limits or spoils the accuracy.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph doctor drive.mp4
  odograph doctor drive.mp4 --camera camera.yaml --height 0.75 -o doctor.html
  odograph doctor drive.mcap --profile cart --json

Ends with 0 when nothing spoils the result, 2 on wrong usage, 3 on bad input, 4 when something does.";

/// Runs the command.
pub fn doctor(arguments: DoctorArguments) -> Result<Outcome> {
    let page = arguments.output.as_deref();
    let _made = page.map(|page| place_for(page, arguments.force)).transpose()?;
    let setup = arguments.setup.or_of_profile(arguments.chosen.profile.as_deref())?;
    setup.question(arguments.quiet);
    let source = SourcePlan {
        topic: arguments.topic,
        timestamps: arguments.times.timestamps,
        fps: arguments.times.fps,
        ..SourcePlan::new(&arguments.file)
    };
    let diagnosis = setup.of_run(RunBuilder::over(source)).examine(&ConsoleObserver::new(arguments.quiet))?;
    if let Some(page) = page {
        let name = arguments.file.trim_end_matches(['/', '\\']);
        let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
        files::write(page, examination_html(name, &diagnosis).as_bytes())?;
    }
    if arguments.json {
        console::print_json("the findings", &diagnosis)?;
    } else {
        console::print(&text(&arguments.file, &diagnosis, arguments.quiet))?;
    }
    if let Some(page) = page.filter(|_| !arguments.quiet) {
        console::note(&format!("look at {}", page.display()));
    }
    if !arguments.quiet {
        diagnosis.warnings.iter().for_each(|warning| console::warn(warning));
    }
    Ok(match diagnosis.worst() {
        Judgement::Good | Judgement::Unknown | Judgement::Limits => Outcome::Done,
        Judgement::Spoils => Outcome::NotToBeTrusted,
    })
}

/// Makes the folder of the page. Fails before the work where the page cannot be written.
fn place_for(page: &Path, force: bool) -> Result<MadeFolders> {
    if !page.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html")) {
        return Err(Error::usage(format!(
            "{} cannot be the page, which is HTML; give it a name that ends with .html",
            page.display()
        )));
    }
    files::check_output_file(page, force)?;
    MadeFolders::of_result(page)
}

/// The findings, one on a line.
fn text(file: &str, diagnosis: &Diagnosis, only_bad: bool) -> String {
    let Diagnosis { description, frames_looked_at, duration_s, findings, .. } = diagnosis;
    let of_all = diagnosis.frames.map_or_else(String::new, |frames| format!(" of {frames}"));
    let head = match only_bad {
        true => String::new(),
        false => format!(
            "{}\n{frames_looked_at}{of_all} frames looked at, spread over {duration_s:.1} s\n",
            console::name(format!("{file}: {description}"))
        ),
    };
    let shown = findings.iter().filter(|finding| !only_bad || finding.judgement > Judgement::Unknown);
    head + &shown.map(line).collect::<String>()
}

fn line(finding: &Finding) -> String {
    let Finding { topic, judgement, measured, advice, .. } = finding;
    let advice = advice.as_ref().map_or_else(String::new, |advice| format!("; {advice}"));
    console::name(format!("{:<7} {topic}: {measured}{advice}", judgement.name())) + "\n"
}
