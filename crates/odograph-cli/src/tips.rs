//! Hints appended to the option parser's errors: an example of the command, or what was probably
//! meant.

use crate::console::quoted;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use std::ffi::OsString;
use std::path::Path;

/// The error with a tip, where there is one for it; `arguments` begin with the program's name.
pub fn with_tip(mut error: clap::Error, command: &clap::Command, arguments: &[OsString]) -> clap::Error {
    if let Some(tip) = tip(&error, command, arguments) {
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
    }
    error
}

/// The error of a long option with one hyphen. The parser would take `-output drive` for `-o
/// utput`, and `-height` for a request for help.
pub fn one_hyphen(command: &clap::Command, arguments: &[OsString]) -> Option<clap::Error> {
    let (_, asked) = asked(command, arguments);
    let is_long = |name: &str| asked.get_opts().any(|option| option.get_long() == Some(name));
    let before_files = arguments.iter().take_while(|argument| *argument != "--");
    let mut typed = before_files.filter_map(|argument| argument.to_str());
    let wrong = typed.find(|argument| argument.strip_prefix('-').is_some_and(is_long))?;
    let mut error = clap::Error::new(ErrorKind::UnknownArgument).with_cmd(command);
    error.insert(ContextKind::InvalidArg, ContextValue::String(wrong.to_owned()));
    Some(error)
}

fn tip(error: &clap::Error, command: &clap::Command, arguments: &[OsString]) -> Option<String> {
    let context = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    let (names, asked) = asked(command, arguments);
    match error.kind() {
        ErrorKind::MissingRequiredArgument => {
            let missing = match error.get(ContextKind::InvalidArg) {
                Some(ContextValue::Strings(missing)) => missing.as_slice(),
                _ => &[],
            };
            example(asked, &names, missing).map(|example| format!("for example {example}"))
        }
        ErrorKind::InvalidSubcommand => {
            let typed = context(ContextKind::InvalidSubcommand)?;
            let path = Path::new(typed);
            if !path.exists() {
                // The parser finds similar long names by itself.
                error.get(ContextKind::SuggestedSubcommand).is_none().then_some(())?;
                let mut all = asked.get_subcommands().map(clap::Command::get_name);
                let name = all.find(|name| is_one_slip(typed, name))?;
                let names = names.iter().fold(String::new(), |all, name| format!("{all} {name}"));
                return Some(format!("odograph{names} {name} is a similar command"));
            }
            let is_map = path.extension().is_some_and(|ending| ending == "gpkg");
            let verb = match (names.as_slice(), is_map) {
                ([], false) => "run",
                ([], true) => "view",
                (["map"], _) => "map info",
                (["camera"], _) => "camera show",
                _ => return None,
            };
            Some(format!("it is a file or folder; write odograph {verb} {}", quoted(path)))
        }
        ErrorKind::UnknownArgument => {
            let unknown = context(ContextKind::InvalidArg)?;
            let has = |long: &str| asked.get_opts().any(|option| option.get_long() == Some(long));
            if let Some(name) = unknown.strip_prefix('-').filter(|name| has(name)) {
                return Some(format!("write it with two hyphens, --{name}"));
            }
            let mut files = arguments.iter().filter(|argument| {
                argument.to_str().is_some_and(|argument| {
                    unknown.len() == 2 && argument.starts_with(unknown) && Path::new(argument).exists()
                })
            });
            if let Some(file) = files.next() {
                return Some(format!("it is a file or folder; write {}", quoted(&Path::new(".").join(file))));
            }
            if unknown.starts_with('-') && error.get(ContextKind::SuggestedArg).is_none() {
                let names = names.iter().fold(String::new(), |all, name| format!("{all} {name}"));
                return Some(format!("odograph{names} -h lists the options"));
            }
            let option = match Path::new(unknown).extension()?.to_str()? {
                "gpkg" => "map",
                "yaml" | "yml" => "camera",
                "toml" => "rig",
                _ => return None,
            };
            has(option).then(|| format!("write --{option} {}", quoted(Path::new(unknown))))
        }
        _ => None,
    }
}

/// Whether `typed` is `name` with one letter too many, missing or wrong, or two swapped.
fn is_one_slip(typed: &str, name: &str) -> bool {
    let [a, b] = [typed, name].map(|word| word.chars().collect::<Vec<_>>());
    let same = a.iter().zip(&b).take_while(|(a, b)| a == b).count();
    let (a, b) = (&a[same..], &b[same..]);
    let same = a.iter().rev().zip(b.iter().rev()).take_while(|(a, b)| a == b).count();
    match (&a[..a.len() - same], &b[..b.len() - same]) {
        ([] | [_], [] | [_]) => true,
        ([first, second], [third, fourth]) => first == fourth && second == third,
        _ => false,
    }
}

