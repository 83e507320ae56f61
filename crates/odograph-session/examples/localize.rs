//! Finds out where a picture or a recording was taken in a map: `localize SOURCE MAP`.

use odograph::{Error, Result};
use odograph_session::{RunBuilder, SourcePlan};

#[allow(clippy::print_stdout)] // an example
fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [source, map] = arguments.as_slice() else {
        return Err(Error::usage("localize SOURCE MAP"));
    };
    let outcome = RunBuilder::localizing(SourcePlan::new(source), map).run(&())?;
    match (outcome.place, outcome.resemblance) {
        (Some(at), _) => println!("x {:.3} m, y {:.3} m, heading {:.1}°", at.x_m, at.y_m, at.heading_deg),
        (None, Some(alike)) => {
            println!("not found: {:?}, {} places alike", alike.verdict, alike.places.len())
        }
        (None, None) => println!("not found"),
    }
    Ok(())
}
