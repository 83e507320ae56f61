use super::*;
use odograph::image::GrayImage;
use odograph_video::jpeg_from_gray;
use std::net::TcpListener;
use std::thread;

fn jpeg(shade: u8) -> Vec<u8> {
    jpeg_from_gray(&GrayImage::from_samples(32, 16, vec![shade; 32 * 16]).unwrap(), 90).unwrap()
}

fn part(body: &[u8]) -> Vec<u8> {
    let head = format!("--b\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", body.len());
    [head.as_bytes(), body, b"\r\n"].concat()
}

const HEAD: &str = "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=--b\r\n";

/// A camera that sends one of `answers` per connection and then closes it. Returns its address.
fn camera(answers: Vec<Vec<u8>>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    thread::spawn(move || {
        for answer in answers {
            let (stream, _) = listener.accept().unwrap();
            let mut reader = BufReader::new(&stream);
            let mut line = String::from("-");
            while !line.trim().is_empty() {
                line.clear();
                reader.read_line(&mut line).unwrap();
            }
            (&stream).write_all(&answer).unwrap();
        }
    });
    format!("http://{address}/video")
}

#[test]
fn a_lost_camera_is_reconnected_and_reported() {
    let first =
        [format!("{HEAD}\r\n").into_bytes(), part(&jpeg(50)), part(b"no picture"), part(&jpeg(90))].concat();
    // The second response uses chunked coding, with chunk borders anywhere in the data.
    let parts = [part(&jpeg(130)), part(&jpeg(170))].concat();
    let chunks: Vec<u8> = parts
        .chunks(100)
        .flat_map(|chunk| [format!("{:x}\r\n", chunk.len()).as_bytes(), chunk, b"\r\n"].concat())
        .chain(*b"0\r\n\r\n")
        .collect();
    let second = [format!("{HEAD}Transfer-Encoding: chunked\r\n\r\n").into_bytes(), chunks].concat();
    let watch = Watch::default();
    let address = camera(vec![first, second]);
    let mut source = HttpMjpeg::open(&address, Duration::from_millis(600), watch.clone()).unwrap();
    assert_eq!((source.info().width, source.info().height), (32, 16));
    let mut times = Vec::new();
    for (number, shade) in [50, 90, 130, 170].into_iter().enumerate() {
        let frame = source.next_frame().unwrap().unwrap().frame;
        // A uniform image survives JPEG within one quantisation step.
        assert!(frame.gray.samples()[0].abs_diff(shade) <= 2);
        assert_eq!(frame.number, number as u64);
        times.push(frame.time_s);
    }
    assert!(times.is_sorted_by(|a, b| a < b));
    assert_eq!((watch.reconnects(), watch.waiting()), (1, None));
    // The camera closes the connection again, and its port with it.
    let error = source.next_frame().unwrap_err().to_string();
    assert!(error.contains("went away") && error.contains("did not come back"), "{error}");
    assert!(watch.waiting().unwrap().contains("is gone"));
    assert!(source.take_warnings()[0].contains("1 damaged pictures"));
}

#[test]
fn other_servers_are_refused_with_a_clear_message() {
    let refused = |answer: &str| {
        let address = camera(vec![answer.as_bytes().to_vec()]);
        HttpMjpeg::open(&address, Duration::ZERO, Watch::default()).unwrap_err().to_string()
    };
    let missing = refused("HTTP/1.1 404 Not Found\r\n\r\n");
    assert!(missing.contains("it answers 404 Not Found; the camera's manual states"), "{missing}");
    let elsewhere = refused("HTTP/1.1 302 Found\r\nLocation: http://10.0.0.9/live\r\n\r\n");
    assert!(elsewhere.contains("the stream is at http://10.0.0.9/live; give that address"), "{elsewhere}");
    assert!(refused("HTTP/1.1 503 Busy\r\n\r\n").contains("503 Busy; check that no other program"));
    assert!(refused("HTTP/1.1 401 Who\r\n\r\n").contains("name and a password"));
    let page = refused("HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<p>");
    assert!(page.contains("`text/html`, not with a stream of pictures"), "{page}");
    assert!(refused("SSH-2.0-OpenSSH\r\n\r\n").contains("does not answer as an HTTP server"));
    assert!(refused(&format!("{HEAD}\r\n")).contains("ended at once"));
    let text = refused(&format!("{HEAD}\r\n--b\r\n\r\nhello\r\n--b--\r\n"));
    assert!(text.contains("JPEG"), "{text}");
}

