//! What the documents tell people to type is what the program does: every command in the `console`
//! blocks of README.md and docs is run, in a folder that has small recordings of the names that
//! the documents use.
//!
//! ```console
//! $ cargo test --release -p odograph-cli --test commands documents -- --ignored --nocapture
//! ```

use super::bags;
use super::calibrate::boards;
use super::program::done;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use odograph::camera::Rig;
use odograph::formats::camera_file;
use odograph::geometry::{EarthPosition, GroundPose};
use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

/// Commands that are not run: how they begin, or a word in them, and why.
const NOT_RUN: [(&str, &str); 27] = [
    ("cargo ", "builds from source; the tests, the gate and the harness of kills are run by CI"),
    ("bash .ci/run", "is CI itself"),
    ("crates/odograph-ros2/tests/run ", "needs Cyclone DDS; .ci/run does it where asked"),
    ("ros2:/", "needs a robot with ROS 2; crates/odograph-ros2 has its own tests"),
    ("ros2 run ", "needs an installation of ROS 2"),
    ("ros2 service ", "needs an installation of ROS 2"),
    ("ros2 param ", "needs an installation of ROS 2"),
    ("ros2 launch ", "needs an installation of ROS 2"),
    ("podman ", "needs a container engine, and the images that it begins with"),
    ("pip ", "needs the index of Python's packages"),
    ("maturin ", "needs Python; CI builds the package"),
    ("python", "compares with other programs, which it needs"),
    ("cd ", "belongs to what follows it"),
    ("rustup ", "installs a toolchain"),
    ("export ", "belongs to what follows it"),
    ("qemu-aarch64 ", "needs an emulator"),
    ("/dev/video0", "needs a camera at this machine"),
    ("http://192.168.1.20:8080/", "needs a camera on the network"),
    ("drive.bag", "needs the recording of a robot with ROS 1"),
    ("board.mcap", "needs a robot's recording of a board"),
    ("charuco:12x9:40mm", "its pictures have the name of those of another board"),
    ("--tls-key", "needs a certificate, and a program that is built with TLS"),
    ("--gnss-start", "needs the log of a receiver"),
    ("DJI_0001.SRT", "needs the recording of a drone"),
    ("--gnss stills/", "needs the pictures of a drone"),
    ("floor*.jpg --board chessboard:9x6:40mm", "its pictures have the name of those of another board"),
    ("odograph demo", "CI runs it, and it is the only one that takes a minute"),
];

/// A command in a document.
#[derive(Debug)]
struct ShownCommand {
    document: PathBuf,
    line: usize,
    command: String,
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The commands in the `console` and `sh` blocks of a document, in order.
fn shown_in(document: &Path, text: &str) -> Vec<ShownCommand> {
    let (mut commands, mut inside) = (Vec::<ShownCommand>::new(), false);
    let mut goes_on = false;
    for (index, line) in text.lines().enumerate() {
        if let Some(kind) = line.strip_prefix("```") {
            inside = ["console", "sh", "bash"].contains(&kind);
            continue;
        }
        let (begins, rest) = match line.strip_prefix("$ ") {
            Some(rest) => (true, rest),
            None => (false, line),
        };
        if !inside || !(begins || goes_on) {
            continue;
        }
        goes_on = rest.ends_with('\\');
        let part = rest.trim_end_matches('\\');
        match commands.last_mut().filter(|_| !begins) {
            Some(last) => last.command += part,
            None => commands.push(ShownCommand {
                document: document.to_owned(),
                line: index + 1,
                command: part.to_owned(),
            }),
        }
    }
    commands
}

fn shown() -> Vec<ShownCommand> {
    let mut documents = vec![root().join("README.md"), root().join("CONTRIBUTING.md")];
    let folders = ["docs", "docs/tutorials"].map(|folder| fs::read_dir(root().join(folder)).unwrap());
    let docs = folders.into_iter().flatten().map(|entry| entry.unwrap().path());
    documents.extend(docs.filter(|path| path.extension().is_some_and(|ending| ending == "md")));
    documents.sort();
    documents.iter().flat_map(|path| shown_in(path, &fs::read_to_string(path).unwrap())).collect()
}

fn why_not_run(command: &str) -> Option<&'static str> {
    let is_meant = |part: &str| {
        let is_within = part.starts_with(['/', '-']) || part.contains(['.', ':', '*']);
        if is_within { command.contains(part) } else { command.starts_with(part) }
    };
    NOT_RUN.iter().find(|(part, _)| is_meant(part)).map(|(_, why)| *why)
}

