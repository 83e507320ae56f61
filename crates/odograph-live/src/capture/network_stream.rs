//! A network stream decoded by another program (RTSP), with automatic reconnection.

use super::back_off::BackOff;
use super::{Captured, LiveSource, Watch, check_size};
use odograph::error::{Error, Result};
use odograph_video::{Frame, Source, SourceInfo};
use std::time::{Duration, Instant};

/// Opens the stream.
type OpenStream = Box<dyn FnMut() -> Result<Source> + Send>;

/// Least time from one frame to the next, seconds: cameras in networks have no more than 120
/// frames a second.
const MIN_STEP_S: f64 = 1.0 / 120.0;

/// A network stream with reconnection.
pub struct NetworkStream {
    open: OpenStream,
    place: String,
    info: SourceInfo,
    source: Option<Source>,
    patience: Duration,
    /// Arrival time and timestamp (seconds) of the newest frame.
    newest: Option<(Instant, f64)>,
    /// Offset added to the stream's timestamps, seconds. A reopened stream starts its own clock
    /// anew. `None` until the first frame after opening.
    shift_s: Option<f64>,
    number: u64,
    watch: Watch,
    warnings: Vec<String>,
}

impl std::fmt::Debug for NetworkStream {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("NetworkStream").field("info", &self.info).finish_non_exhaustive()
    }
}

impl NetworkStream {
    /// Opens the stream at an address. A stream that is lost later is opened again; after
    /// `patience` without success the source fails.
    ///
    /// # Errors
    /// If there is no such stream.
    pub fn open(address: &str, mut open: OpenStream, patience: Duration, watch: Watch) -> Result<Self> {
        let (address, place) = (address.to_owned(), without_credentials(address));
        // Error messages of other programs may contain the address with its password.
        let mut open: OpenStream = {
            let place = place.clone();
            Box::new(move || {
                open().map_err(|error| Error::input(error.to_string().replace(&address, &place)))
            })
        };
        let source = open()?;
        Ok(Self {
            open,
            place,
            info: source.info().clone(),
            source: Some(source),
            patience,
            newest: None,
            shift_s: Some(0.0),
            number: 0,
            watch,
            warnings: Vec::new(),
        })
    }

    /// The next frame of the stream, or the reason why there is none.
    fn attempt(&mut self) -> std::result::Result<Frame, String> {
        let Some(source) = &mut self.source else {
            // Opened only here, not before the pause: the caller checks for a stop request first.
            self.source = Some((self.open)().map_err(|error| error.to_string())?);
            self.shift_s = None;
            return self.attempt();
        };
        let taken = source.next_frame();
        self.warnings.extend(source.take_warnings());
        match taken {
            Ok(Some(frame)) => Ok(frame),
            Ok(None) => Err("the stream ended".to_owned()),
            Err(error) => Err(error.to_string()),
        }
    }

    /// Assigns frame number and timestamp within the whole recording.
    fn placed(&mut self, mut frame: Frame) -> Result<Captured> {
        check_size(&self.place, &frame.gray, &self.info)?;
        let at = Instant::now();
        let shift_s = *self.shift_s.get_or_insert_with(|| match self.newest {
            Some((before, time_s)) => time_s + (at - before).as_secs_f64() - frame.time_s,
            None => 0.0,
        });
        // Timestamps must increase for the velocity to be defined, and not by a small step, which
        // would make a great velocity.
        let least_s = self.newest.map_or(f64::NEG_INFINITY, |(_, time_s)| time_s + MIN_STEP_S);
        frame.time_s = (frame.time_s + shift_s).max(least_s);
        frame.number = self.number;
        self.number += 1;
        self.newest = Some((at, frame.time_s));
        Ok(Captured { frame, at })
    }
}