#[test]
fn a_camera_that_cannot_be_reached_says_what_to_check() {
    let failure =
        |address: &str| HttpMjpeg::open(address, Duration::ZERO, Watch::default()).unwrap_err().to_string();
    // The port was free a moment ago.
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let refused = failure(&format!("http://127.0.0.1:{port}/video"));
    assert!(refused.starts_with(&format!("http://127.0.0.1:{port}/video gives no pictures: ")), "{refused}");
    assert!(
        refused.ends_with("; check the address, and that the camera is on and in this network"),
        "{refused}"
    );
    // Names that end in `.invalid` do not exist (RFC 6761).
    let unknown = failure("http://camera.invalid/video");
    assert!(unknown.contains("the name camera.invalid is not known here"), "{unknown}");
    assert!(unknown.contains("check the name, or give its IP address"), "{unknown}");
}

#[test]
fn a_connection_has_a_time_limit_as_a_whole() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (mut camera, _) = listener.accept().unwrap();
    camera.write_all(b"HT").unwrap();
    let deadline = Deadline::within(PATIENCE);
    let mut timely = Timely { stream, deadline: deadline.clone() };
    let mut byte = [0];
    assert_eq!(timely.read(&mut byte).unwrap(), 1);
    // Another byte would be there, but too late.
    deadline.extend(Duration::ZERO);
    assert!(timely.read(&mut byte).unwrap_err().to_string().contains("too slowly"));
    // Each image has its own time.
    let parts: Box<dyn BufRead + Send> = Box::new(BufReader::new(timely));
    let mut connection = Connection { parts: Multipart::new(parts, "b"), deadline: deadline.clone() };
    drop(camera);
    assert!(!connection.next(&mut Vec::new()).unwrap());
    assert!(*deadline.instant() > Instant::now());
}

/// A part with the time at which the camera took its image.
fn stamped(body: &[u8], stamp: &str) -> Vec<u8> {
    let head = format!("--b\r\nX-Timestamp: {stamp}\r\nContent-Length: {}\r\n\r\n", body.len());
    [head.as_bytes(), body, b"\r\n"].concat()
}

/// The times of the images of a stream that arrives all at once.
fn times(parts: Vec<Vec<u8>>) -> Vec<f64> {
    let count = parts.len();
    let answer = [format!("{HEAD}\r\n").into_bytes(), parts.concat()].concat();
    let mut source =
        HttpMjpeg::open(&camera(vec![answer]), Duration::from_secs(600), Watch::default()).unwrap();
    (0..count).map(|_| source.next_frame().unwrap().unwrap().frame.time_s).collect()
}

#[test]
fn images_that_arrive_at_once_are_not_taken_at_once() {
    let times = times((0..8).map(|_| part(&jpeg(90))).collect());
    // A burst before anything is known of the camera: at most sixty frames a second.
    for pair in times.windows(2) {
        assert!(pair[1] - pair[0] > 0.9 / 60.0, "{times:?}");
    }
}

#[test]
fn time_stamps_of_the_camera_are_its_times() {
    let stamps = [1_700_000_000.0, 1_700_000_000.1, 1_700_000_000.2, 1_700_000_000.35];
    let stated = times(stamps.iter().map(|stamp| stamped(&jpeg(90), &format!("{stamp:.6}"))).collect());
    for (time_s, expected_s) in stated.iter().zip([0.0, 0.1, 0.2, 0.35]) {
        assert!((time_s - stated[0] - expected_s).abs() < 1e-5, "{stated:?}");
    }
    // Whole seconds are no times of frames.
    let repeated = times((0..4).map(|_| stamped(&jpeg(90), "1700000000")).collect());
    assert!(repeated.windows(2).all(|pair| (0.01..0.5).contains(&(pair[1] - pair[0]))), "{repeated:?}");
}