/// Targets of the links in a document that are files of the project.
fn linked_files(text: &str) -> Vec<&str> {
    let targets = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let files = targets.map(|target| target.split('#').next().unwrap_or_default());
    files.filter(|target| !target.is_empty() && !target.contains("://")).collect()
}

#[test]
fn the_table_of_contents_lists_every_document_once() {
    let docs = root().join("docs");
    let contents = fs::read_to_string(docs.join("README.md")).unwrap();
    let listed = linked_files(&contents);
    for folder in ["", "tutorials/"] {
        for entry in fs::read_dir(docs.join(folder)).unwrap() {
            let name = format!("{folder}{}", entry.unwrap().file_name().to_string_lossy());
            if name.ends_with(".md") && name != "README.md" {
                let times = listed.iter().filter(|listed| **listed == name).count();
                assert_eq!(times, 1, "{name} in docs/README.md");
            }
        }
    }
    for document in ["docs/README.md", "docs/tutorials/agv.md", "docs/tutorials/mower.md"]
        .into_iter()
        .chain(["docs/tutorials/drone.md", "docs/tutorials/phone.md", "docs/tutorials/stage.md"])
    {
        let path = root().join(document);
        for link in linked_files(&fs::read_to_string(&path).unwrap()) {
            assert!(path.parent().unwrap().join(link).exists(), "{document} links to {link}");
        }
    }
}

#[test]
fn commands_are_found_in_documents() {
    let text = "```console\n$ odograph info a   # what\nnote: this\n$ odograph run b \\\n    -o c\n```\n$ no\n```rust\n$ no\n```";
    let found = shown_in(Path::new("a.md"), text);
    let found: Vec<_> = found.iter().map(|shown| (shown.line, shown.command.as_str())).collect();
    assert_eq!(found, [(2, "odograph info a   # what"), (4, "odograph run b     -o c")]);
    let all = shown();
    let run = all.iter().filter(|shown| why_not_run(&shown.command).is_none());
    assert!(run.clone().count() > 50, "{}", run.count());
    for shown in run {
        assert!(shown.command.starts_with("odograph "), "{shown:?} is neither run nor listed");
    }
    for (part, why) in NOT_RUN {
        assert!(all.iter().any(|shown| why_not_run(&shown.command) == Some(why)), "{part} stands nowhere");
    }
}

/// Writes a folder of what the documents presuppose.
fn write_inputs(folder: &Path) {
    let drive = "--path eight --length 2.5 --speed 0.7 --fps 15 --size 320x240 --height 0.75 --pitch 3 --seed 6 \
                 --markers apriltag:36h11:80mm:0.5 --quiet";
    done(folder, &format!("simulate -o simulated {drive} --sensors --format mjpeg"));
    done(folder, &format!("simulate -o photograph {drive} --duration 0.1"));
    fs::copy(folder.join("photograph/frames/000000.png"), folder.join("photo.jpg")).unwrap();
    let simulated = folder.join("simulated");
    for (from, to) in [
        ("camera.yaml", "camera.yaml"),
        ("camera.yaml", "phone.yaml"),
        ("camera.yaml", "b.yaml"),
        ("rig.toml", "rig.toml"),
        ("truth.tum", "truth.tum"),
        ("gyro.csv", "gyro.csv"),
        ("wheel.csv", "wheel.csv"),
        ("markers.csv", "hall.csv"),
        ("sim.avi", "drive.mp4"),
        ("sim.avi", "monday.mp4"),
        ("sim.avi", "tuesday.mp4"),
        ("sim.avi", "yard.mp4"),
    ] {
        fs::copy(simulated.join(from), folder.join(to)).unwrap();
    }
    fs::create_dir(folder.join("recordings")).unwrap();
    fs::copy(simulated.join("sim.avi"), folder.join("recordings/monday.avi")).unwrap();
    fs::remove_dir_all(simulated).unwrap();
    let camera = camera_file::parse(&fs::read_to_string(folder.join("camera.yaml")).unwrap(), None).unwrap();
    let scene = boards::scene_of("chessboard:9x6:25mm", &camera);
    let held = boards::pictures(&scene, 24);
    fs::write(folder.join("board.mp4"), boards::y4m(&boards::held(&held, 5))).unwrap();
    boards::folder(&folder.join("pictures"), &held);
    for (number, name) in ["floor.jpg", "floor2.jpg", "floor3.jpg"].iter().enumerate() {
        boards::write_png(&folder.join(name), &boards::picture(&scene, &on_the_floor(number)));
    }
    let fixes: Vec<_> =
        (0..40).map(|number| EarthPosition::from_degrees(48.2 + 1e-7 * f64::from(number), 16.3)).collect();
    bags::write_robot(&folder.join("drive.mcap"), &["/front/image_raw"], &[], &fixes);
    write_fixes(folder);
    done(folder, "run drive.mp4 --camera camera.yaml --height 0.75 -o monday -q");
    fs::create_dir(folder.join("odograph-demo")).unwrap();
    copy(&folder.join("monday"), &folder.join("odograph-demo"));
}

