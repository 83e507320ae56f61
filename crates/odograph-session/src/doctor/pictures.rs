//! The frames that show what was found, for a page.

use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use odograph::odometry::TrackView;
use odograph::trajectory::{FrameEstimate, LossReason, TrackStatus};

/// A frame of the recording, and what it shows.
#[derive(Debug, Clone, PartialEq)]
pub struct ExaminedFrame {
    /// Its number in the recording, from 0.
    pub number: u64,
    /// Its time, seconds.
    pub time_s: f64,
    /// What it shows, a sentence.
    pub shows: String,
    /// The image.
    pub gray: GrayImage,
    /// The corners of the ground that were found in it, and whether each agrees with the motion.
    pub corners: Vec<(Pixel, bool)>,
}

/// The frames that are kept: one as most are, the fastest, and the first of each reason of a loss.
#[derive(Debug, Default)]
pub struct Pictures {
    usual: Option<ExaminedFrame>,
    fastest: Option<(f64, ExaminedFrame)>,
    lost: Vec<(LossReason, ExaminedFrame)>,
}

impl Pictures {
    /// Looks at the next frame; `step_px` is how far the ground has moved since the one before.
    pub fn look(
        &mut self,
        (number, gray): (u64, GrayImage),
        estimate: &FrameEstimate,
        step_px: Option<f64>,
        tracks: &[TrackView],
    ) {
        let corners: Vec<(Pixel, bool)> = tracks.iter().map(|track| (track.pixel, track.inlier)).collect();
        let time_s = estimate.time_s;
        if let TrackStatus::Lost { reason } = estimate.status {
            if self.lost.iter().all(|(known, _)| *known != reason) {
                let shows = format!("Lost because of {}.", in_words(reason));
                self.lost.push((reason, ExaminedFrame { number, time_s, shows, gray, corners }));
            }
            return;
        }
        if estimate.tracks == 0 {
            return;
        }
        let agreeing = corners.iter().filter(|(_, agrees)| *agrees).count();
        if self.usual.is_none() {
            let shows = format!(
                "A tracked frame: of {} corners {agreeing} agree on the motion of the ground.",
                corners.len()
            );
            self.usual = Some(ExaminedFrame { number, time_s, shows, gray, corners });
            return;
        }
        if let Some(step_px) = step_px
            && step_px > self.fastest.as_ref().map_or(0.0, |(most_px, _)| *most_px)
        {
            let shows =
                format!("The fastest frame: the ground has moved by {step_px:.1} px since the one before.");
            self.fastest = Some((step_px, ExaminedFrame { number, time_s, shows, gray, corners }));
        }
    }

    /// The frames in the order in which to look at them.
    pub fn frames(self) -> Vec<ExaminedFrame> {
        let fastest = self.fastest.map(|(_, frame)| frame);
        let lost = self.lost.into_iter().map(|(_, frame)| frame);
        self.usual.into_iter().chain(fastest).chain(lost).collect()
    }
}

/// What causes a loss.
pub fn in_words(reason: LossReason) -> &'static str {
    match reason {
        LossReason::Bare => "too little texture",
        LossReason::Dark => "darkness",
        LossReason::Jump => "jumps or cuts",
        LossReason::Blur => "blur",
        LossReason::Shadow => "corners that stand still in the image",
        LossReason::NotPlanar => "corners that do not move as one plane",
        _ => "an unknown reason",
    }
}
