//! End-to-end tests of `odograph live` and `odograph view`: on the bundled drive in real time or
//! faster, over HTTP, and with a browser.

// a test fails by panicking, and prints why it is skipped
#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "live/browser.rs"]
mod browser;
#[path = "live/disk.rs"]
mod disk;
#[path = "live/long.rs"]
mod long;
#[path = "live/page_of_its_own.rs"]
mod page_of_its_own;
#[path = "live/program.rs"]
mod program;
#[path = "live/rtsp.rs"]
mod rtsp;
#[path = "live/sensors.rs"]
mod sensors;

use browser::Browser;
use program::{DEMO, LiveFolder, names, pictures, statistics, write_uncompressed};
use serde_json::json;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::process::Stdio;
use std::time::Duration;

/// Length of the whole drive, metres.
const DRIVE_M: f64 = 12.8;

#[test]
fn live_on_a_recording_gives_the_results_of_run() {
    let place = LiveFolder::new();
    write_uncompressed(&place.path("drive.y4m"));
    let live =
        place.command("live", "drive.y4m -o live --print poses --mcap live.mcap --quiet").output().unwrap();
    assert!(live.status.success(), "{}", String::from_utf8_lossy(&live.stderr));
    let run = place.command("run", "drive.y4m -o run --quiet").output().unwrap();
    assert!(run.status.success());
    for name in [
        "trajectory.csv",
        "trajectory.tum",
        "trajectory-smoothed.tum",
        "carrier.tum",
        "mosaic.png",
        "mosaic.pgw",
        "map.svg",
    ] {
        assert!(place.read(&format!("live/{name}")) == place.read(&format!("run/{name}")), "{name} differs");
    }
    assert_eq!(names(&place.path("live")), names(&place.path("run")));
    // One JSON line per frame on standard output; the last one is the end of the trajectory.
    let lines: Vec<serde_json::Value> =
        live.stdout.lines().map(|line| serde_json::from_str(&line.unwrap()).unwrap()).collect();
    let figures = statistics(&place.path("live"));
    assert_eq!(json!(lines.len()), figures["frames"]);
    assert_eq!(
        (&figures["live"]["frames_dropped"], &figures["live"]["frames_captured"]),
        (&json!(0), &figures["frames"])
    );
    let table = String::from_utf8(place.read("live/trajectory.csv")).unwrap();
    let last: Vec<&str> = table.lines().last().unwrap().split(',').collect();
    let x_m = lines.last().unwrap()["pose"]["x_m"].as_f64().unwrap();
    assert!((x_m - last[2].parse::<f64>().unwrap()).abs() < 1e-6);
    // The MCAP file has the same lines, and an image for every third frame (10 of 30 per second).
    let mut topics: BTreeMap<String, Vec<serde_json::Value>> = BTreeMap::new();
    for message in mcap::MessageStream::new(&place.read("live.mcap")).unwrap() {
        let message = message.unwrap();
        let value = serde_json::from_slice(&message.data).unwrap();
        topics.entry(message.channel.topic.clone()).or_default().push(value);
    }
    assert!(topics["/frame"] == lines);
    assert_eq!(topics["/camera"].len(), lines.len().div_ceil(3));
    assert_eq!(topics["/pose"].last().unwrap()["pose"]["position"]["x"], json!(x_m));
    // It is not overwritten without `--force`.
    let again = place.command("live", "drive.y4m -o again --mcap live.mcap").output().unwrap();
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("live.mcap is already there"));
}

#[test]
fn a_map_is_continued_and_the_pose_in_it_is_printed() {
    let place = LiveFolder::new();
    write_uncompressed(&place.path("drive.y4m"));
    let done = |name: &str, arguments: &str| {
        let done = place.command(name, arguments).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        done.stdout
    };
    done("run", "drive.y4m --map hall.gpkg -o monday --quiet");
    let printed = done("live", "drive.y4m --map hall.gpkg -o tuesday --print poses --quiet");
    let lines: Vec<serde_json::Value> =
        printed.lines().map(|line| serde_json::from_str(&line.unwrap()).unwrap()).collect();
    // It begins where the first run did. Both frames are the same to less than a millimetre.
    assert!(lines[0]["map_pose"].is_null());
    // The mapper may be some keyframes behind.
    assert!(!lines.last().unwrap()["map_pose"].is_null());
    for line in lines.iter().filter(|line| !line["map_pose"].is_null()) {
        for axis in ["x_m", "y_m"] {
            let [seen, mapped] = ["pose", "map_pose"].map(|frame| line[frame][axis].as_f64().unwrap());
            assert!((seen - mapped).abs() < 2e-3, "{line}");
        }
    }
    let figures = statistics(&place.path("tuesday"));
    assert!(figures["loops"]["closed"].as_u64().unwrap() >= 2, "{figures}");
    assert!(!place.path("tuesday/map.gpkg").exists());
}

