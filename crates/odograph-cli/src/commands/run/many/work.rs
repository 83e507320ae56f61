//! The work on several recordings: threads that take one after the other.

use super::super::{ConsoleObserver, RunArguments};
use super::ending::End;
use crate::{console, interrupt};
use indicatif::ProgressBar;
use odograph::error::{Error, Result};
use odograph_session::batch::{Attempt, Batch, Next, Recording, Turn};
use odograph_session::{RunBuilder, RunOutcome};
use std::collections::VecDeque;
use std::num::NonZero;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// From one look at recordings of other workers to the next.
const LOOK: Duration = Duration::from_millis(500);

/// The work of a call.
pub struct Work<'a> {
    /// The recordings of all workers.
    pub all: &'a [Recording],
    /// Those of this call.
    pub own: &'a [&'a Recording],
    pub batch: &'a Batch,
    pub arguments: &'a RunArguments,
}

/// What is left to do, as indices into the recordings of this call.
#[derive(Default)]
struct Queue {
    /// To be begun.
    waiting: VecDeque<usize>,
    /// In the hands of other workers, which may be killed.
    elsewhere: VecDeque<usize>,
}

/// What the threads share.
struct Shared {
    queue: Mutex<Queue>,
    ends: Vec<Mutex<End>>,
    bar: ProgressBar,
    /// The last line of progress.
    shown: Mutex<String>,
    /// Whether it was said that other workers are waited for.
    waits: AtomicBool,
}

/// What became of a recording's turn.
enum Turned {
    End(End),
    /// It failed and has another turn.
    Again,
    /// Another worker has it.
    Elsewhere,
}

