//! Several recordings in one call: each has a folder of its own and the same result as alone; as
//! many run concurrently as there are cores. Several such calls, on any number of machines, may
//! share a results folder.

mod ending;
mod work;

use super::{Progress, RunArguments};
use crate::{Outcome, files};
use ending::{print_summary, worst};
use odograph::error::{Error, Result};
use odograph_report::recordings_html;
use odograph_session::batch::{self, Batch, BatchOptions, Recording, Search};
use std::path::Path;
use work::Work;

/// The recordings of a call with more than one source, with a folder of recordings, or that shares
/// its results folder with other calls; `None` for a single one.
pub fn recordings(arguments: &RunArguments) -> Result<Option<Vec<Recording>>> {
    let given = || arguments.source.iter().chain(&arguments.more);
    let search = match &arguments.folder {
        Some(results) if arguments.is_shared() => Search::Tree { results },
        // Whoever names the folder of a project does not mean all that is below it.
        _ => Search::Videos,
    };
    let listed = Recording::listed(given(), search);
    let is_one = arguments.more.is_empty() && listed.iter().all(|one| one.source == arguments.source());
    if is_one && !arguments.is_shared() {
        return match arguments.retries {
            Some(_) => Err(Error::usage("--retries is for several recordings; add --resume or --shard")),
            None => Ok(None),
        };
    }
    if arguments.is_shared() && arguments.folder.is_none() {
        return Err(Error::usage("--resume and --shard need the folder of all results; give -o FOLDER"));
    }
    if let Some(map) = &arguments.output.map {
        return Err(Error::usage(format!(
            "--map {} is one map, and several recordings would write it at once; follow them one after the other",
            map.display()
        )));
    }
    if let Some(single) = given().find(|source| source.as_str() == "-" || source.ends_with(".toml")) {
        return Err(Error::usage(format!("{single} is run by itself, not among other recordings")));
    }
    for (ending, option) in [(".yaml", "--camera"), (".yml", "--camera"), (".gpkg", "--map")] {
        if let Some(other) = given().find(|source| source.ends_with(ending) && Path::new(source).is_file()) {
            return Err(Error::usage(format!("{other} is no recording; give it with {option}")));
        }
    }
    let one_alone = [
        ("--timestamps", arguments.times.timestamps.is_some()),
        ("--gyro, --heading, --wheel, --range or a topic of them", !arguments.sensors.files().is_empty()),
        ("--reference", arguments.reference.is_some()),
        ("--progress json", arguments.progress == Progress::Json),
        ("--bag-out", arguments.bag_out.is_some()),
        ("--video-out", arguments.video_out.is_some()),
        ("--site", arguments.site.site.is_some()),
    ];
    if let Some((option, _)) = one_alone.iter().find(|(_, given)| *given) {
        return Err(Error::usage(format!("{option} belongs to one recording; run it by itself")));
    }
    Ok(Some(listed))
}

/// Runs the recordings of this call's part, and prints how each ended. A failure does not stop the
/// others.
pub fn run(recordings: &[Recording], arguments: &RunArguments, folder: &Path) -> Result<Outcome> {
    files::check_output_folder(folder)?;
    // It is removed where no recording can be followed.
    let made = files::MadeFolders::new(folder)?;
    let options = BatchOptions {
        resumes: arguments.resume.is_some(),
        overwrites: arguments.output.force,
        retries: arguments.retries.unwrap_or(u32::from(arguments.is_shared())),
    };
    let batch = Batch::join(folder, &arguments.builder("", folder)?, options)?;
    let is_own = |name: &str| arguments.shard.is_none_or(|shard| shard.contains(name));
    let own: Vec<&Recording> = recordings.iter().filter(|recording| is_own(&recording.name)).collect();
    let ends = Work { all: recordings, own: &own, batch: &batch, arguments }.done();
    if !ends.iter().any(ending::End::has_results) && !arguments.is_shared() && made.is_any() {
        batch.discard();
    } else {
        batch.write_results(recordings, |results| {
            vec![
                ("results.csv", batch::csv(results).into_bytes()),
                ("results.html", recordings_html(results).into_bytes()),
            ]
        })?;
    }
    print_summary(&own, &ends, arguments, folder)?;
    worst(&ends)
}
