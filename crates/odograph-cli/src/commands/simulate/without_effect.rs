//! Options without effect on the rendered images are refused, so that a mistake is noticed.

use super::{PathName, SimulateArguments};
use clap::ValueEnum;
use odograph::error::{Error, Result};
use odograph_simulation::Texture;

/// Fails if an option is given that does not apply to the path, the textures or the ground chosen.
pub fn check(arguments: &SimulateArguments) -> Result<()> {
    use PathName::{Eight, Lanes, Pivot, Spin, Square, SquareTurns, Straight, Walk};
    let given: [(&str, bool, &[PathName]); 6] = [
        ("--length", arguments.length.is_some(), &[Straight, Square, SquareTurns, Eight, Lanes, Walk]),
        ("--speed", arguments.speed.is_some(), &[Straight, Square, SquareTurns, Eight, Lanes, Walk]),
        ("--turn-rate", arguments.turn_rate.is_some(), &[SquareTurns, Pivot, Spin]),
        ("--turns", arguments.turns.is_some(), &[Pivot, Spin, Eight]),
        ("--lanes", arguments.lanes.is_some(), &[Lanes]),
        ("--spacing", arguments.spacing.is_some(), &[Lanes]),
    ];
    for (option, is_given, paths) in given {
        if is_given && !paths.contains(&arguments.path) {
            let names: Vec<String> = paths.iter().map(|path| name(*path)).collect();
            let names = match names.split_last() {
                Some((last, [])) => last.clone(),
                Some((last, others)) => format!("{} or {last}", others.join(", ")),
                None => String::new(),
            };
            return Err(Error::usage(format!(
                "{option} has no effect with --path {}, only with {names}",
                name(arguments.path)
            )));
        }
    }
    if arguments.rolling && arguments.path == PathName::Still {
        return Err(Error::usage(
            "--rolling has no effect with --path still, where the camera does not move",
        ));
    }
    if arguments.ride
        && arguments.undulation.is_none()
        && arguments.kerb.is_none()
        && arguments.ramp.is_none()
    {
        return Err(Error::usage(
            "--ride has nothing to follow on flat ground; add --undulation, --kerb or --ramp",
        ));
    }
    let photographs = arguments.texture.iter().filter(|name| Texture::named(name).is_none()).count();
    for (option, given) in
        [("--photo-width", arguments.photo_width.len()), ("--tiling", arguments.tiling.len())]
    {
        if given > 0 && photographs == 0 {
            return Err(Error::usage(format!(
                "{option} has no effect without a photograph as --texture; {} is a texture of its own",
                arguments.texture.join(" or ")
            )));
        }
        // A value belongs to the texture of the same number; a single one to all.
        if given > arguments.texture.len() {
            return Err(Error::usage(format!(
                "{option} is given {given} times, --texture {}; one for each photograph is the limit",
                match arguments.texture.len() {
                    1 => "once".to_owned(),
                    times => format!("{times} times"),
                }
            )));
        }
    }
    Ok(())
}

/// The name of a path on the command line.
fn name(path: PathName) -> String {
    path.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
}
