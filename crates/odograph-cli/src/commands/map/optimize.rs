//! `odograph map optimize`: optimises the pose graph of a map.

use super::mosaic;
use crate::{Outcome, console, files};
use odograph::error::Result;
use odograph::ground_map::GroundMap;
use odograph::keyframe::EdgeKind;
use odograph::odometry::OdometryConfig;
use odograph::slam;
use odograph_map::{MapClaim, MapFile};
use std::path::{Path, PathBuf};

/// Optimise all keyframes of a map over all measurements between them.
///
/// The paths and the mosaic are moved with them.
///
/// A run does this at its end. It is useful after a killed run, and after thinning.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct OptimizeArguments {
    /// The map.
    #[arg(value_name = "MAP")]
    map: PathBuf,
    /// Write the result here and leave the map as it is.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// What may change between frames: as when the map was made.
    #[arg(long, value_name = "MODEL", default_value = "auto")]
    motion: crate::commands::run::Motion,
    /// Overwrite the result if it exists.
    #[arg(long, requires = "output")]
    force: bool,
    /// Say nothing but errors.
    #[arg(short, long)]
    quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  odograph map optimize drive/map.gpkg
  odograph map optimize hall.gpkg -o hall-straight.gpkg";

/// Runs the command.
pub fn optimize(arguments: &OptimizeArguments) -> Result<Outcome> {
    let Some(output) = &arguments.output else {
        return in_place(&arguments.map, arguments);
    };
    files::check_output_file(output, arguments.force)?;
    let _made = files::MadeFolders::of_file(output)?;
    super::replaced(&MapClaim::on(output)?, output, |beside| {
        MapFile::open_read_only(&arguments.map)?.copy_to(beside)?;
        in_place(beside, arguments)
    })
}

fn in_place(path: &Path, arguments: &OptimizeArguments) -> Result<Outcome> {
    let mut file = MapFile::open(path)?;
    let map = file.map()?;
    let mut odometry = OdometryConfig::default();
    odometry.motion.model = arguments.motion.into();
    let straight = slam::optimize(&map, &odometry);
    let moved_m = most_moved_m(&map, &straight);
    let poses: Vec<_> = straight.keyframes.iter().map(|k| (k.id, k.pose, k.covariance)).collect();
    file.set_poses(&poses)?;
    if file.mosaic_shift_m()?.is_some() {
        let resolution_m = file.mosaic()?.map(|layer| layer.resolution_m);
        mosaic::rendered(&mut file, resolution_m, arguments.quiet)?;
    }
    file.close()?;
    if !arguments.quiet {
        let loops = map.edges.iter().filter(|edge| edge.kind == EdgeKind::Loop).count();
        console::print(&match loops {
            0 => "no loops: nothing to optimise, and nothing was moved\n".to_owned(),
            _ => format!(
                "{} keyframes, {} edges, {loops} of them loops; moved by up to {:.2} mm\n",
                map.keyframes.len(),
                map.edges.len(),
                1e3 * moved_m
            ),
        })?;
    }
    Ok(Outcome::Done)
}

fn most_moved_m(before: &GroundMap, after: &GroundMap) -> f64 {
    let pairs = before.keyframes.iter().zip(&after.keyframes);
    pairs.map(|(a, b)| a.pose.distance_m(&b.pose)).fold(0.0, f64::max)
}
