#![allow(clippy::unwrap_used)] // a test fails by panicking

use super::*;
use tempfile::TempDir;

/// A results folder with one recording, which is not one that can be read.
struct Place {
    folder: TempDir,
    recording: Recording,
}

const RESUMED: BatchOptions = BatchOptions { resumes: true, overwrites: false, retries: 1 };

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join("drive.mp4");
        fs::write(&source, "frames").unwrap();
        let recording = Recording { source: source.display().to_string(), name: "day/drive".to_owned() };
        Self { folder, recording }
    }

    fn results(&self) -> PathBuf {
        self.folder.path().join("results")
    }

    fn batch(&self, options: BatchOptions) -> Batch {
        Batch::join(&self.results(), &run(), options).unwrap()
    }

    /// Begins an attempt.
    fn begun(&self, batch: &Batch) -> Attempt {
        match batch.turn(&self.recording).unwrap() {
            Turn::Run(attempt) => *attempt,
            other => panic!("{other:?}"),
        }
    }

    /// The error of a recording that is not to be run.
    fn error(&self, batch: &Batch) -> String {
        match batch.turn(&self.recording).unwrap() {
            Turn::Ended(ended) => ended.error.unwrap(),
            other => panic!("{other:?}"),
        }
    }

    /// Ends an attempt with results.
    fn done(&self, batch: &Batch, attempt: Attempt) -> Next {
        let part = batch.part_folder(&attempt);
        fs::create_dir_all(&part).unwrap();
        fs::write(part.join("stats.json"), attempt.number.to_string()).unwrap();
        // How the results came about does not matter; this is recorded as done below.
        let next = batch.end(attempt.clone(), &run(), &Err(Error::input("no outcome"))).unwrap();
        if next != Next::TakenOver {
            let ended = Ended { how: RunStatus::Done, error: None, statistics: None };
            batch.manifest.end(&Attempt { ended: Some(ended), ..attempt }).unwrap();
        }
        next
    }

    fn published(&self) -> Option<String> {
        fs::read_to_string(self.results().join("day/drive/stats.json")).ok()
    }
}

fn run() -> RunBuilder {
    RunBuilder::new("").field_of_view_m(1.0, 1.0)
}

/// What a worker leaves that is killed after it has begun an attempt.
fn kill(batch: &Batch, attempt: &Attempt) {
    let lease = |worker: &str| batch.results.join(BATCH).join("workers").join(worker);
    fs::copy(lease(&attempt.worker), lease("killed")).unwrap();
    fs::create_dir_all(batch.part_folder(attempt)).unwrap();
    batch.manifest.end(&Attempt { worker: "killed".to_owned(), ..attempt.clone() }).unwrap();
}

#[test]
fn a_recording_has_one_worker_at_a_time_and_is_run_once() {
    let place = Place::new();
    let (first, second) = (place.batch(RESUMED), place.batch(RESUMED));
    let attempt = place.begun(&first);
    assert!(matches!(second.turn(&place.recording).unwrap(), Turn::Busy));
    place.done(&first, attempt);
    assert_eq!(place.published().as_deref(), Some("1"));
    let is_done = |batch: &Batch| matches!(batch.turn(&place.recording).unwrap(), Turn::Ended(_));
    assert!(is_done(&first) && is_done(&second) && is_done(&place.batch(RESUMED)));

    // Without its results it is not done, and with other options neither.
    let other = Batch::join(&place.results(), &run().without_loops(), RESUMED).unwrap();
    assert_eq!(place.begun(&other).number, 2);
    drop((first, second, other));
    fs::remove_dir_all(place.results().join(BATCH).join("attempts")).unwrap();
    fs::remove_dir_all(place.results().join("day/drive")).unwrap();
    assert_eq!(place.begun(&place.batch(RESUMED)).number, 1);
}

#[test]
#[cfg(target_os = "linux")] // elsewhere two minutes pass
fn a_killed_worker_is_noticed_and_disturbs_nobody_when_it_wakes_up() {
    let place = Place::new();
    let (first, second) = (place.batch(RESUMED), place.batch(RESUMED));
    let attempt = place.begun(&first);
    kill(&first, &attempt);
    let next = place.begun(&second);
    assert_eq!((next.number, first.part_folder(&attempt).exists()), (2, false));
    assert_eq!(place.done(&first, attempt), Next::TakenOver);
    assert_eq!(place.published(), None);
    place.done(&second, next);
    assert_eq!(place.published().as_deref(), Some("2"));
}

#[test]
#[cfg(target_os = "linux")] // elsewhere two minutes pass
fn what_kills_each_of_its_workers_is_given_up() {
    let place = Place::new();
    let batch = place.batch(RESUMED);
    for number in 1..=2 {
        let attempt = place.begun(&batch);
        assert_eq!(attempt.number, number);
        kill(&batch, &attempt);
    }
    let error = place.error(&batch);
    assert!(error.ends_with("its worker was killed 2 times, perhaps for lack of memory"), "{error}");
    // That is on record, and another call tries again.
    assert_eq!(batch.progress(&[]).unwrap(), BatchProgress { failed: 1, of: 1, ..BatchProgress::default() });
    assert_eq!(place.begun(&place.batch(RESUMED)).number, 4);
}

#[test]
fn a_failure_is_tried_again_as_often_as_asked_and_a_refusal_is_not() {
    let place = Place::new();
    let batch = place.batch(RESUMED);
    let failed = |error| batch.end(place.begun(&batch), &run(), &Err(error)).unwrap();
    assert_eq!(failed(Error::input("damaged")), Next::Retry);
    assert_eq!(failed(Error::input("damaged")), Next::Finished);
    assert_eq!(place.error(&batch), "damaged");
    assert!(place.batch(RESUMED).failed_earlier(&place.recording));

    let place = Place::new();
    let batch = place.batch(RESUMED);
    let refused = batch.end(place.begun(&batch), &run(), &Err(Error::usage("no camera"))).unwrap();
    assert_eq!((refused, place.error(&batch).as_str()), (Next::Finished, "no camera"));
}

#[test]
fn other_results_are_not_overwritten() {
    let place = Place::new();
    fs::create_dir_all(place.results().join("day/drive")).unwrap();
    fs::write(place.results().join("day/drive/stats.json"), "own").unwrap();
    let refused = |options| place.batch(options).turn(&place.recording).unwrap_err().to_string();
    assert!(refused(RESUMED).contains("stats.json is already there"), "{}", refused(RESUMED));
    let batch = place.batch(BatchOptions { overwrites: true, ..RESUMED });
    place.done(&batch, place.begun(&batch));
    assert_eq!(place.published().as_deref(), Some("1"));
    assert!(refused(BatchOptions::default()).contains("has results; --resume keeps those that are done"));

    // Of another recording of that name, with other content.
    let other = place.folder.path().join("other.mp4");
    fs::write(&other, "other frames").unwrap();
    let recording = Recording { source: other.display().to_string(), ..place.recording.clone() };
    let refused = place.batch(RESUMED).turn(&recording).unwrap_err().to_string();
    assert!(refused.contains("has the results of") && refused.contains("drive.mp4"), "{refused}");
    // The same recording may have moved.
    fs::copy(&place.recording.source, &other).unwrap();
    assert!(matches!(place.batch(RESUMED).turn(&recording).unwrap(), Turn::Ended(_)));
}
