//! What is said of an option's wrong number, and of a name that is no text, in place of the option
//! parser's own words.

use crate::console;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use std::error::Error;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};

/// The error of the option parser; of a wrong number it says what the option expects.
pub fn in_words(mut error: clap::Error) -> clap::Error {
    let escaped = |(kind, value): (ContextKind, &ContextValue)| match value {
        ContextValue::String(text) => Some((kind, ContextValue::String(console::name(text)))),
        _ => None,
    };
    let escaped: Vec<(ContextKind, ContextValue)> = error.context().filter_map(escaped).collect();
    for (kind, value) in escaped {
        error.insert(kind, value);
    }
    match explained(&error) {
        Some(text) => clap::Error::raw(
            ErrorKind::ValueValidation,
            format!("{text}\n\nFor more information, try '--help'.\n"),
        ),
        None => error,
    }
}

fn explained(error: &clap::Error) -> Option<String> {
    if error.kind() == ErrorKind::InvalidUtf8 {
        let wrong = std::env::args_os().find(|argument| argument.to_str().is_none())?;
        return Some(format!(
            "the name {} is not UTF-8 text; rename the file or folder, or make a link to it",
            console::name(wrong)
        ));
    }
    let context = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    let (option, value) = (context(ContextKind::InvalidArg)?, context(ContextKind::InvalidValue)?);
    let expected = expected(error.source()?, option)?;
    Some(format!("invalid value '{value}' for '{option}': write {expected}"))
}

/// What the option expects, where the reason is a wrong number.
fn expected(why: &(dyn Error + 'static), option: &str) -> Option<String> {
    let unit = unit(option);
    if why.downcast_ref::<ParseFloatError>().is_some() {
        return Some(format!("a plain number{unit}, such as 2.5"));
    }
    if let Some(why) = why.downcast_ref::<ParseIntError>() {
        let smaller = match why.kind() {
            IntErrorKind::PosOverflow => "smaller ",
            _ => "",
        };
        return Some(format!("a {smaller}whole number{unit}, such as 2"));
    }
    // "0 is not in 1..=65535" of a number beyond its range.
    let why = why.to_string();
    let (_, range) = why.split_once(" is not in ")?;
    let (from, to) = range.split_once("..")?;
    Some(match to.trim_start_matches('=') {
        "" => format!("a whole number{unit} from {from} on"),
        to if to.len() > LONGEST_LIMIT => format!("a whole number{unit} from {from} on"),
        to => format!("a whole number{unit} from {from} to {to}"),
    })
}

/// Limits of more digits are those of the type, not of the option.
const LONGEST_LIMIT: usize = 9;

/// The unit of an option's number, by the name of its value: `--start <SECONDS>`.
fn unit(option: &str) -> &'static str {
    let name = option.split_once('<').and_then(|(_, rest)| rest.split('>').next()).unwrap_or_default();
    match name {
        "SECONDS" => " of seconds",
        "MS" => " of milliseconds",
        "RATE" => " of frames a second",
        "DEGREES" => " of degrees",
        "DEGREES/S" => " of degrees a second",
        "M/S" => " of metres a second",
        "HZ" => " of hertz",
        "PERCENT" => " of percent",
        "GRAY" => " of gray levels",
        _ => "",
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    fn said(arguments: &str) -> String {
        let error = crate::command().try_get_matches_from(arguments.split(' ')).unwrap_err();
        in_words(error).to_string()
    }

    #[test]
    fn wrong_numbers_are_answered_with_what_is_expected() {
        for (arguments, words) in [
            ("odograph run a --fps 3O", "'3O' for '--fps <RATE>': write a plain number of frames a second"),
            ("odograph run a --start 5s", "write a plain number of seconds, such as 2.5\n"),
            ("odograph run a --every -1", "'-1' for '--every <N>': write a whole number, such as 2\n"),
            ("odograph run a --every 1.5", "'1.5' for '--every <N>': write a whole number, such as 2\n"),
            ("odograph run a --every 99999999999999999999", "write a smaller whole number"),
            ("odograph run a --threads 0", "write a whole number from 1 to 65535\n"),
            ("odograph map thin a --max-keyframes 0", "write a whole number from 1 on\n"),
        ] {
            let said = said(arguments);
            assert!(
                said.starts_with("error: invalid value '") && said.contains(words),
                "{arguments}: {said}"
            );
        }
        // Other errors are unchanged.
        assert!(said("odograph run a --motion 1").contains("possible values"));
        assert!(said("odograph run a --height x").contains("give a length as 0.9"));
    }

    #[test]
    fn no_option_has_the_words_of_a_programming_language() {
        fn check(command: &clap::Command, path: &str) {
            let with_values = command.get_opts().filter(|option| option.get_action().takes_values());
            for option in with_values.filter_map(clap::Arg::get_long) {
                let error = crate::command()
                    .try_get_matches_from(path.split(' ').chain([format!("--{option}=1O").as_str()]));
                let said = error.map_err(in_words).err().map(|error| error.to_string()).unwrap_or_default();
                for words in ["literal", "digit", "empty string", "target type", " is not in "] {
                    assert!(!said.lines().next().unwrap_or_default().contains(words), "{path}: {said}");
                }
            }
            for inner in command.get_subcommands() {
                check(inner, &format!("{path} {}", inner.get_name()));
            }
        }
        check(&crate::command(), "odograph");
    }
}
