//! Many recordings with several workers: the same bytes as in separate runs, whoever is killed.

use crate::program::{done, odograph};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A folder with four recordings in `recordings`, one of them damaged, and their single runs in
/// `alone`.
struct Place(TempDir);

/// The recordings that can be followed.
const GOOD: [&str; 3] = ["hall/one", "hall/two", "three"];

/// The options of every run.
const SETUP: &str = "--camera one/camera.yaml --rig one/rig.toml";

impl Place {
    fn new() -> Self {
        let place = tempfile::tempdir().unwrap();
        let here = place.path();
        fs::create_dir_all(here.join("recordings/hall")).unwrap();
        for (seed, name) in [("one", "hall/one"), ("two", "hall/two"), ("three", "three")].iter().enumerate()
        {
            let (folder, name) = name;
            done(
                here,
                &format!(
                    "simulate -o {folder} --format y4m --path straight --length 0.5 --duration 1 --fps 20 \
                     --size 240x180 --height 0.75 --seed {seed} --quiet"
                ),
            );
            fs::rename(here.join(folder).join("sim.y4m"), here.join(format!("recordings/{name}.y4m")))
                .unwrap();
            done(here, &format!("run recordings/{name}.y4m {SETUP} -o alone/{name} --threads 1 --quiet"));
        }
        fs::write(here.join("recordings/damaged.mp4"), b"no video").unwrap();
        Self(place)
    }

    fn here(&self) -> &Path {
        self.0.path()
    }

    /// A worker over all recordings.
    fn worker(&self, more: &str) -> Child {
        let arguments = format!("run recordings {SETUP} -o all --threads 1 {more}");
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(self.here()).args(arguments.split_whitespace());
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }

    /// Waits for a worker. Returns its exit code and messages.
    fn ended(worker: Child) -> (Option<i32>, String) {
        let output = worker.wait_with_output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    }

    /// Folders of attempts.
    fn parts(&self) -> Vec<PathBuf> {
        let inside = |folder: &str| fs::read_dir(self.here().join(folder)).into_iter().flatten().flatten();
        let all = inside("all").chain(inside("all/hall")).map(|entry| entry.path());
        all.filter(|path| path.to_string_lossy().contains(".part-")).collect()
    }

    /// A column of the table, by recording.
    fn column(&self, name: &str) -> Vec<(String, String)> {
        let table = fs::read_to_string(self.here().join("all/results.csv")).unwrap();
        let mut lines = table.lines().map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
        let column = lines.next().unwrap().iter().position(|cell| cell == name).unwrap();
        lines.map(|cells| (cells[0].clone(), cells[column].clone())).collect()
    }

    /// Checks that the good recordings have the bytes of their single runs, and that the damaged
    /// one is in the table with the reason.
    fn check(&self) {
        for name in GOOD {
            for file in
                ["trajectory.csv", "trajectory.tum", "mosaic.png", "map.svg", "report.html", "run.toml"]
            {
                let read = |folder: &str| fs::read(self.here().join(folder).join(name).join(file)).unwrap();
                assert!(read("alone") == read("all"), "{name}/{file} differs");
            }
        }
        let status = |name: &str| {
            let column = self.column("status");
            column.into_iter().find(|(recording, _)| recording == name).map(|(_, status)| status)
        };
        for name in GOOD {
            assert_eq!(status(name).as_deref(), Some("done"), "{name}");
        }
        assert_eq!(status("damaged").as_deref(), Some("failed"));
        let error = self.column("error").into_iter().find(|(name, _)| name == "damaged").unwrap().1;
        assert!(error.contains("damaged.mp4"), "{error}");
        let page = fs::read_to_string(self.here().join("all/results.html")).unwrap();
        assert!(page.contains("<b>3 of 4 recordings</b> were run. One failed."), "{page}");
        assert_eq!(self.parts(), Vec::<PathBuf>::new());
    }
}

#[test]
fn two_workers_share_the_recordings_of_a_folder() {
    let place = Place::new();
    let workers = [place.worker("--resume"), place.worker("--resume")];
    for (code, message) in workers.map(Place::ended) {
        assert_eq!(code, Some(3), "{message}");
        assert!(
            message.contains("damaged.mp4") && message.contains("1 of 4 recordings could not be"),
            "{message}"
        );
        assert!(message.contains(" of 4 recordings done"), "{message}");
    }
    place.check();
    let attempts = || -> Vec<(String, String)> {
        place.column("attempts").into_iter().filter(|(name, _)| name != "damaged").collect()
    };
    assert!(attempts().iter().all(|(_, attempts)| attempts == "1"), "{:?}", attempts());

    // What is done is skipped, unless recording or options have changed.
    fs::remove_file(place.here().join("recordings/damaged.mp4")).unwrap();
    let again = |more: &str| {
        let output = odograph(place.here(), &format!("run recordings {SETUP} -o all --resume {more}"));
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    assert_eq!(again("").matches("run before").count(), 3);
    fs::copy(place.here().join("recordings/three.y4m"), place.here().join("recordings/hall/two.y4m"))
        .unwrap();
    assert_eq!(again("").matches("run before").count(), 2);
    assert_eq!(again("--no-loops").matches("run before").count(), 0);
    let numbers: Vec<String> = attempts().into_iter().map(|(_, number)| number).collect();
    assert_eq!(numbers, ["2", "3", "2"]);

    // Without --resume, results are not overwritten.
    let refused = odograph(place.here(), &format!("run recordings {SETUP} -o all"));
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("all/three has results; --resume keeps"));
}