impl LiveSource for NetworkStream {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Captured>> {
        let mut back_off = BackOff::new(self.patience);
        while !self.watch.ended() {
            let why = match self.attempt() {
                Ok(frame) => {
                    self.watch.back();
                    return self.placed(frame).map(Some);
                }
                Err(why) => why,
            };
            self.source = None;
            self.watch.lost(&format!("the camera at {} is gone ({why}); trying again", self.place));
            let Some(pause) = back_off.pause() else {
                return Err(Error::input(format!(
                    "the camera at {} went away ({why}) and did not come back within {} s",
                    self.place,
                    self.patience.as_secs()
                )));
            };
            if !self.watch.sleep_until(Instant::now() + pause) {
                break;
            }
        }
        Ok(None)
    }

    fn take_warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

/// Removes name and password from an address, which is displayed on the page and written into
/// files.
pub fn without_credentials(address: &str) -> String {
    let Some((scheme, rest)) = address.split_once("://") else { return address.to_owned() };
    let (host, path) = rest.find('/').map_or((rest, ""), |slash| rest.split_at(slash));
    format!("{scheme}://{}{path}", host.rsplit('@').next().unwrap_or(host))
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph_video::SourceOptions;

    /// A camera that delivers the given number of images per opening; 0 means that opening fails.
    fn camera(pictures: &'static [usize]) -> (tempfile::TempDir, OpenStream) {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().to_owned();
        let mut turns = pictures.iter();
        let open: OpenStream = Box::new(move || {
            let count = *turns.next().unwrap_or(&0);
            let path = place.join(format!("{}.y4m", turns.len()));
            let frames = b"FRAME\n".iter().chain(&[90; 16 * 12]).copied().collect::<Vec<u8>>().repeat(count);
            let head = b"YUV4MPEG2 W16 H12 F30:1 Cmono\n".to_vec();
            std::fs::write(&path, [head, frames].concat())
                .map_err(|error| Error::input(error.to_string()))?;
            odograph_video::open(path, &SourceOptions::default())
        });
        (folder, open)
    }

    #[test]
    fn reconnected_stream_continues_timestamps_and_frame_numbers() {
        let (_folder, open) = camera(&[3, 0, 2]);
        let watch = Watch::default();
        let patience = Duration::from_millis(800);
        let mut stream =
            NetworkStream::open("rtsp://me:secret@hall/1", open, patience, watch.clone()).unwrap();
        let mut times = Vec::new();
        let failure = loop {
            match stream.next_frame() {
                Ok(Some(captured)) => {
                    assert_eq!(captured.frame.number, times.len() as u64);
                    times.push(captured.frame.time_s);
                }
                Ok(None) => panic!("nobody asked it to end"),
                Err(error) => break error.to_string(),
            }
        };
        assert_eq!((times.len(), watch.reconnects()), (5, 1));
        assert!(times.windows(2).all(|pair| pair[1] > pair[0]), "{times:?}");
        // The interruption lasted at least two pauses, 0.25 s and 0.5 s.
        assert!(times[3] - times[2] > 0.74, "{times:?}");
        assert!(
            failure.contains("rtsp://hall/1 went away") && failure.contains("did not come back"),
            "{failure}"
        );
        assert!(!failure.contains("secret"));
    }

    #[test]
    fn passwords_are_removed_from_addresses_and_messages() {
        let plain = |address: &str| without_credentials(address);
        assert_eq!(plain("rtsp://me:p@ss@hall:554/a@b"), "rtsp://hall:554/a@b");
        assert_eq!(["rtsp://hall", "-", "a@b.mp4"].map(plain), ["rtsp://hall", "-", "a@b.mp4"]);
        let refused = Box::new(|| Err(Error::input("rtsp://me:secret@hall/1: 401 Unauthorized")));
        let failure =
            NetworkStream::open("rtsp://me:secret@hall/1", refused, Duration::ZERO, Watch::default())
                .unwrap_err();
        assert!(failure.to_string().ends_with("rtsp://hall/1: 401 Unauthorized"), "{failure}");
    }

    #[test]
    fn stream_ends_when_asked_to() {
        let (_folder, open) = camera(&[1]);
        let watch = Watch::default();
        let mut stream =
            NetworkStream::open("rtsp://hall/1", open, Duration::from_secs(600), watch.clone()).unwrap();
        assert!(stream.next_frame().unwrap().is_some());
        watch.end();
        assert!(stream.next_frame().unwrap().is_none());
    }
}