impl Work<'_> {
    /// Does it, and returns how each recording of this call ended.
    pub fn done(&self) -> Vec<End> {
        let cores = self
            .arguments
            .output
            .threads
            .map_or_else(|| thread::available_parallelism().map_or(1, NonZero::get), usize::from);
        let workers = cores.min(self.own.len()).max(1);
        let threads = cores / workers;
        let queue = Queue { waiting: self.order(), ..Queue::default() };
        let ends = self.own.iter().map(|_| Mutex::new(End::NotBegun)).collect();
        let shared = Shared {
            queue: Mutex::new(queue),
            ends,
            bar: console::bar("{bar:30} {msg}", self.arguments.output.quiet),
            waits: AtomicBool::new(false),
            shown: Mutex::default(),
        };
        self.show_progress(&shared);
        thread::scope(|scope| {
            (0..workers).for_each(|_| drop(scope.spawn(|| self.take_each(&shared, threads))));
        });
        self.show_progress(&shared);
        shared.bar.finish_and_clear();
        shared.ends.into_iter().map(|end| end.into_inner().unwrap_or(End::NotBegun)).collect()
    }

    /// The longest first, so that no core works alone at the end, and those last that have failed
    /// before; the results do not depend on the order.
    fn order(&self) -> VecDeque<usize> {
        let mut order: Vec<usize> = (0..self.own.len()).collect();
        order.sort_by_cached_key(|&index| {
            let bytes = std::fs::metadata(&self.own[index].source).map_or(0, |file| file.len());
            (self.batch.failed_earlier(self.own[index]), std::cmp::Reverse(bytes))
        });
        order.into()
    }

    /// One recording after the other, until all are done.
    fn take_each(&self, shared: &Shared, threads: usize) {
        let queue = || shared.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let next = || {
            let mut queue = queue();
            let waiting = queue.waiting.pop_front().map(|index| (index, false));
            waiting.or_else(|| queue.elsewhere.pop_front().map(|index| (index, true)))
        };
        while let Some((index, is_elsewhere)) = next() {
            if is_elsewhere {
                thread::sleep(LOOK);
            }
            if interrupt::asked() {
                break;
            }
            match self.turn(index, threads, shared) {
                Turned::End(end) => {
                    let is_news = !matches!(end, End::Earlier(_));
                    *shared.ends[index].lock().unwrap_or_else(PoisonError::into_inner) = end;
                    if is_news {
                        self.show_progress(shared);
                    }
                }
                Turned::Again => queue().waiting.push_back(index),
                Turned::Elsewhere => {
                    if is_elsewhere && !shared.waits.swap(true, Ordering::Relaxed) {
                        self.say_what_is_waited_for(index, shared);
                    }
                    queue().elsewhere.push_back(index);
                }
            }
        }
    }

    fn say_what_is_waited_for(&self, index: usize, shared: &Shared) {
        let sentence = format!(
            "waiting for {}, which another worker runs; if that was killed on another machine, it is taken over \
             after two minutes",
            self.own[index].source
        );
        if !self.arguments.output.quiet {
            shared.bar.suspend(|| console::note(&sentence));
        }
    }

    /// A recording's turn.
    fn turn(&self, index: usize, threads: usize, shared: &Shared) -> Turned {
        let recording = self.own[index];
        let failed = |error: Error| {
            // Most errors name the recording themselves.
            let said = error.to_string();
            let is_named =
                said.strip_prefix(&recording.source).is_some_and(|rest| rest.starts_with([':', ' ']));
            let place = if is_named { String::new() } else { format!("{}: ", recording.source) };
            shared.bar.suspend(|| console::failure(&place, &error));
            Turned::End(End::Failed(error))
        };
        let attempt = match self.batch.turn(recording) {
            Ok(Turn::Run(attempt)) => *attempt,
            Ok(Turn::Busy) => return Turned::Elsewhere,
            Ok(Turn::Ended(ended)) => {
                return match ended.to_error() {
                    Some(error) => failed(error),
                    None => Turned::End(End::Earlier(ended)),
                };
            }
            Err(error) => return failed(error),
        };
        let run = match self.run_of(recording, &attempt, threads) {
            Ok(run) => run,
            Err(error) => return failed(error),
        };
        let result = followed(&run);
        match (self.batch.end(attempt, &run, &result), result) {
            (Err(error), _) | (Ok(Next::Finished), Err(error)) => failed(error),
            (Ok(Next::Finished), Ok(outcome)) => Turned::End(End::Followed(Box::new(outcome))),
            (Ok(Next::Retry), _) => Turned::Again,
            (Ok(Next::TakenOver), _) => Turned::Elsewhere,
        }
    }

    /// The run of a recording as it would be alone, but without output.
    fn run_of(&self, recording: &Recording, attempt: &Attempt, threads: usize) -> Result<RunBuilder> {
        let run = self.arguments.builder(&recording.source, &self.batch.part_folder(attempt))?;
        Ok(run.threads(threads).overwriting(true))
    }

    /// Shows how far all workers are: in the bar, or in lines where several calls share the work.
    fn show_progress(&self, shared: &Shared) {
        let is_shown = !shared.bar.is_hidden() || self.arguments.is_shared();
        if self.arguments.output.quiet || !is_shown {
            return;
        }
        let Ok(progress) = self.batch.progress(self.all) else { return };
        let failed = match progress.failed {
            0 => String::new(),
            failed => format!(", {failed} failed"),
        };
        let shard = self.arguments.shard.map_or_else(String::new, |shard| {
            let is_over = |end: &&Mutex<End>| {
                !matches!(*end.lock().unwrap_or_else(PoisonError::into_inner), End::NotBegun)
            };
            let over = shared.ends.iter().filter(is_over).count();
            format!("; shard {}/{}: {over} of {}", shard.number, shard.of, self.own.len())
        });
        let line = format!(
            "{} of {} recordings done{failed}, {} running{shard}",
            progress.done, progress.of, progress.running
        );
        if shared.bar.is_hidden() {
            let mut shown = shared.shown.lock().unwrap_or_else(PoisonError::into_inner);
            if *shown != line {
                console::note(&line);
                *shown = line;
            }
        } else {
            shared.bar.set_length(progress.of as u64);
            shared.bar.set_position((progress.done + progress.failed) as u64);
            shared.bar.set_message(line);
        }
    }
}

/// Runs a recording; a panic is an error of this recording alone.
fn followed(run: &RunBuilder) -> Result<RunOutcome> {
    let run = || run.run(&ConsoleObserver::new(true));
    catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|_| {
        Err(Error::input("following it ended unexpectedly; please report this recording"))
    })
}