#[test]
#[cfg(target_os = "linux")] // elsewhere a killed worker is noticed after two minutes
fn the_work_of_killed_workers_is_finished() {
    let place = Place::new();
    // Each is killed a little later in its work than the one before.
    for polls in [0, 1, 4, 16, 64] {
        let mut worker = place.worker("--resume --quiet");
        let patience = Instant::now() + Duration::from_secs(120);
        let mut left = polls;
        while worker.try_wait().unwrap().is_none() && Instant::now() < patience {
            left -= i32::from(!place.parts().is_empty());
            if left < 0 {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = worker.kill();
        worker.wait().unwrap();
    }
    let (code, message) = Place::ended(place.worker("--resume"));
    assert_eq!(code, Some(3), "{message}");
    place.check();
}

#[test]
fn shards_have_all_recordings_once() {
    let place = Place::new();
    for number in 0..3 {
        let (code, message) = Place::ended(place.worker(&format!("--shard {number}/3 --retries 0")));
        let is_damaged = message.contains("damaged.mp4");
        assert_eq!(code, Some(if is_damaged { 3 } else { 0 }), "{message}");
        assert!(message.contains(&format!("shard {number}/3: ")), "{message}");
        assert_eq!(place.column("status").len(), 4);
    }
    place.check();
    let mut good = place.column("attempts");
    good.retain(|(name, _)| name != "damaged");
    assert!(good.iter().all(|(_, attempts)| attempts == "1"), "{good:?}");
}

#[test]
fn options_for_several_recordings_say_what_they_need() {
    let place = tempfile::tempdir().unwrap();
    for (arguments, message) in [
        (
            "--resume",
            "--resume needs the folder of a run that was killed, or recordings before it and -o FOLDER",
        ),
        ("a.mp4 --resume", "--resume and --shard need the folder of all results; give -o FOLDER"),
        ("--resume a.mp4 b.mp4 -o out", "to finish several recordings, give --resume after them"),
        ("a.mp4 --retries 1", "--retries is for several recordings; add --resume or --shard"),
        ("a.mp4 -o out --shard 2/2", "2 shards are counted from 0: 0/2 to 1/2"),
        ("a.mp4 -o out --shard 2", "a shard is its number and how many there are, such as 3/64"),
        ("a.mp4 --map m.gpkg -o out --resume", "--map m.gpkg is one map"),
    ] {
        let refused = odograph(place.path(), &format!("run --camera camera.yaml --height 1 {arguments}"));
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(2), "{arguments}: {said}");
        assert!(said.contains(message), "{arguments}: {said}");
    }
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0);
}

/// The first block of code after a heading.
fn block_after<'a>(text: &'a str, heading: &str) -> &'a str {
    let section = text.split_once(&format!("\n## {heading}\n")).unwrap().1;
    let block = section.split_once("\n```").unwrap().1.split_once('\n').unwrap().1;
    block.split_once("\n```").unwrap().0
}

#[test]
#[cfg(target_os = "linux")] // xargs and a shell
fn examples_of_the_guide_work_as_written() {
    let place = Place::new();
    let here = place.here();
    fs::remove_file(here.join("recordings/damaged.mp4")).unwrap();
    fs::copy(here.join("one/camera.yaml"), here.join("camera.yaml")).unwrap();
    let shell = |script: &str, variables: &[(&str, &str)]| {
        let program = Path::new(env!("CARGO_BIN_EXE_odograph")).parent().unwrap();
        let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap());
        let mut command = Command::new("bash");
        command.args(["-c", script]).current_dir(here).env("PATH", path).envs(variables.iter().copied());
        let output = command.output().unwrap();
        assert!(output.status.success(), "{script}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let check = || {
        for name in GOOD {
            assert!(here.join("results").join(name).join("stats.json").is_file(), "{name}");
        }
        fs::remove_dir_all(here.join("results")).unwrap();
    };
    let guide =
        fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/batch.md")).unwrap();

    shell(block_after(&guide, "xargs"), &[]);
    check();

    for task in ["0", "1"] {
        let count = ("SLURM_ARRAY_TASK_COUNT", "2");
        shell(
            block_after(&guide, "Slurm"),
            &[count, ("SLURM_ARRAY_TASK_ID", task), ("SLURM_CPUS_PER_TASK", "1")],
        );
    }
    check();

    // What the cluster puts in: the index of the job.
    let job = block_after(&guide, "Kubernetes");
    let command = job.split_once("command:\n").unwrap().1.lines().map(|line| line.trim().strip_prefix("- "));
    let words: Vec<&str> = command.map_while(|word| word).collect();
    assert_eq!(words.last(), Some(&"--resume"), "{words:?}");
    let command = words.join(" ");
    for index in ["0", "1"] {
        shell(&command.replace("$(JOB_COMPLETION_INDEX)/64", &format!("{index}/2")), &[]);
    }
    check();
}
