//! Slow tests and measurements, run on request.

use super::browser::Browser;
use super::program::{DEMO, LiveFolder};
use serde_json::json;
use std::io::{BufRead, BufReader};

/// Performance of the page with an hour of data at 30 frames per second, and with its loop
/// closures. The results are printed without limits, since they depend on the machine.
#[test]
#[ignore = "a measurement; cargo test --release -p odograph-cli --test live -- --ignored --nocapture hour"]
fn an_hour_on_the_page() {
    let mut browser = Browser::start().unwrap();
    let place = LiveFolder::new();
    std::fs::create_dir(place.path("hour")).unwrap();
    std::fs::write(place.path("hour/trajectory.csv"), place.table_of(108_000)).unwrap();
    let mut view = place.server("view", "hour");
    let page = browser.open(&view.url, (1280, 800), false);
    browser.wait(&page, "document.body.dataset.records == 108000 && document.body.dataset.at == 0");
    let measure = r#"(async () => {
        const { Track } = await import('/track.js'), { GroundMap } = await import('/map.js');
        const track = new Track(), bytes = await new Promise((done, fail) => {
            const socket = new WebSocket(`ws://${location.host}/socket`); let bytes = 0; const begun = performance.now();
            socket.binaryType = 'arraybuffer';
            socket.onmessage = event => { if (typeof event.data === 'string') return; bytes += event.data.byteLength;
                track.add(new DataView(event.data).getUint32(4, true), new Float32Array(event.data, 8));
                if (track.count === 108000) { socket.close(); done({ bytes, ms: performance.now() - begun }); } };
            socket.onerror = fail;
        });
        const canvas = document.createElement('canvas'); canvas.style.cssText = 'position:fixed;inset:0;width:910px;height:700px'; document.body.append(canvas);
        const map = new GroundMap(canvas, track); map.resize(); map.showAll(); map.show(track.count - 1);
        const time = act => { const times = []; for (let k = 0; k < 30; k++) { const begun = performance.now(); act(k); canvas.getContext('2d').getImageData(0, 0, 1, 1); times.push(performance.now() - begun); } return times.sort((a, b) => a - b)[15]; };
        const whole = time(() => { map.drawn = null; map.changed = true; map.draw(); });
        const still = time(() => { map.changed = true; map.draw(); });
        map.setFollow(true); map.view.scale = 300;
        const following = time(k => { map.show(track.count - 1 - k); map.draw(); });
        map.view.scale = 25;
        const followingAll = time(k => { map.show(track.count - 1 - k); map.draw(); });
        map.showAll(); map.draw();
        const zooming = time(() => { map.zoom(1.03); map.draw(); });
        const keyframes = 10000, corrections = new Array(4 * keyframes).fill(0).map((_, k) => k % 4 ? 0 : 1);
        const correct = time(() => track.correct(corrections));
        canvas.remove();
        return { bytes: bytes.bytes, load: bytes.ms, whole, still, following, followingAll, zooming, correct };
    })()"#;
    let figures = browser.evaluate(&page, measure);
    println!("an hour: {figures}");
    // 15 numbers of four bytes per frame, and a header for each message of 8192 frames.
    assert_eq!(figures["bytes"], json!(108_000 * 60 + 14 * 8));
    view.end();
}

/// The whole drive in real time, with its loop closures.
#[test]
#[ignore = "takes as long as the drive, half a minute"]
fn loop_closures_correct_the_page_but_never_the_pose_stream() {
    let mut browser = Browser::start().unwrap();
    let place = LiveFolder::new();
    let mut live = place.server("live", &format!("{DEMO}/drive.mp4 --realtime --print poses -o out"));
    let output = live.output();
    let message = std::thread::spawn(move || {
        let poses = BufReader::new(output).lines().map_while(Result::ok);
        let poses =
            poses.map(|line| serde_json::from_str::<serde_json::Value>(&line).unwrap()["pose"].clone());
        poses.filter_map(|pose| Some([pose["x_m"].as_f64()?, pose["y_m"].as_f64()?])).collect::<Vec<_>>()
    });
    let page = browser.open(&live.url, (1280, 800), false);
    browser.wait(&page, "document.body.dataset.keyframes > 3");
    browser.wait(&page, "document.body.dataset.phase == 'saved'");
    browser.evaluate(&page, "document.getElementById('whole').click()");
    browser.evaluate(&page, "new Promise(done => setTimeout(done, 600))");
    browser.picture(&page, "loops-desktop-light");
    let text = browser.evaluate(&page, "document.body.innerText");
    println!("{text}");
    live.end();
    let poses = message.join().unwrap();
    // No step is longer than the maximum speed allows between frames of which some may have been
    // dropped: 0.6 m/s for one second.
    let longest = poses.windows(2).map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1])).fold(0.0, f64::max);
    println!("longest step {longest} m of {} poses", poses.len());
    assert!(longest < 0.6, "{longest}");
}
