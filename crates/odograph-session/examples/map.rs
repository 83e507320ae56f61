//! Runs over a recording and keeps the map: `map VIDEO CAMERA_FILE HEIGHT_M FOLDER`.

use odograph::{Error, Result};
use odograph_session::RunBuilder;

#[allow(clippy::print_stdout)] // an example
fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [video, camera, height_m, folder] = arguments.as_slice() else {
        return Err(Error::usage("map VIDEO CAMERA_FILE HEIGHT_M FOLDER"));
    };
    let height_m = height_m.parse().map_err(|_| Error::usage("HEIGHT_M is a number of metres"))?;
    let outcome = RunBuilder::new(video).camera_file(camera).height_m(height_m).folder(folder).run(&())?;
    println!("{:?}: {:.2} m", outcome.end, outcome.statistics.distance_m);
    outcome.written.iter().for_each(|file| println!("{}", file.display()));
    Ok(())
}