/// A camera above a board on the floor.
fn on_the_floor(number: usize) -> Isometry3<f64> {
    let first = Rig::level(0.5).first_pose();
    let above = GroundPose { x_m: 0.1, y_m: -0.06 - 0.01 * number as f64, ..first };
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    above.world_from_camera().inverse() * Isometry3::from_parts(Translation3::identity(), half_turn)
}

/// A satellite receiver that stands where the truth is.
fn write_fixes(folder: &Path) {
    let truth = fs::read_to_string(folder.join("truth.tum")).unwrap();
    let mut text = String::from("time_s,latitude_deg,longitude_deg,sigma_m\n");
    for line in truth.lines().filter(|line| !line.starts_with('#')).step_by(5) {
        let [time_s, x_m, y_m] = [0, 1, 2].map(|at| line.split(' ').nth(at).unwrap().parse::<f64>().unwrap());
        let (north, east) = (y_m / 111_195.0, x_m / 74_000.0);
        text += &format!("{time_s},{:.9},{:.9},0.02\n", 48.2 + north, 16.3 + east);
    }
    fs::write(folder.join("fixes.csv"), text).unwrap();
}

/// What ends when it is interrupted.
fn is_server(command: &str) -> bool {
    command.contains(" --serve") || command.contains(" view ") || command.contains(" site serve ")
}

/// A shell in a folder in which `odograph` is this program.
fn shell(folder: &Path, command: &str) -> Command {
    let path = format!("{}:{}", folder.join(".bin").display(), std::env::var("PATH").unwrap());
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("exec {command}")]).current_dir(folder).env("PATH", path);
    shell.env("XDG_CONFIG_HOME", folder.join(".config")).env("ODOGRAPH_FFMPEG", "").stdin(Stdio::null());
    shell
}

/// Starts a server; returns the address that it prints as well.
fn served(folder: &Path, command: &str) -> (Child, String) {
    let mut child = shell(folder, command).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
    let address = lines.find_map(|line| {
        let from = line.find("http://")?;
        Some(line[from..].split([' ', ';', ',']).next()?.to_owned())
    });
    std::thread::spawn(move || lines.for_each(drop));
    (child, address.unwrap_or_default())
}

fn interrupted(mut child: Child) -> Option<i32> {
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    child.wait().unwrap().code()
}

/// Removes what `-o` of a command names, its pictures and its report: documents show alternatives
/// that write the same.
fn remove_output(folder: &Path, command: &str) {
    let mut words = command.split(" #").next().unwrap_or_default().split_whitespace();
    while let Some(word) = words.next() {
        if word == "-o" || word == "--output" {
            let output = folder.join(words.next().unwrap());
            let stem = output.file_stem().unwrap().display();
            let pictures = ["png", "pgm"].map(|ending| output.with_extension(ending));
            let report = output.with_file_name(format!("{stem}-report"));
            for written in [&output, &pictures[0], &pictures[1], &report] {
                let _ = fs::remove_file(written);
                let _ = fs::remove_dir_all(written);
            }
        }
    }
}

/// The recordings that the reader of the guide for newcomers has made.
const BROUGHT: [&str; 8] = [
    "board.mp4",
    "floor*.jpg",
    "drive.mp4",
    "monday.mp4",
    "tuesday.mp4",
    "yard.mp4",
    "photo.jpg",
    "truth.tum",
];

/// The commands of the guide for newcomers, without comments, that this program runs.
fn guide() -> Vec<String> {
    let path = root().join("docs/getting-started.md");
    let shown = shown_in(&path, &fs::read_to_string(&path).unwrap());
    let commands = shown.into_iter().map(|shown| shown.command.split(" #").next().unwrap().trim().to_owned());
    commands.filter(|command| command.starts_with("odograph ")).collect()
}

