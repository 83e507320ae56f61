//! The page that tracks in a browser, without the program (`docs/try`), beside a run of it.

use super::browser::{Browser, Tab};
use super::program::{DEMO, LiveFolder, write_uncompressed};
use serde_json::json;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Serves the files of a folder at a free port; returns the address.
fn serve(folder: PathBuf) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}/", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for stream in listener.incoming().map_while(Result::ok) {
            let folder = folder.clone();
            std::thread::spawn(move || answer(&folder, stream));
        }
    });
    address
}

/// Answers one request for a file. A browser that ends meanwhile is no failure.
fn answer(folder: &Path, mut stream: TcpStream) -> Option<()> {
    let mut lines = BufReader::new(stream.try_clone().ok()?).lines();
    let first = lines.next()?.ok()?;
    lines.map_while(Result::ok).find(String::is_empty)?;
    let name = first.split(' ').nth(1)?.trim_start_matches('/');
    let name = if name.is_empty() { "index.html" } else { name };
    let kind = match Path::new(name).extension()?.to_str()? {
        "html" => "text/html",
        "js" => "text/javascript",
        "css" => "text/css",
        "svg" => "image/svg+xml",
        "wasm" => "application/wasm",
        _ => "application/octet-stream",
    };
    let (status, body) = match fs::read(folder.join(name)) {
        Ok(body) => ("200 OK", body),
        Err(_) => ("404 Not Found", Vec::new()),
    };
    let length = body.len();
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
    );
    stream.write_all(head.as_bytes()).ok()?;
    stream.write_all(&body).ok()
}

/// Waits until the drive is finished, however long, as long as frames are tracked.
fn finish(browser: &mut Browser, page: &Tab) {
    browser.wait(page, "document.body.dataset.phase !== 'setup'");
    loop {
        let state = "document.body.dataset.phase + (document.body.dataset.records || 0)";
        let before = browser.evaluate(page, state);
        browser.wait(page, &format!("document.body.dataset.phase === 'finished' || {state} !== {before}"));
        if browser.evaluate(page, "document.body.dataset.phase") == json!("finished") {
            return;
        }
    }
}

/// Position of every line of a trajectory in TUM format.
fn positions(text: &str) -> Vec<[f64; 4]> {
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let number = |line: &str, column: usize| line.split(' ').nth(column).unwrap().parse::<f64>().unwrap();
    lines.map(|line| [0, 1, 2, 3].map(|column| number(line, column))).collect()
}

/// Largest differences at the end and on the way, metres. Sine and cosine of two platforms differ
/// in their last digits, and iterations then end differently: positions were up to 3.2 µm apart, at
/// the end 0.1 µm.
const AT_THE_END_M: f64 = 1e-6;
const ON_THE_WAY_M: f64 = 1e-5;

/// The two have the same times and positions.
fn assert_same(page: &str, run: &str) {
    let (page, run) = (positions(page), positions(run));
    assert_eq!(page.len(), run.len());
    for (number, (a, b)) in page.iter().zip(&run).enumerate() {
        assert_eq!(a[0], b[0]);
        let apart_m = (1..4).map(|k| (a[k] - b[k]).abs()).fold(0.0, f64::max);
        let most_m = if number + 1 == page.len() { AT_THE_END_M } else { ON_THE_WAY_M };
        assert!(apart_m < most_m, "{apart_m} m at {} s", a[0]);
    }
}

#[test]
fn the_page_tracks_as_the_program_does_and_asks_for_nothing_else() {
    let Some(folder) = std::env::var_os("ODOGRAPH_PAGE").map(PathBuf::from) else {
        println!("skipped: wasm: ODOGRAPH_PAGE names no folder that docs/try/build.sh has made");
        return;
    };
    let mut browser = match Browser::start() {
        Ok(browser) => browser,
        Err(why) => {
            println!("skipped: chromium: {why}");
            return;
        }
    };
    let place = LiveFolder::new();
    let address = serve(folder);
    browser.download_into(&place.path(""));
    let page = browser.tab((1280, 800), false);
    browser.listen(&page);
    browser.go(&page, &address);
    browser.wait(&page, "document.body.dataset.ready");
    browser.picture(&page, "try-setup");
    // Nothing was chosen yet: it says so and does not start.
    browser.evaluate(&page, "document.getElementById('start').click()");
    browser.wait(&page, "document.getElementById('message').textContent === 'Choose a video.'");

    // The sample: MP4, decoded by the browser, with a rig file.
    browser.evaluate(&page, "document.getElementById('sample').click()");
    finish(&mut browser, &page);
    browser.picture(&page, "try-finished");
    let download = |browser: &mut Browser, name: &str| {
        browser.evaluate(&page, &format!("document.querySelector('[download=\"{name}\"]').click()"));
        let path = place.path(name);
        browser.wait(&page, "document.body.dataset.phase === 'finished'");
        let until = std::time::Instant::now() + std::time::Duration::from_secs(30);
        while !path.exists() {
            assert!(std::time::Instant::now() < until, "{name} was not downloaded");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        let bytes = place.read(name);
        fs::remove_file(path).unwrap();
        bytes
    };
    let path = String::from_utf8(download(&mut browser, "trajectory.tum")).unwrap();
    assert!(download(&mut browser, "mosaic.png").starts_with(b"\x89PNG"));
    let run = place.command("run", &format!("{DEMO}/drive.mp4 -o sample --quiet")).status().unwrap();
    assert!(run.success());
    assert_same(&path, &String::from_utf8(place.read("sample/trajectory.tum")).unwrap());

    // A video of one's own: Y4M, with a camera file and a height. The tilt is found, and the video
    // tracked again.
    write_uncompressed(&place.path("drive.y4m"));
    browser.evaluate(&page, "document.getElementById('again').click()");
    browser.choose_file(&page, "#video", &place.path("drive.y4m"));
    browser.choose_file(&page, "#camera-file", &Path::new(DEMO).join("camera.yaml"));
    browser.evaluate(&page, "document.getElementById('height').value = '90cm'");
    browser.evaluate(&page, "document.getElementById('start').click()");
    finish(&mut browser, &page);
    let outcome = browser.evaluate(&page, "document.getElementById('outcome').textContent");
    assert!(outcome.as_str().unwrap().contains("The camera is tilted"), "{outcome}");
    let path = String::from_utf8(download(&mut browser, "trajectory.tum")).unwrap();
    let run = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .current_dir(place.path(""))
        .args(["run", "drive.y4m", "--camera", &format!("{DEMO}/camera.yaml"), "--height", "90cm"])
        .args(["-o", "own", "--quiet"])
        .stdin(Stdio::null())
        .status()
        .unwrap();
    assert!(run.success());
    assert_same(&path, &String::from_utf8(place.read("own/trajectory.tum")).unwrap());

    assert_eq!(browser.complaints(), [""; 0]);
    let elsewhere: Vec<String> = browser
        .requests()
        .into_iter()
        .filter(|url| !url.starts_with(&address) && !url.starts_with(&format!("blob:{address}")))
        .collect();
    assert!(elsewhere.is_empty(), "{elsewhere:?}");
}
