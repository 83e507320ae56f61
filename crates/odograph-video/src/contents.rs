//! What a recording holds: its streams or topics, their rates and gaps, and what each can be used
//! for.

use crate::recorded_camera::RecordedCamera;
use odograph::numerics::median;

/// An interval of more than this many usual ones is a gap.
const GAP_INTERVALS: f64 = 2.5;

/// What a recording holds.
#[derive(Debug, Clone, PartialEq)]
pub struct Contents {
    /// Human-readable name of the format.
    pub format: String,
    /// The video, or the topics in the order of their names.
    pub streams: Vec<Stream>,
    /// Defects of the recording, one sentence each.
    pub warnings: Vec<String>,
}

/// A stream of frames, or a topic.
#[derive(Debug, Clone, PartialEq)]
pub struct Stream {
    /// Name of the topic; `None` for what is not a robot recording.
    pub topic: Option<String>,
    /// Message type, or description of the video.
    pub kind: String,
    /// Codec or encoding of images; empty if it is in `kind`.
    pub encoding: String,
    /// Width and height of images, pixels.
    pub size: Option<(usize, usize)>,
    /// Number of frames or messages.
    pub count: u64,
    /// Times of the first and the last, seconds; `None` if there are none.
    pub span_s: Option<(f64, f64)>,
    /// Frames or messages per second: the inverse of the median interval.
    pub rate_hz: Option<f64>,
    /// Intervals much longer than usual, in order of time.
    pub gaps: Vec<Gap>,
    /// What it can be used for.
    pub usable_as: StreamUse,
}

/// An interval without frames or messages.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gap {
    /// Its begin, seconds after the first frame or message.
    pub after_s: f64,
    /// Its length, seconds.
    pub length_s: f64,
}

/// What a stream can be used for.
#[derive(Debug, Clone, PartialEq)]
pub enum StreamUse {
    /// Frames to follow, and the camera that took them as the recording describes it.
    Frames(Option<RecordedCamera>),
    /// Nothing: images of depth, or of an encoding that is not read.
    OtherImages,
    /// Description of a camera.
    CameraInfo,
    /// Turn rates.
    Gyro,
    /// Speed.
    Wheel,
    /// Distance to the ground.
    Range,
    /// Positions on Earth.
    Gnss,
    /// A path to compare with.
    Path,
    /// Nothing.
    Nothing,
}

impl Stream {
    /// Fills in what follows from the times of all frames or messages; they are sorted first.
    pub(crate) fn timed(mut self, mut times_s: Vec<f64>) -> Self {
        times_s.retain(|time| time.is_finite());
        times_s.sort_by(f64::total_cmp);
        let (Some(&first_s), Some(&last_s)) = (times_s.first(), times_s.last()) else { return self };
        self.span_s = Some((first_s, last_s));
        let mut steps: Vec<f64> = times_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let Some(usual_s) = median(&mut steps).filter(|&usual_s| usual_s > 0.0) else { return self };
        self.rate_hz = Some(1.0 / usual_s);
        let gaps = times_s.windows(2).filter(|pair| pair[1] - pair[0] > GAP_INTERVALS * usual_s);
        self.gaps =
            gaps.map(|pair| Gap { after_s: pair[0] - first_s, length_s: pair[1] - pair[0] }).collect();
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_and_gaps_follow_from_times() {
        let stream = Stream {
            topic: None,
            kind: String::new(),
            encoding: String::new(),
            size: None,
            count: 0,
            span_s: None,
            rate_hz: None,
            gaps: Vec::new(),
            usable_as: StreamUse::Nothing,
        };
        let timed = stream.clone().timed(vec![10.0, 10.5, 11.0, 13.0, 13.5, f64::NAN]);
        assert_eq!((timed.span_s, timed.rate_hz), (Some((10.0, 13.5)), Some(2.0)));
        assert_eq!(timed.gaps, [Gap { after_s: 1.0, length_s: 2.0 }]);
        assert_eq!(stream.clone().timed(vec![1.0]).rate_hz, None);
        assert_eq!(stream.clone().timed(Vec::new()), stream);
    }
}
