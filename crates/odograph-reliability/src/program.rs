//! The program under test.

use crate::moment::EndingSignal;
use odograph::error::{Error, Result};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

/// A command that has not ended by then hangs.
const PATIENCE: Duration = Duration::from_secs(60);

/// Exit code after a signal that the program heeded.
pub const INTERRUPTED: i32 = 130;

/// The program under test.
#[derive(Debug)]
pub struct Program(PathBuf);

impl Program {
    /// The given program, or `odograph` beside the running one. Fails if there is none.
    pub fn new(path: Option<PathBuf>) -> Result<Self> {
        let beside = || std::env::current_exe().ok().map(|own| own.with_file_name("odograph"));
        let path = path.or_else(beside).and_then(|path| path.canonicalize().ok());
        path.filter(|path| path.is_file()).map(Self).ok_or_else(|| {
            Error::usage(
                "there is no program to kill; build it with cargo build --release, or give --program",
            )
        })
    }

    fn command(&self, folder: &Path, arguments: &str) -> Command {
        let mut command = Command::new(&self.0);
        command.current_dir(folder).args(arguments.split_whitespace()).env("ODOGRAPH_FFMPEG", "");
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        command
    }

    /// Starts a command.
    pub fn start(&self, folder: &Path, arguments: &str) -> Result<Child> {
        self.command(folder, arguments).spawn().map_err(cannot_start)
    }

    /// Runs a command to its end. With a `client` it is a server, which is to end when its client
    /// has; the outcome is the client's, or that of a server that ended before it.
    pub fn run_with(&self, folder: &Path, arguments: &str, client: Option<&str>) -> Result<Output> {
        let Some(client) = client else { return self.run(folder, arguments) };
        let mut server = self.start(folder, arguments)?;
        let done = self.run(folder, client)?;
        signal(&mut server, EndingSignal::Interrupt);
        let ended = server.wait_with_output().map_err(cannot_start)?;
        let is_orderly = matches!(ended.status.code(), Some(0 | INTERRUPTED));
        Ok(if is_orderly { done } else { ended })
    }

    /// Runs a command to its end.
    pub fn run(&self, folder: &Path, arguments: &str) -> Result<Output> {
        self.command(folder, arguments).output().map_err(cannot_start)
    }
}

fn cannot_start(error: std::io::Error) -> Error {
    Error::input(format!("the program cannot be started: {error}"))
}

/// Sends a signal. A process that has ended already is no failure.
pub fn signal(child: &mut Child, signal: EndingSignal) {
    let name = match signal {
        EndingSignal::Kill => {
            let _ = child.kill();
            return;
        }
        EndingSignal::Terminate => "TERM",
        EndingSignal::Interrupt => "INT",
    };
    let send = format!("kill -{name} {} 2>/dev/null", child.id());
    let _ = Command::new("sh").args(["-c", &send]).status();
}

/// Waits for the end of a process; `None` if it hangs, and then it is killed.
pub fn wait(child: &mut Child) -> Result<Option<ExitStatus>> {
    let begun = Instant::now();
    loop {
        let status = child.try_wait().map_err(cannot_start)?;
        if status.is_some() {
            return Ok(status);
        }
        if begun.elapsed() > PATIENCE {
            let _ = child.kill();
            let _ = child.wait();
            return Ok(None);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}
