//! A simulated camera with RTSP (RFC 2326) that sends H.264 over the same connection (RFC 6184,
//! interleaved as in RFC 2326, section 10.12). It sends the first half of a clip and disconnects,
//! then the second half on the next connection, and then accepts no more.

use super::program::DEMO;
use std::io::{BufRead, BufReader, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread::JoinHandle;

/// A stream as a list of images, each of them a list of H.264 NAL units without start codes.
type NalStream = Vec<Vec<Vec<u8>>>;

/// The first seconds of the drive in H.264 as from a camera: no B-frames, a keyframe every half
/// second.
pub fn clip(path: &Path) -> Result<NalStream, String> {
    let arguments =
        "-c:v libx264 -preset ultrafast -tune zerolatency -bf 0 -g 15 -x264-params sliced-threads=0 -f h264";
    let done = Command::new("ffmpeg")
        .args(["-v", "error", "-t", "6", "-i", &format!("{DEMO}/drive.mp4")])
        .args(arguments.split(' '))
        .arg(path)
        .stdin(Stdio::null())
        .output()
        .map_err(|_| "there is no ffmpeg on this machine")?;
    if !done.status.success() {
        return Err(format!("ffmpeg makes no H.264 here: {}", String::from_utf8_lossy(&done.stderr)));
    }
    let bytes = std::fs::read(path).map_err(|error| error.to_string())?;
    let mut clip: NalStream = vec![Vec::new()];
    for unit in units(&bytes) {
        let last = clip.last_mut().unwrap();
        last.push(unit.to_vec());
        // Each image has a single slice, which is its last unit.
        if matches!(unit[0] & 0x1f, 1 | 5) {
            clip.push(Vec::new());
        }
    }
    clip.pop();
    assert!((170..=190).contains(&clip.len()), "{} pictures", clip.len());
    Ok(clip)
}

/// Splits a byte stream at its start codes (Annex B).
fn units(bytes: &[u8]) -> Vec<&[u8]> {
    let starts: Vec<usize> =
        (0..bytes.len() - 3).filter(|&k| bytes[k..k + 3] == [0, 0, 1]).map(|k| k + 3).collect();
    let ends = starts.iter().skip(1).map(|start| start - 3).chain([bytes.len()]);
    let trimmed = |unit: &'_ [u8]| unit.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
    starts.iter().zip(ends).map(|(&start, end)| &bytes[start..start + trimmed(&bytes[start..end])]).collect()
}

pub struct RtspServer {
    address: SocketAddr,
    pictures: u64,
    serving: JoinHandle<Vec<String>>,
}

impl RtspServer {
    pub fn start(clip: NalStream) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let pictures = clip.len() as u64;
        let serving = std::thread::spawn(move || {
            // The second half starts at the first keyframe after the middle, where decoding can
            // start.
            let whole = |picture: &Vec<Vec<u8>>| picture.iter().any(|unit| unit[0] & 0x1f == 5);
            let middle = (clip.len() / 2..clip.len()).find(|&k| whole(&clip[k])).unwrap();
            let (first, second) = clip.split_at(middle);
            let mut asked = Vec::new();
            for half in [first, second] {
                let (stream, _) = listener.accept().unwrap();
                serve(&stream, half, &mut asked);
            }
            asked
        });
        Self { address, pictures, serving }
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Number of images sent.
    pub fn sent(&self) -> u64 {
        self.pictures
    }

    /// The requests received, in order; waits for the end.
    pub fn asked(self) -> Vec<String> {
        self.serving.join().unwrap()
    }
}

/// Answers requests up to PLAY, then sends.
fn serve(stream: &TcpStream, pictures: &[Vec<Vec<u8>>], asked: &mut Vec<String>) {
    let mut reader = BufReader::new(stream);
    loop {
        let mut head = Vec::new();
        loop {
            let mut line = String::new();
            if reader.read_line(&mut line).unwrap_or(0) == 0 || line.trim().is_empty() {
                break;
            }
            head.push(line.trim().to_owned());
        }
        let Some(method) = head.first().and_then(|line| line.split(' ').next()) else { return };
        let sequence = head.iter().find(|line| line.to_ascii_lowercase().starts_with("cseq:")).unwrap();
        let rest = match method {
            "DESCRIBE" => {
                let description = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=floor\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\n\
                                   a=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\na=control:track0\r\n";
                format!(
                    "Content-Type: application/sdp\r\nContent-Length: {}\r\n\r\n{description}",
                    description.len()
                )
            }
            "SETUP" => {
                assert!(head.iter().any(|line| line.contains("RTP/AVP/TCP")), "{head:?}");
                "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 7\r\n\r\n".to_owned()
            }
            "OPTIONS" => "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n\r\n".to_owned(),
            _ => "Session: 7\r\n\r\n".to_owned(),
        };
        asked.push(method.to_owned());
        let mut output = stream;
        output.write_all(format!("RTSP/1.0 200 OK\r\n{sequence}\r\n{rest}").as_bytes()).unwrap();
        if method == "PLAY" {
            send(output, pictures);
            // Disconnects after reading to the end: closing a socket with unread data would reset
            // it, and discard what was sent.
            let _ = output.shutdown(Shutdown::Write);
            let _ = std::io::copy(&mut reader, &mut std::io::sink());
            return;
        }
    }
}

/// Sends the images at 30 per second with timestamps of 90 kHz. Units that exceed a packet are
/// fragmented (FU-A).
fn send(mut output: &TcpStream, pictures: &[Vec<Vec<u8>>]) {
    const LONGEST: usize = 1200;
    let mut sequence = 100_u16;
    let mut packet = |payload: &[u8], timestamp: u32, last: bool| {
        let mut bytes = vec![b'$', 0];
        bytes.extend(((12 + payload.len()) as u16).to_be_bytes());
        bytes.extend([0x80, 96 | u8::from(last) << 7]);
        bytes.extend(sequence.to_be_bytes());
        bytes.extend(timestamp.to_be_bytes());
        bytes.extend([0, 0, 0, 9]);
        bytes.extend(payload);
        sequence += 1;
        // The client may disconnect.
        output.write_all(&bytes).is_ok()
    };
    for (number, units) in pictures.iter().enumerate() {
        let timestamp = 3000 * number as u32;
        for (k, unit) in units.iter().enumerate() {
            let ends = k + 1 == units.len();
            if unit.len() <= LONGEST {
                packet(unit, timestamp, ends);
                continue;
            }
            let (header, body) = (unit[0], &unit[1..]);
            let pieces = body.chunks(LONGEST).count();
            for (index, piece) in body.chunks(LONGEST).enumerate() {
                let marks = u8::from(index == 0) << 7 | u8::from(index + 1 == pieces) << 6;
                let head = [header & 0xe0 | 28, marks | header & 0x1f];
                packet(&[&head[..], piece].concat(), timestamp, ends && index + 1 == pieces);
            }
        }
    }
}