#[test]
fn the_guide_for_newcomers_reads_what_it_has_written() {
    let mut written: Vec<String> = Vec::new();
    for command in guide() {
        let mut words = command.split(' ').filter(|word| !word.is_empty()).skip(1).peekable();
        let mut outputs = Vec::new();
        while let Some(word) = words.next() {
            if word == "-o" {
                outputs.push(words.next().unwrap().trim_end_matches('/').to_owned());
                continue;
            }
            let ending = word.rsplit_once('.').map_or("", |(_, ending)| ending);
            let is_file = ["mp4", "jpg", "yaml", "toml", "gpkg", "tum", "txt"].contains(&ending)
                || word.contains('/')
                || word == "odograph-demo";
            let is_there = |folder: &String| word == folder || word.starts_with(&format!("{folder}/"));
            assert!(
                !is_file
                    || word.starts_with("/dev/")
                    || BROUGHT.contains(&word)
                    || written.iter().any(is_there),
                "{command}: nothing before it writes {word}"
            );
        }
        for output in outputs {
            assert!(!written.contains(&output), "{command}: a command before it writes {output}");
            written.push(output);
        }
        if command == "odograph demo" {
            written.push("odograph-demo".to_owned());
        }
    }
    assert!(written.len() > 10, "{written:?}");
}

#[test]
#[ignore = "minutes; before a release"]
fn the_guide_for_newcomers_works_as_written() {
    let (inputs, place) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write_inputs(inputs.path());
    let folder = place.path();
    for entry in fs::read_dir(inputs.path()).unwrap().map(|entry| entry.unwrap().path()) {
        let name = entry.file_name().unwrap().to_str().unwrap();
        let is_floor = name.starts_with("floor") && name.ends_with(".jpg");
        if is_floor || BROUGHT.contains(&name) {
            fs::copy(&entry, folder.join(name)).unwrap();
        }
    }
    fs::create_dir(folder.join(".bin")).unwrap();
    symlink(env!("CARGO_BIN_EXE_odograph"), folder.join(".bin/odograph")).unwrap();
    for command in guide().iter().filter(|command| !command.contains("/dev/video0")) {
        println!("{command}");
        if is_server(command) {
            let (child, address) = served(folder, &command.replace("--serve", "--serve 127.0.0.1:0"));
            assert!(!address.is_empty(), "{command}");
            assert!(matches!(interrupted(child), Some(0 | 130)), "{command}");
        } else {
            let Output { status, stderr, .. } = shell(folder, command).output().unwrap();
            assert!(status.success(), "{command}: {}", String::from_utf8_lossy(&stderr));
        }
    }
}

#[test]
#[ignore = "minutes; before a release"]
fn every_command_of_the_documents_works() {
    let inputs = tempfile::tempdir().unwrap();
    write_inputs(inputs.path());
    let mut failed = String::new();
    let all = shown();
    for of_document in all.chunk_by(|a, b| a.document == b.document) {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path();
        copy(inputs.path(), folder);
        fs::create_dir(folder.join(".bin")).unwrap();
        symlink(env!("CARGO_BIN_EXE_odograph"), folder.join(".bin/odograph")).unwrap();
        // One document makes the profile that others use.
        let profile = "odograph profile save cart --camera camera.yaml --rig rig.toml";
        if !of_document.iter().any(|shown| shown.command.starts_with(profile)) {
            assert!(shell(folder, profile).status().unwrap().success());
        }
        let mut site: Option<(Child, String)> = None;
        for ShownCommand { document, line, command } in of_document {
            let place = format!("{}:{line}", document.file_name().unwrap().display());
            if let Some(why) = why_not_run(command) {
                println!("{place}: not run, {why}: {command}");
                continue;
            }
            let mut command = command.replace("--serve", "--serve 127.0.0.1:0");
            if let Some((_, address)) = &site {
                command = command
                    .replace("http://127.0.0.1:8137/", address)
                    .replace("--site URL", &format!("--site {address}"));
            }
            remove_output(folder, &command);
            println!("{place}: {command}");
            let code = if command.contains(" site serve ") {
                site = Some(served(folder, &command.replace("hall/", "hall/ --listen 127.0.0.1:0")));
                continue;
            } else if is_server(&command) {
                let (child, address) = served(folder, &command);
                assert!(!address.is_empty(), "{command}");
                // A live run that was interrupted says so.
                interrupted(child).map(|code| if code == 130 { 0 } else { code })
            } else {
                let Output { status, stderr, .. } = shell(folder, &command).output().unwrap();
                print!("{}", String::from_utf8_lossy(&stderr));
                status.code()
            };
            if code != Some(0) {
                failed += &format!("\n{place}: {command}: {code:?}");
            }
        }
        if let Some((child, _)) = site {
            assert_eq!(interrupted(child), Some(0));
        }
    }
    assert!(failed.is_empty(), "{failed}");
}

fn copy(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let there = to.join(path.file_name().unwrap());
        if path.is_dir() {
            fs::create_dir(&there).unwrap();
            copy(&path, &there);
        } else {
            fs::copy(&path, &there).unwrap();
        }
    }
}