/// The command that the arguments ask for, and its names below the program's.
fn asked<'a>(command: &'a clap::Command, arguments: &[OsString]) -> (Vec<&'a str>, &'a clap::Command) {
    let (mut names, mut asked) = (Vec::new(), command);
    for argument in arguments.iter().skip(1) {
        let Some(inner) = argument.to_str().and_then(|name| asked.find_subcommand(name)) else { break };
        names.push(inner.get_name());
        asked = inner;
    }
    (names, asked)
}

/// The first example in the help of a command that has what is missing: `--map <FILE>`, `<SOURCE>`.
fn example(command: &clap::Command, names: &[&str], missing: &[String]) -> Option<String> {
    let help = command.get_after_help()?.to_string();
    let options: Vec<&str> =
        missing.iter().filter_map(|argument| argument.split(' ').next()?.strip_prefix("--")).collect();
    let begins = format!("odograph {} ", names.join(" "));
    let short = |long: &str| {
        let option = command.get_opts().find(|option| option.get_long() == Some(long))?;
        Some(format!(" -{} ", option.get_short()?))
    };
    let has = |line: &str, long: &str| {
        line.contains(&format!("--{long}")) || short(long).is_some_and(|short| line.contains(&short))
    };
    let has_all = |line: &str| options.iter().all(|option| has(line, option));
    let lines = help.split_once("Examples:")?.1.lines();
    let line = lines.map(str::trim_start).find(|line| line.starts_with(&begins) && has_all(line))?;
    Some(line.split(" #").next().unwrap_or(line).trim().to_owned())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    #[test]
    fn errors_say_what_was_probably_meant() {
        for (arguments, tip) in [
            ("odograph board", "for example odograph board --board charuco:8x11:20mm -o board.pdf\n"),
            ("odograph localize a.jpg", "for example odograph localize photo.jpg --map hall.gpkg\n"),
            ("odograph run a --control b", "--markers apriltag:36h11:80mm --control hall.csv -o drive/\n"),
            ("odograph live", "for example odograph live "),
            ("odograph map info", "for example odograph map info drive/map.gpkg\n"),
            ("odograph map export a.gpkg", "for example odograph map export map.gpkg -o floor.tif\n"),
            ("odograph Cargo.toml", "it is a file or folder; write odograph run Cargo.toml\n"),
            ("odograph map Cargo.toml", "it is a file or folder; write odograph map info Cargo.toml\n"),
            ("odograph camera Cargo.toml", "write odograph camera show Cargo.toml\n"),
            ("odograph run a.mp4 -camera b.yaml", "write it with two hyphens, --camera\n"),
            (
                "odograph run a.mp4 -height 1",
                "'-height' found\n\n  tip: write it with two hyphens, --height\n",
            ),
            ("odograph run a.mp4 -output b", "write it with two hyphens, --output\n"),
            ("odograph localize a.jpg b/map.gpkg", "write --map b/map.gpkg\n"),
            ("odograph undistort a.mp4 b.yaml", "write --camera b.yaml\n"),
            ("odograph rn", "'rn'\n\n  tip: odograph run is a similar command\n"),
            ("odograph rnu", "tip: odograph run is a similar command\n"),
            ("odograph board --weather sunny", "tip: odograph board -h lists the options\n"),
            (
                "odograph map thin a.gpkg -o b",
                "'-o' found\n\n  tip: odograph map thin -h lists the options\n",
            ),
        ] {
            let words: Vec<OsString> = arguments.split(' ').map(OsString::from).collect();
            let command = crate::command();
            let error = one_hyphen(&command, &words)
                .unwrap_or_else(|| command.clone().try_get_matches_from(&words).unwrap_err());
            let said = with_tip(error, &command, &words).to_string();
            assert!(said.contains(tip), "{arguments}: {said}");
            assert_eq!(said.matches("tip: ").count(), 1, "{arguments}: {said}");
        }
    }

    #[test]
    fn a_misspelt_command_is_not_taken_for_a_file() {
        let words: Vec<OsString> = ["odograph", "runn"].map(OsString::from).into();
        let command = crate::command();
        let said = with_tip(command.clone().try_get_matches_from(&words).unwrap_err(), &command, &words);
        assert!(said.to_string().contains("similar subcommands exist"), "{said}");
    }
}
