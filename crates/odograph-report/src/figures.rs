//! Summary statistics of a run, displayed at the top of its report.

use odograph::trajectory::{FrameSummary, LossReason, LostStretch, LostStretches, PlaceSummary, distance_m};

/// Summary statistics of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunFigures {
    pub frames: usize,
    pub with_pose: usize,
    pub duration_s: f64,
    pub distance_m: f64,
    pub lost: Vec<LostStretch>,
    /// Distance divided by the tracked time, metres per second.
    pub mean_speed_m_s: Option<f64>,
    pub first: Option<PlaceSummary>,
    pub last: Option<PlaceSummary>,
}

impl RunFigures {
    pub fn new(frames: &[FrameSummary]) -> Self {
        let ends = frames.first().zip(frames.last());
        let duration_s = ends.map_or(0.0, |(first, last)| (last.time_s - first.time_s).max(0.0));
        let lost = lost_stretches(frames);
        let distance_m = distance_m(frames);
        let known_s = duration_s - lost.iter().map(|stretch| stretch.to_s - stretch.from_s).sum::<f64>();
        let mut places = frames.iter().filter_map(|frame| frame.place);
        Self {
            frames: frames.len(),
            with_pose: places.clone().count(),
            duration_s,
            distance_m,
            lost,
            mean_speed_m_s: (known_s > 0.0).then_some(distance_m / known_s),
            first: places.clone().next(),
            last: places.next_back(),
        }
    }

    /// Total time without a pose, seconds.
    pub fn lost_s(&self) -> f64 {
        self.lost.iter().map(|stretch| stretch.to_s - stretch.from_s).sum()
    }

    /// Straight-line distance from the first position to the last, metres.
    pub fn start_to_end_m(&self) -> Option<f64> {
        let (first, last) = (self.first?, self.last?);
        Some((last.x_m - first.x_m).hypot(last.y_m - first.y_m))
    }
}

/// The reasons of a loss, as the end of a sentence.
pub fn because(stretch: &LostStretch) -> String {
    let reasons: Vec<&str> = stretch.reasons.iter().map(|&reason| in_words(reason)).collect();
    reasons.join("; then ")
}

/// Finds all intervals without a pose; times are since the start of the run.
pub fn lost_stretches(frames: &[FrameSummary]) -> Vec<LostStretch> {
    let start_s = frames.first().map_or(0.0, |frame| frame.time_s);
    let mut lost = LostStretches::default();
    frames.iter().for_each(|frame| lost.push(frame.time_s - start_s, frame.status));
    lost.finish()
}

/// The frames with a pose and the fewest inliers, fewest first, spread over the run so that a
/// single bad interval does not fill the list. The first frame after a gap has no predecessor and
/// is excluded.
pub fn weakest(frames: &[FrameSummary], count: usize) -> Vec<&FrameSummary> {
    let follows = |pair: &[FrameSummary]| pair[0].place.is_some() && pair[1].place.is_some();
    let mut candidates: Vec<&FrameSummary> =
        frames.windows(2).filter(|pair| follows(pair)).map(|pair| &pair[1]).collect();
    candidates.sort_by_key(|frame| (frame.inliers, frame.frame));
    let duration_s = RunFigures::new(frames).duration_s;
    let apart_s = (duration_s / (3.0 * count as f64)).min(5.0);
    let mut chosen: Vec<&FrameSummary> = vec![];
    for frame in candidates {
        if chosen.len() == count {
            break;
        }
        if chosen.iter().all(|other| (other.time_s - frame.time_s).abs() > apart_s) {
            chosen.push(frame);
        }
    }
    chosen
}

/// The reason as a sentence for the report.
pub(crate) fn in_words(reason: LossReason) -> &'static str {
    match reason {
        LossReason::Bare => "too little texture to track (bare floor, something over the lens)",
        LossReason::Dark => "too dark to see anything",
        LossReason::Jump => "hardly any corner was found again (a cut, a jump)",
        LossReason::Blur => "hardly any corner was found again: the image is blurred",
        LossReason::Shadow => {
            "the tracked corners stand still in the image (a shadow or a part of the carrier)"
        }
        LossReason::NotPlanar => "the corners did not move as one plane (moving objects, no floor)",
        _ => "the movement could not be measured",
    }
}

/// Standard deviations of the position in the direction of its maximum, metres, and of the heading,
/// radians.
pub fn sigmas(place: &PlaceSummary) -> (f64, f64) {
    let [xx, xy, yy] = place.position_covariance;
    let worst = 0.5 * (xx + yy) + (0.5 * (xx - yy)).hypot(xy);
    (worst.max(0.0).sqrt(), place.heading_variance.max(0.0).sqrt())
}