#[test]
fn a_too_fast_source_drops_frames_and_counts_them() {
    let place = LiveFolder::new();
    write_uncompressed(&place.path("drive.y4m"));
    let listener = UdpSocket::bind("127.0.0.1:0").unwrap();
    listener.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let udp = listener.local_addr().unwrap();
    // 1000 times real time: 30,000 frames per second, of which most must be dropped.
    let done = place
        .command("live", &format!("drive.y4m --realtime 1000 --udp {udp} -o out --quiet"))
        .output()
        .unwrap();
    // On a slow machine so many frames are dropped that tracking fails, which the exit code
    // reports.
    assert!(matches!(done.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&done.stderr));
    let figures = statistics(&place.path("out"));
    let live = &figures["live"];
    let count = |value: &serde_json::Value| value.as_u64().unwrap();
    // Each captured frame was tracked or dropped; at the end of the source at most the queue was
    // left.
    assert_eq!(count(&live["frames_captured"]), count(&figures["frames"]) + count(&live["frames_dropped"]));
    assert!(count(&live["frames_dropped"]) > count(&figures["frames"]), "{figures}");
    // Latencies are reported in order; their size depends on the machine. The queue's length limit
    // has its own unit test, and the line above tests that most frames were dropped.
    let [median, p99, most] =
        ["latency_median_ms", "latency_p99_ms", "latency_most_ms"].map(|key| live[key].as_f64().unwrap());
    assert!(0.0 < median && median <= p99 && p99 <= most, "{live}");
    let mut datagram = [0; 4096];
    let length = listener.recv(&mut datagram).unwrap();
    let first: serde_json::Value = serde_json::from_slice(&datagram[..length]).unwrap();
    assert!(first["frame"].is_u64() && first["status"] == json!("tracked"), "{first}");
}

/// A phone: sends the frames over HTTP as fast as they are read, disconnects in the middle, and
/// reconnects.
fn phone(listener: TcpListener, frames: &[Vec<u8>]) {
    let (first, second) = frames.split_at(frames.len() / 2);
    for frames in [first, second] {
        let (stream, _) = listener.accept().unwrap();
        let mut reader = BufReader::new(&stream);
        let mut line = String::from("-");
        while !line.trim().is_empty() {
            line.clear();
            reader.read_line(&mut line).unwrap();
        }
        let head = "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n";
        (&stream).write_all(head.as_bytes()).unwrap();
        for jpeg in frames {
            let head =
                format!("--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", jpeg.len());
            let sent = (&stream)
                .write_all(head.as_bytes())
                .and_then(|()| (&stream).write_all(jpeg))
                .and_then(|()| (&stream).write_all(b"\r\n"));
            if sent.is_err() {
                return;
            }
            // Three times real time, paced by the phone's own clock.
            std::thread::sleep(Duration::from_millis(11));
        }
    }
}

#[test]
fn an_http_camera_is_tracked_across_a_reconnect() {
    let place = LiveFolder::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let frames = pictures();
    let sent = frames.len();
    let server = std::thread::spawn(move || phone(listener, &frames));
    let done = place
        .command("live", &format!("http://{address}/video --patience 1 -o out --quiet"))
        .output()
        .unwrap();
    server.join().unwrap();
    // A camera that does not come back counts as bad input; all results so far are in the folder.
    assert_eq!(done.status.code(), Some(3));
    let message = String::from_utf8_lossy(&done.stderr);
    assert!(message.contains("went away") && message.contains("did not come back within 1 s"), "{message}");
    let figures = statistics(&place.path("out"));
    assert_eq!(figures["live"]["reconnects"], json!(2 - 1), "{figures}");
    // All frames were received over both connections; the number of tracked ones depends on the
    // machine.
    assert_eq!(figures["live"]["frames_captured"], json!(sent), "{figures}");
    let (length_m, posed) =
        (figures["distance_m"].as_f64().unwrap(), figures["frames_with_pose"].as_u64().unwrap());
    assert!(posed > 1 && length_m > 0.0 && length_m < DRIVE_M, "{figures}");
}

