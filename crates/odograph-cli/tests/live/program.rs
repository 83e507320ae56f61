//! The program in a temporary folder, and the bundled drive.

use odograph_video::{SourceOptions, jpeg_from_gray};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use tempfile::TempDir;

/// The bundled drive with its camera and rig.
pub const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/demo");

pub struct LiveFolder {
    temporary: TempDir,
}

impl LiveFolder {
    pub fn new() -> Self {
        Self { temporary: tempfile::tempdir().unwrap() }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.temporary.path().join(name)
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// The table of a run through a hall, with `frames` frames at 30 per second, at 0.5 m/s.
    pub fn table_of(&self, frames: usize) -> String {
        let head = "frame,time_s,x_m,y_m,heading_deg,sigma_x_m,sigma_y_m,sigma_heading_deg,speed_m_s,segment,tracks,inliers,status\n";
        let line = |frame: usize| {
            let time_s = frame as f64 / 30.0;
            // Parallel lanes of 20 m, 1 m apart, in alternating directions.
            let way_m = 0.5 * time_s;
            let (lane, along) = ((way_m / 20.0).floor(), way_m % 20.0);
            let x_m = if lane % 2.0 == 0.0 { along } else { 20.0 - along } + 0.01 * (7.0 * time_s).sin();
            format!("{frame},{time_s:.3},{x_m:.4},{:.4},0,0.01,0.01,0.1,0.5,0,300,280,tracked\n", lane % 20.0)
        };
        head.to_owned() + &(0..frames).map(line).collect::<String>()
    }

    /// A command of the program, with the drive's camera and rig.
    pub fn command(&self, name: &str, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
        command.current_dir(self.temporary.path()).env("ODOGRAPH_FFMPEG", "").stdin(Stdio::null());
        command.arg(name).args(arguments.split_whitespace());
        if name != "view" {
            command.args(["--camera", &format!("{DEMO}/camera.yaml"), "--rig", &format!("{DEMO}/rig.toml")]);
        }
        command
    }

    /// The same with a page, on a free port.
    pub fn server(&self, name: &str, arguments: &str) -> ServingProgram {
        let arguments = format!("{arguments} --serve 127.0.0.1:0");
        let mut command = self.command(name, &arguments);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut message = BufReader::new(child.stderr.take().unwrap());
        let mut line = String::new();
        while !line.contains("look at http://") {
            line.clear();
            assert!(message.read_line(&mut line).unwrap() > 0, "the program ended before it had a page");
        }
        let url = line.split_whitespace().find(|word| word.starts_with("http://")).unwrap().to_owned();
        std::thread::spawn(move || message.lines().for_each(drop));
        ServingProgram { child, url }
    }
}

/// A running program that serves a page.
pub struct ServingProgram {
    child: Child,
    pub url: String,
}

impl ServingProgram {
    pub fn output(&mut self) -> ChildStdout {
        self.child.stdout.take().unwrap()
    }

    pub fn address(&self) -> String {
        self.url.trim_start_matches("http://").split('/').next().unwrap().to_owned()
    }

    /// The body of a response, which must be text.
    pub fn get(&self, path: &str) -> String {
        let body = self.answer(path).unwrap_or_else(|head| panic!("{path}: {head}"));
        String::from_utf8(body).unwrap()
    }

    /// The body of a response; the error is the header section of a failed one.
    pub fn answer(&self, path: &str) -> Result<Vec<u8>, String> {
        let mut stream = TcpStream::connect(self.address()).unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
        let head = String::from_utf8_lossy(&answer[..end]).into_owned();
        if head.starts_with("HTTP/1.1 200") { Ok(answer.split_off(end + 4)) } else { Err(head) }
    }

    /// Asks the program to end, and waits for it.
    pub fn end(&mut self) {
        let asked = Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status();
        if !asked.is_ok_and(|status| status.success()) {
            let _ = self.child.kill();
        }
        let _ = self.child.wait();
    }
}

impl Drop for ServingProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The file names in a folder.
pub fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// The content of `stats.json`.
pub fn statistics(folder: &Path) -> Value {
    serde_json::from_slice(&fs::read(folder.join("stats.json")).unwrap()).unwrap()
}

/// The first seconds of the drive.
fn beginning(every: u64) -> odograph_video::Source {
    let options = SourceOptions { end_s: Some(4.0), every, ..SourceOptions::default() };
    odograph_video::open(format!("{DEMO}/drive.mp4"), &options).unwrap()
}

/// Every second frame of the drive's first seconds as JPEG.
pub fn pictures() -> Vec<Vec<u8>> {
    let mut source = beginning(2);
    let mut pictures = Vec::new();
    while let Some(frame) = source.next_frame().unwrap() {
        pictures.push(jpeg_from_gray(&frame.gray, 90).unwrap());
    }
    pictures
}

/// The first seconds of the drive without compression, which can be read faster than tracked.
pub fn write_uncompressed(path: &Path) {
    let mut file = fs::File::create(path).unwrap();
    file.write_all(b"YUV4MPEG2 W640 H480 F30:1 Cmono\n").unwrap();
    let mut source = beginning(1);
    while let Some(frame) = source.next_frame().unwrap() {
        file.write_all(b"FRAME\n").unwrap();
        file.write_all(frame.gray.samples()).unwrap();
    }
}
