//! `-o -`: results are files, and a file named `-` would be taken for standard input ever after.

use clap::Command;
use clap::builder::{PathBufValueParser, TypedValueParser};
use std::path::{Path, PathBuf};

/// A command whose `--output` refuses `-`, except where its result can go to standard output.
pub fn required(command: Command) -> Command {
    if command.get_name() == "convert" {
        return command;
    }
    let names: Vec<String> = command.get_subcommands().map(|inner| inner.get_name().to_owned()).collect();
    let command = command.mut_args(|argument| match argument.get_long() {
        Some("output") => argument.value_parser(PathBufValueParser::new().try_map(named)),
        _ => argument,
    });
    names.into_iter().fold(command, |command, name| command.mut_subcommand(name, required))
}

fn named(path: PathBuf) -> Result<PathBuf, &'static str> {
    match path == Path::new("-") {
        true => Err("results do not go to standard output; give a name"),
        false => Ok(path),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn only_a_converted_camera_goes_to_standard_output() {
        let said = |arguments: &str| {
            crate::command()
                .try_get_matches_from(arguments.split(' '))
                .map(drop)
                .map_err(|error| error.to_string())
        };
        for arguments in [
            "odograph run a -o -",
            "odograph demo --output -",
            "odograph calibrate a --board b -o -",
            "odograph map merge a b -o -",
            "odograph map export a -o -",
        ] {
            assert!(
                said(arguments).is_err_and(|said| said.contains("do not go to standard output")),
                "{arguments}"
            );
        }
        assert_eq!(said("odograph camera convert a --to ros -o -"), Ok(()));
        assert_eq!(said("odograph map export a -o ./-"), Ok(()));
    }
}