#[test]
fn an_rtsp_camera_is_tracked_across_a_reconnect() {
    let place = LiveFolder::new();
    let clip = match rtsp::clip(&place.path("clip.h264")) {
        Ok(clip) => clip,
        Err(why) => {
            println!("skipped: ffmpeg: {why}");
            return;
        }
    };
    let server = rtsp::RtspServer::start(clip);
    let address = server.address();
    let done = place
        .command("live", &format!("rtsp://name:secret@{address}/floor --patience 1 -o out --quiet"))
        .env_remove("ODOGRAPH_FFMPEG")
        .output()
        .unwrap();
    let sent = server.sent();
    // Both times the requests were in the order of the protocol, over TCP.
    assert_eq!(server.asked(), ["OPTIONS", "DESCRIBE", "SETUP", "PLAY"].repeat(2));
    assert_eq!(done.status.code(), Some(3));
    let message = String::from_utf8_lossy(&done.stderr);
    assert!(
        message.contains(&format!("rtsp://{address}/floor went away")) && message.contains("within 1 s"),
        "{message}"
    );
    assert!(!message.contains("secret"), "{message}");
    let figures = statistics(&place.path("out"));
    assert_eq!(figures["live"]["reconnects"], json!(1), "{figures}");
    // Each time ffmpeg spends the first second on probing the stream, and starts with the next
    // keyframe. Of two times three seconds, at least half is received.
    let captured = figures["live"]["frames_captured"].as_u64().unwrap();
    assert!(2 * captured >= sent && captured <= sent, "{captured} of {sent}");
    let length_m = figures["distance_m"].as_f64().unwrap();
    assert!(length_m > 0.0 && length_m < DRIVE_M, "{figures}");
    // The output files do not contain the password either.
    for name in ["run.toml", "report.html", "stats.json"] {
        assert!(!String::from_utf8_lossy(&place.read(&format!("out/{name}"))).contains("secret"), "{name}");
    }
}

