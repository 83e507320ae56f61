//! `odograph completions`: completions for shells, and man pages.

use crate::{Arguments, Outcome, console, files};
use clap::CommandFactory;
use clap_complete::Shell;
use odograph::error::{Error, Result};
use std::path::{Path, PathBuf};

/// Write completions for a shell, or the man pages.
///
/// Completions go to standard output; man pages go into a folder, a file for each command.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct CompletionsArguments {
    /// What to write.
    #[arg(value_name = "WHAT", value_enum)]
    what: What,
    /// Folder for the man pages; existing pages are replaced.
    ///
    /// [default: man]
    #[arg(short, long, value_name = "FOLDER")]
    output: Option<PathBuf>,
}

const EXAMPLES: &str = "\
Examples:
  odograph completions bash > ~/.local/share/bash-completion/completions/odograph
  odograph completions zsh > ~/.zfunc/_odograph
  odograph completions man -o ~/.local/share/man/man1";

/// Shells, and `man`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum What {
    Bash,
    Zsh,
    Fish,
    #[value(name = "powershell")]
    PowerShell,
    Elvish,
    /// The man pages.
    Man,
}

impl What {
    fn shell(self) -> Option<Shell> {
        match self {
            Self::Bash => Some(Shell::Bash),
            Self::Zsh => Some(Shell::Zsh),
            Self::Fish => Some(Shell::Fish),
            Self::PowerShell => Some(Shell::PowerShell),
            Self::Elvish => Some(Shell::Elvish),
            Self::Man => None,
        }
    }
}

/// Runs the command.
pub fn completions(arguments: CompletionsArguments) -> Result<Outcome> {
    let mut command = Arguments::command();
    let Some(shell) = arguments.what.shell() else {
        let folder = arguments.output.unwrap_or_else(|| PathBuf::from("man"));
        return write_pages(command, &folder);
    };
    if arguments.output.is_some() {
        return Err(Error::usage("completions go to standard output; -o is the folder of the man pages"));
    }
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut command, "odograph", &mut text);
    console::print(&String::from_utf8_lossy(&text))?;
    Ok(Outcome::Done)
}

/// Writes a page for the program and one for each command.
fn write_pages(mut command: clap::Command, folder: &Path) -> Result<Outcome> {
    files::check_output_folder(folder)?;
    command.build();
    let mut pages = Vec::new();
    collect(&command, "odograph".to_owned(), &mut pages)?;
    let _made = files::MadeFolders::new(folder)?;
    for (name, page) in &pages {
        files::write(&folder.join(format!("{name}.1")), page)?;
    }
    console::print(&format!("{} pages in {}\n", pages.len(), console::name(folder)))?;
    Ok(Outcome::Done)
}

/// The page of a command, and those of its subcommands.
fn collect(command: &clap::Command, name: String, pages: &mut Vec<(String, Vec<u8>)>) -> Result<()> {
    let mut page = Vec::new();
    clap_mangen::Man::new(command.clone())
        .title(name.clone())
        .render(&mut page)
        .map_err(|error| Error::output(format!("the page {name} cannot be made: {error}")))?;
    for inner in command.get_subcommands().filter(|inner| inner.get_name() != "help") {
        collect(inner, format!("{name}-{}", inner.get_name()), pages)?;
    }
    pages.push((name, page));
    Ok(())
}
