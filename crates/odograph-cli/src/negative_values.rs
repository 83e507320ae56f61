//! Values that begin with a minus: the option parser takes `-1m` for a group of short options.

use clap::Command;
use std::ffi::OsString;

/// A command whose options take `-1` as a value, which is then refused with what they expect.
pub fn allowed(command: Command) -> Command {
    let names: Vec<String> = command.get_subcommands().map(|inner| inner.get_name().to_owned()).collect();
    let command = command.mut_args(|argument| {
        let takes_values = argument.get_long().is_some() && argument.get_action().takes_values();
        if takes_values { argument.allow_negative_numbers(true) } else { argument }
    });
    names.into_iter().fold(command, |command, name| command.mut_subcommand(name, allowed))
}

/// The arguments with `--height -1m` written as `--height=-1m`, so that what is wrong with it is
/// said by the option. `--height --force` stays: there the value is missing.
pub fn joined(arguments: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut joined: Vec<OsString> = Vec::new();
    let mut is_after_options = false;
    for argument in arguments {
        is_after_options |= argument == "--";
        match joined.last_mut().filter(|last| !is_after_options && is_bare_option(last)) {
            Some(option) if is_negative(&argument) => {
                option.push("=");
                option.push(argument);
            }
            _ => joined.push(argument),
        }
    }
    joined
}

/// `--height`, but not `--height=1`.
fn is_bare_option(argument: &OsString) -> bool {
    argument
        .to_str()
        .and_then(|text| text.strip_prefix("--"))
        .is_some_and(|name| name.starts_with(|c: char| c.is_ascii_alphabetic()) && !name.contains('='))
}

/// Whether an argument is a minus and a number, whatever follows: `-1m`, `-.5`, `-1x2`, `-inf`.
fn is_negative(argument: &OsString) -> bool {
    let Some(number) = argument.to_str().and_then(|text| text.strip_prefix('-')) else { return false };
    let digits = number.strip_prefix('.').unwrap_or(number);
    digits.starts_with(|c: char| c.is_ascii_digit()) || matches!(number, "inf" | "infinity" | "nan")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_negative_value_belongs_to_the_option_before_it() {
        for (typed, expected) in [
            ("run a --height -1m -o b", "run a --height=-1m -o b"),
            ("run a --field-of-view -1x2", "run a --field-of-view=-1x2"),
            ("run a --end -inf --start -.5", "run a --end=-inf --start=-.5"),
            ("run a --height --force", "run a --height --force"),
            ("run a --height=1 -1m", "run a --height=1 -1m"),
            ("run a -o -q", "run a -o -q"),
            ("info -- --height -1m", "info -- --height -1m"),
        ] {
            let joined = joined(typed.split(' ').map(OsString::from));
            assert_eq!(joined, expected.split(' ').collect::<Vec<_>>(), "{typed}");
        }
    }
}