#[test]
#[cfg(unix)]
fn a_killed_run_keeps_its_results_and_can_be_viewed() {
    let place = LiveFolder::new();
    let mut program = place
        .command("live", &format!("{DEMO}/drive.mp4 --realtime --print poses -o out"))
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(program.stdout.take().unwrap()).lines();
    // Two seconds of frames were printed; at most the last second of them may be missing.
    let received = lines.by_ref().take(60).count();
    program.kill().unwrap();
    program.wait().unwrap();
    assert_eq!(received, 60);
    let table = String::from_utf8(place.read("out/trajectory.csv.part")).unwrap();
    let kept = table.lines().count() - 1;
    assert!(kept >= 30, "{kept} of 60 frames");
    assert!(place.path("out/run.toml").is_file());
    let mut view = place.server("view", "out");
    let state: serde_json::Value = serde_json::from_str(&view.get("/state")).unwrap();
    assert_eq!((&state["introduction"]["live"], &state["status"]["captured"]), (&json!(false), &json!(kept)));
    assert_eq!(state["introduction"]["recovered"], json!(true));
    view.end();
    // The map of a killed run has neither a trajectory nor a mosaic: the keyframes replace the
    // former, the latter is drawn while viewing.
    let keyframes =
        odograph_map::MapFile::open_read_only(&place.path("out/map.gpkg")).unwrap().map().unwrap().keyframes;
    let mut view = place.server("view", "out/map.gpkg");
    let state: serde_json::Value = serde_json::from_str(&view.get("/state")).unwrap();
    assert_eq!(state["status"]["captured"], json!(keyframes.len()));
    let begun = std::time::Instant::now();
    while view.answer("/tiles/0/0.png").is_err() {
        assert!(begun.elapsed() < Duration::from_secs(60), "no ground was rendered");
    }
    view.end();
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_is_reported_and_tracking_continues() {
    // `/dev/full` takes the place of the recorded trajectory.
    let place = LiveFolder::new();
    std::fs::create_dir(place.path("out")).unwrap();
    std::os::unix::fs::symlink("/dev/full", place.path("out/trajectory.csv.part")).unwrap();
    let mut live = place.server("live", &format!("{DEMO}/drive.mp4 --realtime 4 --print poses -o out"));
    let mut status = json!(null);
    for (number, line) in BufReader::new(live.output()).lines().enumerate() {
        line.unwrap();
        if number % 40 == 39 {
            status =
                serde_json::from_str::<serde_json::Value>(&live.get("/state")).unwrap()["status"].clone();
            if status["recording"] == json!(false) {
                break;
            }
        }
    }
    let message = status["message"].as_str().unwrap();
    assert!(message.contains("No space left on device") && message.contains("tracking goes on"), "{message}");
    live.end();
}

#[test]
fn invalid_sources_are_refused_in_one_sentence() {
    let place = LiveFolder::new();
    let refused = |arguments: &str, code: i32| {
        let done = place.command("live", arguments).output().unwrap();
        assert_eq!(done.status.code(), Some(code), "{arguments}");
        assert!(!place.path("out").exists(), "{arguments}");
        String::from_utf8_lossy(&done.stderr).into_owned()
    };
    assert!(refused("/dev/video99 -o out", 3).contains("/dev/video99"));
    assert!(refused("http://127.0.0.1:9/video -o out", 3).contains("gives no pictures"));
    assert!(refused("https://phone/video -o out", 2).contains("http://"));
    assert!(refused("http://a:b/ -o out", 2).contains("is not an address"));
    assert!(refused("rtsp://127.0.0.1:9/x -o out", 3).contains("install ffmpeg"));
    let nowhere = refused(&format!("{DEMO}/drive.mp4 --udp nowhere -o out"), 2);
    assert!(nowhere.contains("cannot be sent to nowhere") && nowhere.contains("HOST:PORT"), "{nowhere}");
    assert!(
        refused(&format!("{DEMO}/drive.mp4 --serve 0.0.0.0:0 --token short -o out"), 2)
            .contains("at least 8")
    );
    assert!(refused(&format!("{DEMO}/drive.mp4 --raw gray:1x1@1 -o out"), 2).contains("standard input"));
    assert!(refused("- --raw gray:640x480@30 -o out", 3).contains("no frame"));
    let view = |path: &str| {
        let done = place.command("view", path).output().unwrap();
        assert_eq!(done.status.code(), Some(3), "{path}");
        String::from_utf8_lossy(&done.stderr).into_owned()
    };
    std::fs::write(place.path("text.gpkg"), "no map").unwrap();
    assert!(view("text.gpkg").contains("text.gpkg"));
    assert!(view("nowhere").contains("nowhere: there is no such folder or file"));
}

/// A mask of the left tenth of the drive's images.
fn write_mask(path: &std::path::Path) {
    let samples: Vec<u8> = (0..640 * 480).map(|at| if at % 640 < 64 { 0 } else { 255 }).collect();
    let mut encoder = png::Encoder::new(std::fs::File::create(path).unwrap(), 640, 480);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header().unwrap().write_image_data(&samples).unwrap();
}

#[test]
fn the_page_shows_a_run_while_it_grows_and_afterwards() {
    let mut browser = match Browser::start() {
        Ok(browser) => browser,
        Err(why) => {
            println!("skipped: chromium: {why}");
            return;
        }
    };
    let place = LiveFolder::new();
    write_mask(&place.path("mask.png"));
    let mut live = place.server("live", &format!("{DEMO}/drive.mp4 --realtime 1 --mask mask.png -o out"));
    let url = live.url.clone();
    let page = browser.open(&url, (1280, 800), false);
    let number = |browser: &mut Browser, tab, name: &str| {
        browser.evaluate(tab, &format!("Number(document.body.dataset.{name} || 0)")).as_f64().unwrap()
    };
    browser.wait(&page, "document.body.dataset.pictures > 5 && document.body.dataset.tiles > 1");
    let (records, tiles) = (number(&mut browser, &page, "records"), number(&mut browser, &page, "tiles"));
    // A second viewer on a phone in dark mode, which sets a mark with a key.
    let phone = browser.open(&url, (390, 844), true);
    browser.wait(&phone, "document.body.dataset.pictures > 5");
    browser.press(&phone, "m");
    browser.wait(&page, "document.body.dataset.marks == 1");
    browser.evaluate(&page, "document.getElementById('mark').click()");
    browser.wait(&phone, "document.body.dataset.marks == 2");
    // A mark is named after it was set; keys are then letters.
    browser.wait(&page, "!document.getElementById('naming').hidden");
    browser.press(&page, "m");
    browser.evaluate(&page, "document.getElementById('mark-name').value = 'gate, \"north\"'");
    browser.evaluate(&page, "document.querySelector('#naming .strong').click()");
    // Paused, the clock still has the time of the newest frame.
    browser.press(&page, " ");
    browser.evaluate(&page, "window.before = document.getElementById('clock').textContent");
    browser.wait(
        &page,
        "document.getElementById('clock').textContent.split(' / ')[1] !== before.split(' / ')[1]",
    );
    assert_eq!(
        browser.evaluate(
            &page,
            "document.getElementById('clock').textContent.split(' / ')[0] === before.split(' / ')[0]"
        ),
        json!(true)
    );
    browser.press(&page, "l");
    // A unit stands beside a number, and not beside the dash of a frame without one.
    browser.wait(&page, "/^(-?[0-9.]+°|–)$/.test(document.getElementById('heading').textContent)");
    // Trajectory and ground map grow.
    browser.wait(
        &page,
        &format!("document.body.dataset.records > {records} && document.body.dataset.tiles > {tiles}"),
    );
    assert_eq!(
        browser.evaluate(&page, "document.getElementById('state').textContent"),
        json!("tracked, recording")
    );
    browser.picture(&page, "live-desktop-light");
    browser.picture(&phone, "live-phone-dark");
    // The slider seeks back in time while new frames arrive.
    let back = "const time = document.getElementById('time'); time.value = 12; time.dispatchEvent(new Event('input'))";
    browser.evaluate(&page, back);
    browser.wait(&page, "document.body.dataset.at == 12");
    browser.press(&page, "l");
    browser.wait(&page, "document.body.dataset.at > 12");
    // The ground map is drawn below the trajectory: there are many colours.
    let colours = "(() => { const c = document.getElementById('map'); const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; \
                   const seen = new Set(); for (let k = 0; k < d.length; k += 404) seen.add(d[k] + ',' + d[k + 1] + ',' + d[k + 2]); return seen.size })()";
    assert!(browser.evaluate(&page, colours).as_u64().unwrap() > 50);
    // Layers: the ground can be switched off, and the mask is offered, here the left tenth.
    let switch = "document.querySelector('[data-layer=ground]').click()";
    browser.evaluate(&page, switch);
    browser.wait(&page, &format!("{colours} < 50"));
    browser.evaluate(&page, switch);
    browser.wait(&page, "document.body.dataset.mask >= 288");
    assert_eq!(
        browser.evaluate(&page, "document.querySelector('[data-layer=mask]').parentElement.hidden"),
        json!(false)
    );
    // It asks before it ends the run, and goes on unless that is confirmed.
    browser.evaluate(&page, "document.getElementById('stop').click()");
    browser.evaluate(&page, "document.querySelector('#ask [value=\"\"]').click()");
    assert_eq!(browser.evaluate(&page, "document.getElementById('stop').disabled"), json!(false));
    browser.evaluate(&page, "document.getElementById('stop').click()");
    browser.evaluate(&page, "document.querySelector('#ask [value=stop]').click()");
    browser.wait(&phone, "document.body.dataset.phase == 'saved'");
    // Path and ground are now those that were written.
    browser.wait(&page, "document.body.dataset.replaced == 1");
    browser.wait(
        &page,
        "[...document.querySelectorAll('#downloads a')].some(link => link.download == 'report.html')",
    );
    let table = browser.evaluate(&page, "fetch('/files/trajectory.csv').then(answer => answer.text())");
    assert_eq!(table.as_str().unwrap().as_bytes(), place.read("out/trajectory.csv"));
    let marks = String::from_utf8(place.read("out/marks.csv")).unwrap();
    assert_eq!(marks.lines().count(), 3, "{marks}");
    assert!(marks.contains("\"gate, \"\"north\"\"\""), "{marks}");
    // The report can be looked at, in a sandbox, and everything is there as one file.
    let report = "fetch('/report').then(answer => answer.headers.get('content-security-policy'))";
    assert!(browser.evaluate(&page, report).as_str().unwrap().starts_with("sandbox allow-scripts"));
    assert_eq!(browser.evaluate(&page, "document.getElementById('report').hidden"), json!(false));
    let archive = live.answer("/all.zip").unwrap();
    assert!(archive.starts_with(b"PK\x03\x04"));
    let table = place.read("out/trajectory.csv");
    assert!(archive.windows(table.len()).any(|part| part == table), "the path is not in the archive");
    browser.picture(&page, "saved-desktop-light");
    live.end();
    // The program has ended: the page says so, and offers nothing that it cannot give.
    browser.wait(&page, "document.body.dataset.gone == 1");
    assert_eq!(
        browser.evaluate(&page, "document.getElementById('state').textContent"),
        json!("saved; program ended")
    );
    let off = "['stop', 'mark', 'files'].every(id => document.getElementById(id).disabled) \
               && ['downloads', 'report'].every(id => document.getElementById(id).hidden)";
    assert_eq!(browser.evaluate(&page, off), json!(true));
    browser.picture(&page, "gone-desktop-light");
    look_at_the_finished_run(&mut browser, &place);
}

/// The same page for the output folder of the finished run.
fn look_at_the_finished_run(browser: &mut Browser, place: &LiveFolder) {
    let [frames, keyframes] =
        ["frames", "keyframes"].map(|name| statistics(&place.path("out"))[name].clone());
    let mut view = place.server("view", "out");
    let page = browser.open(&view.url, (1280, 800), true);
    browser
        .wait(&page, &format!("document.body.dataset.records == {frames} && document.body.dataset.at == 0"));
    browser.wait(&page, "document.body.dataset.tiles > 3 && document.body.dataset.marks == 2");
    browser.wait(&page, &format!("document.body.dataset.keyframes == {keyframes}"));
    browser.press(&page, " ");
    browser.wait(&page, "document.body.dataset.at > 3");
    browser.press(&page, " ");
    let half = "const time = document.getElementById('time'); time.value = time.max / 2 | 0; time.dispatchEvent(new Event('input'))";
    browser.evaluate(&page, half);
    browser.wait(&page, &format!("document.body.dataset.at == (({frames} - 1) / 2 | 0)"));
    // The position displayed equals that of the trajectory.
    let table = String::from_utf8(place.read("out/trajectory.csv")).unwrap();
    let at = (frames.as_u64().unwrap() as usize - 1) / 2;
    let x_m: f64 = table.lines().nth(at + 1).unwrap().split(',').nth(2).unwrap().parse().unwrap();
    let shown = browser.evaluate(&page, "Number(document.getElementById('x').textContent)").as_f64().unwrap();
    // Three decimals are displayed.
    assert!((shown - x_m).abs() < 6e-4, "{shown} {x_m}");
    browser.picture(&page, "view-desktop-dark");
    browser.look(&page, (390, 844), false);
    browser.evaluate(&page, "new Promise(done => setTimeout(done, 400))");
    browser.picture(&page, "view-phone-light");
    view.end();
    look_at_the_map(browser, place);
}

/// The map of the run.
fn look_at_the_map(browser: &mut Browser, place: &LiveFolder) {
    let map = odograph_map::MapFile::open_read_only(&place.path("out/map.gpkg")).unwrap();
    let keyframes = map.map().unwrap().keyframes.len();
    let frames = map.path_of(0).unwrap();
    let mut view = place.server("view", "out/map.gpkg");
    let page = browser.open(&view.url, (1280, 800), false);
    let all = format!(
        "document.body.dataset.records == {} && document.body.dataset.keyframes == {keyframes}",
        frames.len()
    );
    browser.wait(
        &page,
        &format!("{all} && document.body.dataset.tiles > 3 && document.body.dataset.marks == 1"),
    );
    browser.wait(&page, "document.body.dataset.at == 0");
    let shown = browser.evaluate(&page, "Number(document.getElementById('x').textContent)").as_f64().unwrap();
    assert!((shown - frames[0].pose.x_m).abs() < 6e-4, "{shown}");
    browser.picture(&page, "map-desktop-light");
    browser.look(&page, (390, 844), true);
    browser.evaluate(&page, "new Promise(done => setTimeout(done, 400))");
    browser.picture(&page, "map-phone-dark");
    view.end();
}

#[test]
fn without_the_token_nothing_is_served() {
    let place = LiveFolder::new();
    let mut live = place.server("live", &format!("{DEMO}/drive.mp4 --realtime --token letmein-42 -o out"));
    assert!(live.url.ends_with("/?token=letmein-42"), "{}", live.url);
    let mut stream = TcpStream::connect(live.address()).unwrap();
    stream.write_all(b"GET /state HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
    live.end();
}
