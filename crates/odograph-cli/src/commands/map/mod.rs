//! `odograph map`: commands on map files.

mod export;
mod info;
mod merge;
mod mosaic;
mod optimize;
mod repair;
mod thin;

use crate::{Outcome, files};
use odograph::error::Result;
use odograph_map::{MapClaim, MapFile};
use std::path::Path;

/// Show, join, export, optimise, thin or repair a map.
#[derive(Debug, clap::Args)]
pub struct MapArguments {
    #[command(subcommand)]
    command: MapCommand,
}

#[derive(Debug, clap::Subcommand)]
enum MapCommand {
    Info(info::MapInfoArguments),
    Merge(merge::MergeArguments),
    Export(export::ExportArguments),
    Mosaic(mosaic::MosaicArguments),
    #[command(alias = "optimise")]
    Optimize(optimize::OptimizeArguments),
    Thin(thin::ThinArguments),
    Repair(repair::RepairArguments),
}

/// Runs the command.
pub fn map(arguments: MapArguments) -> Result<Outcome> {
    match arguments.command {
        MapCommand::Info(arguments) => info::info(&arguments),
        MapCommand::Merge(arguments) => merge::merge(&arguments),
        MapCommand::Export(arguments) => export::export(&arguments),
        MapCommand::Mosaic(arguments) => mosaic::mosaic(&arguments),
        MapCommand::Optimize(arguments) => optimize::optimize(&arguments),
        MapCommand::Thin(arguments) => thin::thin(&arguments),
        MapCommand::Repair(arguments) => repair::repair(&arguments),
    }
}

/// Writes a map beside its place, then in place of what is there: after a failure an existing file
/// is unchanged, and no partial map is left.
fn replaced<T>(claim: &MapClaim, place: &Path, write: impl FnOnce(&Path) -> Result<T>) -> Result<T> {
    let beside = files::beside(place);
    MapFile::remove(&beside)?;
    let written = write(&beside).inspect_err(|_| {
        let _ = MapFile::remove(&beside);
    })?;
    MapFile::replace(claim, &beside)?;
    Ok(written)
}

/// The root of a node of a forest, whose roots are their own parents; halves the way to it.
fn root(parents: &mut [usize], mut node: usize) -> usize {
    while parents[node] != node {
        parents[node] = parents[parents[node]];
        node = parents[node];
    }
    node
}
