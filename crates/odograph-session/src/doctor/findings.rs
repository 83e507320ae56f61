//! From measures to findings: thresholds, and what to do.

use super::appearance::{Appearance, blur_px};
use super::intervals::Intervals;
use super::lens::{Codec, Coded, GivenLens};
use super::pictures::in_words;
use super::tracking::Tracking;
use crate::pixel_shape;
use crate::rig::advice_for_other_size;
use odograph::camera::{Camera, Rig};
use odograph::fixed_pattern::FixedPattern;
use odograph::formats::decimal::Rounded;
use odograph::trajectory::LossReason;
use serde::Serialize;

/// How much something limits the accuracy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Judgement {
    /// Not noticeably.
    Good,
    /// Not determined: the recording does not show it.
    Unknown,
    /// The result will be less accurate than it could be.
    Limits,
    /// The result will be wrong, or tracking will be lost.
    Spoils,
}

impl Judgement {
    /// The judgement in one word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Unknown => "unknown",
            Self::Limits => "limits",
            Self::Spoils => "spoils",
        }
    }

    /// By thresholds for a measure of which less is better.
    fn of(measure: f64, limits_from: f64, spoils_from: f64) -> Self {
        match measure {
            measure if measure >= spoils_from => Self::Spoils,
            measure if measure >= limits_from => Self::Limits,
            _ => Self::Good,
        }
    }
}

/// One thing that was examined.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// What was examined, in a word or two.
    pub topic: &'static str,
    /// The measure; `None` for what has no number.
    pub value: Option<f64>,
    /// Unit of the measure: `px`, `%`, `ms`, `deg`, or what is counted.
    pub unit: &'static str,
    /// How much it limits the accuracy.
    pub judgement: Judgement,
    /// What was measured, as a phrase with its numbers and units.
    pub measured: String,
    /// What to do; `None` where all is good.
    pub advice: Option<String>,
}

/// Everything that was seen, ready to be judged.
pub struct Seen<'a> {
    pub size: (usize, usize),
    pub lens: GivenLens,
    pub camera: &'a Camera,
    pub rig: &'a Rig,
    pub intervals: Option<Intervals>,
    /// Whether the times of the frames are by an assumed frame rate.
    pub rate_is_assumed: bool,
    pub coded: Option<Coded>,
    pub appearance: &'a Appearance,
    pub tracking: &'a Tracking,
    /// Fraction of the image that was found to be static.
    pub fixed_share: f64,
    pub fixed: &'a FixedPattern,
}

/// A finding with its measure.
fn found(
    topic: &'static str,
    (value, unit): (f64, &'static str),
    judgement: Judgement,
    measured: String,
    advice: &str,
) -> Finding {
    let advice = (judgement != Judgement::Good).then(|| advice.to_owned());
    Finding { topic, value: Some(value), unit, judgement, measured, advice }
}

/// What could not be determined, and what to do, where something can be done.
fn unknown(topic: &'static str, unit: &'static str, measured: String, advice: &str) -> Finding {
    let advice = (!advice.is_empty()).then(|| advice.to_owned());
    Finding { topic, value: None, unit, judgement: Judgement::Unknown, measured, advice }
}

/// Why something is not determined, and what to do.
const AT_REST: &str = "not determined: nothing moves";
const NOT_TRACKED: &str = "not determined: no motion was tracked";
const DRIVE: &str = "examine a recording in which the camera drives";

impl Seen<'_> {
    /// All findings, in the order in which to read them.
    pub fn findings(&self) -> Vec<Finding> {
        let mut findings = vec![self.camera_file()];
        findings.extend(self.rate());
        findings.extend(self.copies());
        findings.push(self.exposure());
        findings.push(self.texture());
        findings.extend(self.motion());
        findings.extend(self.blur());
        findings.extend(self.overlap());
        findings.push(self.losses());
        findings.push(self.compression());
        findings.extend(self.shutter());
        findings.push(self.fixed_in_image());
        findings.extend(self.fixed_pattern());
        findings.extend(self.tilt());
        findings.extend(self.found_lens());
        findings
    }

    fn camera_file(&self) -> Finding {
        let (width, height) = self.size;
        let (judgement, measured, advice) = match self.lens {
            GivenLens::Fits => (Judgement::Good, format!("calibrated for {width}x{height}"), None),
            GivenLens::FieldOfView(width_m, height_m)
                if let Some(doubt) = pixel_shape::doubt(self.size, (width_m, height_m)) =>
            {
                (Judgement::Spoils, doubt, Some("give it as WIDTHxHEIGHT, width along the rows of the image"))
            }
            GivenLens::FieldOfView(..) => (
                Judgement::Limits,
                "a measured field of view; lens distortion and tilt are taken as zero".to_owned(),
                Some("calibrate with a board: odograph calibrate"),
            ),
            GivenLens::OtherSize(w, h) => (
                Judgement::Spoils,
                format!("calibrated for {w}x{h}, but the frames are {width}x{height}"),
                Some(advice_for_other_size(self.size, (w, h))),
            ),
            GivenLens::Missing => (
                Judgement::Limits,
                "not given; a lens of 64° without distortion is assumed here".to_owned(),
                Some("give --camera FILE; odograph calibrate makes one"),
            ),
        };
        let advice = advice.map(str::to_owned);
        Finding { topic: "camera file", value: None, unit: "", judgement, measured, advice }
    }

    fn rate(&self) -> Vec<Finding> {
        let Some(Intervals { usual_s, gaps, longest_gap_s, jitter }) = self.intervals else {
            return Vec::new();
        };
        if self.rate_is_assumed {
            let measured = format!(
                "assumed, {:.2} frames/s: nothing says when the frames were taken, or whether one is missing",
                1.0 / usual_s
            );
            return vec![unknown("frame times", "%", measured, "give --timestamps or --fps")];
        }
        let percent = 100.0 * jitter;
        let regular = found(
            "frame times",
            (percent, "%"),
            Judgement::of(percent, 15.0, 100.0),
            format!("{:.2} frames/s, the intervals vary by {percent:.1} %", 1.0 / usual_s),
            "record at a constant frame rate, with the times of the camera instead of those of arrival",
        );
        let gap = found(
            "gaps",
            (gaps as f64, "gaps"),
            // Any gap costs; many leave no motion to predict from.
            Judgement::of(gaps as f64 / self.tracking.frames.max(1) as f64, f64::MIN_POSITIVE, 0.2),
            match gaps {
                0 => "no frame is missing".to_owned(),
                1 => format!("1 gap of {:.0} ms", 1e3 * longest_gap_s),
                _ => format!("{gaps} gaps, the longest {:.0} ms", 1e3 * longest_gap_s),
            },
            "frames are missing: write to a faster disk, lower the frame rate or size, or go slower",
        );
        vec![regular, gap]
    }

    /// Equal images of a camera at rest without noise do not count.
    fn copies(&self) -> Option<Finding> {
        const MOVES_PX: f64 = 0.5;
        self.tracking.step_px(0.5).filter(|step_px| *step_px > MOVES_PX)?;
        let percent = 100.0 * self.tracking.copies as f64 / self.tracking.frames.max(1) as f64;
        Some(found(
            "repeated frames",
            (percent, "%"),
            Judgement::of(percent, 1.0, 30.0),
            format!("{percent:.1} % of the frames are copies of the one before"),
            "record at the rate that the camera delivers",
        ))
    }

    fn exposure(&self) -> Finding {
        let (dark, bright) = self.appearance.clipped();
        let mean = self.appearance.mean_gray();
        let (dark, bright) = (100.0 * dark, 100.0 * bright);
        let light = match mean {
            mean if mean < 24.0 => Judgement::Spoils,
            mean if mean < 45.0 => Judgement::Limits,
            _ => Judgement::Good,
        };
        let over = Judgement::of(bright, 2.0, 30.0);
        let under = Judgement::of(dark, 5.0, 40.0);
        let measured =
            format!("mean gray {mean:.0} of 255, {bright:.1} % clipped to white, {dark:.1} % to black");
        match over >= light.max(under) {
            true => found(
                "exposure",
                (bright, "%"),
                over,
                measured,
                "expose shorter or with less gain: what is clipped has no texture",
            ),
            false => found(
                "exposure",
                (mean, "gray levels"),
                light.max(under),
                measured,
                "more light; a longer exposure only if the camera moves slowly",
            ),
        }
    }

    fn texture(&self) -> Finding {
        let (corners, cells) = self.appearance.corners();
        let agreeing = self.tracking.agreeing();
        let over_noise = self.appearance.over_noise();
        let wanted = self.appearance.wanted_corners() as f64;
        // Below a tenth of the corners few frames have a pose; below half of the cells the rotation
        // rests on a part of the image. Chosen.
        let few = Judgement::of(1.0 - corners / wanted, 0.75, 0.9);
        let crowded = Judgement::of(1.0 - cells, 0.5, 0.75);
        // Rendered asphalt has 10, concrete 2.4, concrete with a noise of 6 gray levels 0.5, and a
        // bare floor 0.3: its corners are noise.
        let faint = Judgement::of(1.0 / over_noise.max(1e-3), 1.0, 2.5);
        let doubted = agreeing.map_or(Judgement::Good, |agreeing| Judgement::of(1.0 - agreeing, 0.5, 0.75));
        let of_tracks = agreeing
            .map_or_else(String::new, |share| format!(", {:.0} % agree on the motion", 100.0 * share));
        let poor = few.max(crowded).max(faint);
        found(
            "texture",
            (corners, "corners"),
            poor.max(doubted),
            format!(
                "{corners:.0} corners per frame in {:.0} % of the image, {over_noise:.1} times the noise{of_tracks}",
                100.0 * cells,
            ),
            match doubted > poor {
                true => "keep what moves, and what stands above the ground, out of view; check the focus",
                false => {
                    "sharpen the focus, lower the camera, or light the ground from the side, with less gain"
                }
            },
        )
    }

    /// A recording in which nothing moves.
    fn motion(&self) -> Option<Finding> {
        let most_px = self.tracking.at_rest_px()?;
        Some(found(
            "motion",
            (most_px, "px"),
            Judgement::Spoils,
            format!(
                "the camera did not move in the {} frames looked at: the image stays where it is, to {:.2} px",
                self.tracking.frames,
                most_px.max(0.01)
            ),
            "if it was driven, the stream is frozen, this is another recording, or everything in view moves with the \
             camera (a bumper, something over the lens)",
        ))
    }

    fn blur(&self) -> Option<Finding> {
        let (ratio, step_px) = self.tracking.sharpness_along_motion()?;
        let blur_px = blur_px(ratio);
        Some(found(
            "motion blur",
            (blur_px, "px"),
            // docs/choosing-a-camera.md: 4 px cost little, 6.6 px a factor of ten.
            Judgement::of(blur_px, 7.0, 12.0),
            match blur_px {
                blur_px if blur_px < LEAST_BLUR_PX => {
                    format!("below {LEAST_BLUR_PX:.0} px at {step_px:.1} px per frame")
                }
                _ => format!("about {blur_px:.0} px along the motion, at {step_px:.1} px per frame"),
            },
            "a shorter exposure and more light, or go slower",
        ))
    }

    fn overlap(&self) -> Option<Finding> {
        let share = self.tracking.largest_share(self.size)?;
        let (usual_px, overlap) = (self.tracking.step_px(0.5)?, 100.0 * (1.0 - share).max(0.0));
        let most_px = self.tracking.steps.iter().map(|step| step.most_px).fold(0.0, f64::max);
        Some(found(
            "overlap",
            (overlap, "%"),
            // docs/choosing-a-camera.md: 60 % of the width per frame was measured to be tracked.
            Judgement::of(share, 0.25, 0.6),
            format!(
                "{usual_px:.1} px per frame, at most {most_px:.0} px: consecutive frames share at least {overlap:.0} %"
            ),
            "a higher frame rate, a higher camera, or go slower",
        ))
    }

    fn losses(&self) -> Finding {
        let Tracking { frames, lost, .. } = self.tracking;
        let percent = 100.0 * lost.len() as f64 / (*frames).max(1) as f64;
        let mut most = (0, None);
        for reason in lost {
            let count = lost.iter().filter(|other| *other == reason).count();
            if count > most.0 {
                most = (count, Some(*reason));
            }
        }
        found(
            "tracking",
            (percent, "%"),
            Judgement::of(percent, f64::MIN_POSITIVE, 10.0),
            losses_text(lost.len(), *frames, most),
            match most.1 {
                Some(LossReason::Bare) => {
                    "lower the camera, sharpen the focus, light the ground from the side"
                }
                Some(LossReason::Dark) => "more light, or a longer exposure at lower speed",
                Some(LossReason::Blur) => "a shorter exposure, more light, slower turns",
                Some(LossReason::Jump) => "a higher frame rate, or go slower",
                Some(LossReason::Shadow) => "mask the parts of the carrier (--mask), move the lamp",
                _ if self.tracking.found.is_some() => {
                    "what was found below may be the reason, which a recorded run corrects; else keep objects \
                     above the ground out of view"
                }
                _ => "keep objects above the ground out of view; check the camera file",
            },
        )
    }

    fn compression(&self) -> Finding {
        let blockiness = self.appearance.blockiness();
        let by_blocks = Judgement::of(blockiness, 1.15, 1.6);
        let blocks = format!("steps at block borders are {blockiness:.2} times the others");
        let advice = "record at a higher bit rate or quality";
        let Some(Coded { by, bits_per_pixel }) = self.coded else {
            return found("compression", (blockiness, "times"), by_blocks, blocks, advice);
        };
        // docs/accuracy.md, lossy video: H.264 at 0.12 bits per pixel drifts by 0.006 to 0.009 % on
        // a steady mount, at 0.06 by 0.015 to 0.023 %, at 0.018 by 0.12 to 0.37 %. The others are
        // scaled by their usual efficiency.
        let enough = match by {
            Codec::H264 => 0.08,
            Codec::Newer => 0.04,
            Codec::Jpeg => 0.6,
        };
        let judgement = Judgement::of(enough / bits_per_pixel, 1.0, 3.0).max(by_blocks);
        let measured = format!("{bits_per_pixel:.3} bits per pixel, {blocks}");
        found("compression", (bits_per_pixel, "bits per pixel"), judgement, measured, advice)
    }

    /// A rolling shutter of unknown readout time, and its effect at the speed of the recording.
    fn shutter(&self) -> Option<Finding> {
        // The distortion error of an assumed lens would be attributed to the shutter.
        let is_assumed = matches!(self.lens, GivenLens::Missing | GivenLens::OtherSize(..));
        let learned =
            self.tracking.readout_s.filter(|(_, deviation_s)| !is_assumed && *deviation_s <= KNOWN_S);
        if let Some(readout_s) = self.camera.readout_s().filter(|_| self.lens == GivenLens::Fits) {
            let measured = match 1e3 * readout_s {
                0.0 => "a global shutter, as given".to_owned(),
                readout_ms => format!("read out in {readout_ms:.1} ms, as given"),
            };
            return Some(found("shutter", (1e3 * readout_s, "ms"), Judgement::Good, measured, ""));
        }
        let usual_s = self.intervals?.usual_s;
        if self.tracking.at_rest_px().is_some() {
            return Some(unknown("shutter", "ms", AT_REST.to_owned(), DRIVE));
        }
        let along: Vec<f64> =
            self.tracking.steps.iter().map(|step| step.middle_px.1.abs() / step.time_s).collect();
        let px_s = along.iter().sum::<f64>() / along.len().max(1) as f64;
        let by = |readout_s: f64| 100.0 * px_s * readout_s / self.size.1 as f64;
        Some(match learned {
            Some((0.0, _)) => {
                let measured = "a global shutter, as estimated from the recording".to_owned();
                found("shutter", (0.0, "ms"), Judgement::Good, measured, "")
            }
            Some((readout_s, deviation_s)) => found(
                "shutter",
                (1e3 * readout_s, "ms"),
                // A recorded run learns it in the same way.
                Judgement::Good,
                format!(
                    "read out in {:.1} ± {:.1} ms, as estimated from the recording",
                    1e3 * readout_s,
                    1e3 * deviation_s
                ),
                "",
            ),
            None => {
                let percent = by(usual_s.min(LONGEST_USUAL_S));
                let judgement = match Judgement::of(percent, 0.05, f64::INFINITY) {
                    // That it does no harm here does not make it known.
                    Judgement::Good => Judgement::Unknown,
                    harmful => harmful,
                };
                found(
                    "shutter",
                    (percent, "%"),
                    judgement,
                    format!(
                        "the readout time is not known; a rolling shutter would stretch the path by up to {percent:.1} %"
                    ),
                    "give --readout-ms (0 for a global shutter), or drive with changes of speed and turns",
                )
            }
        })
    }

    fn fixed_in_image(&self) -> Finding {
        if self.tracking.at_rest_px().is_some() {
            return unknown("fixed in the image", "%", AT_REST.to_owned(), DRIVE);
        }
        if self.tracking.steps.is_empty() {
            return unknown("fixed in the image", "%", NOT_TRACKED.to_owned(), DRIVE);
        }
        let percent = 100.0 * self.fixed_share.max(0.0);
        let judgement = Judgement::of(percent, 1.0, 50.0);
        let place = match judgement {
            Judgement::Good => String::new(),
            _ => format!(", {}", self.place_of_fixed()),
        };
        found(
            "fixed in the image",
            (percent, "%"),
            judgement,
            format!("{percent:.0} % of the image does not move with the ground{place}"),
            "clean the lens, or mask the parts of the carrier: --mask PICTURE",
        )
    }

    fn fixed_pattern(&self) -> Option<Finding> {
        let gray = self.tracking.pattern_gray?;
        Some(found(
            "fixed pattern",
            (gray, "gray levels"),
            Judgement::Limits,
            format!("the camera adds a pattern of {gray:.1} gray levels to every image"),
            "clean the lens and what is before it; give more light; a run subtracts the pattern",
        ))
    }

    /// Where in the image most of what is static lies.
    fn place_of_fixed(&self) -> &'static str {
        let picture = self.fixed.picture();
        let (width, height) = self.size;
        let (mut sum_x, mut sum_y, mut count) = (0.0, 0.0, 0.0);
        for y in 0..height {
            for (x, _) in picture.row(y).iter().enumerate().filter(|(_, gray)| **gray < 128) {
                (sum_x, sum_y, count) = (sum_x + x as f64, sum_y + y as f64, count + 1.0);
            }
        }
        let (x, y) = (sum_x / (count * width as f64) - 0.5, sum_y / (count * height as f64) - 0.5);
        match (x, y) {
            (x, y) if x.abs().max(y.abs()) < 0.15 => "around its middle",
            (x, y) if y.abs() >= x.abs() => {
                if y > 0.0 {
                    "towards its bottom"
                } else {
                    "towards its top"
                }
            }
            (x, _) if x > 0.0 => "towards its right",
            _ => "towards its left",
        }
    }

    /// The tilt, where the recording shows another one than given.
    fn tilt(&self) -> Option<Finding> {
        if self.lens != GivenLens::Fits {
            return None;
        }
        let (roll_deg, pitch_deg) = (self.rig.roll_rad.to_degrees(), self.rig.pitch_rad.to_degrees());
        let Some(tilt) = self.tracking.found.as_ref().and_then(|found| found.tilt.as_ref()) else {
            let measured = format!("no other was found than {}", given(roll_deg, pitch_deg));
            return Some(match self.tracking.at_rest_px() {
                Some(_) => unknown("tilt", "deg", AT_REST.to_owned(), DRIVE),
                None if self.tracking.steps.is_empty() => {
                    unknown("tilt", "deg", NOT_TRACKED.to_owned(), DRIVE)
                }
                None => found("tilt", (0.0, "deg"), Judgement::Good, measured, ""),
            });
        };
        let (roll, pitch) = (tilt.roll_rad.to_degrees(), tilt.pitch_rad.to_degrees());
        let by_deg = (roll - roll_deg).abs().max((pitch - pitch_deg).abs());
        Some(found(
            "tilt",
            (by_deg, "deg"),
            // docs/ground.md: 0.2° bend a path of 9 m by 7 mm in a live run.
            Judgement::of(by_deg, 0.1, 20.0),
            format!(
                "roll {:+.2}° and pitch {:+.2}°, not {}",
                Rounded(roll),
                Rounded(pitch),
                given(roll_deg, pitch_deg)
            ),
            "a recorded run corrects it; for live runs measure it (odograph ground) and give --rig",
        ))
    }

    /// The lens, where the recording shows another one than given.
    fn found_lens(&self) -> Option<Finding> {
        if self.lens != GivenLens::Fits {
            return None;
        }
        let lens = self.tracking.found.as_ref()?.lens.as_ref()?;
        let off_px = lens.off_from_px(self.camera);
        Some(found(
            "lens",
            (off_px, "px"),
            Judgement::of(off_px, 0.1, 20.0),
            format!("differs from the camera file by {off_px:.1} px at the edge of the image"),
            "calibrate again, at the zoom, focus and size of the recording: odograph calibrate",
        ))
    }
}

/// The nominal tilt, degrees; a rig with a height alone looks straight down.
fn given(roll_deg: f64, pitch_deg: f64) -> String {
    match (roll_deg, pitch_deg) {
        (0.0, 0.0) => "straight down".to_owned(),
        _ => format!("the given {:+.2}° and {:+.2}°", Rounded(roll_deg), Rounded(pitch_deg)),
    }
}

/// A readout time with a smaller standard deviation is known, seconds.
const KNOWN_S: f64 = 1e-3;

/// Usual rolling shutters are read out within this time, seconds.
const LONGEST_USUAL_S: f64 = 1.0 / 30.0;

/// Blur below this cannot be distinguished from the texture, pixels.
const LEAST_BLUR_PX: f64 = 3.0;

/// How many frames are lost; `most` is the most frequent reason and how many frames have it.
fn losses_text(lost: usize, frames: usize, most: (usize, Option<LossReason>)) -> String {
    let mostly = if most.0 < lost { "mostly " } else { "" };
    let why = most.1.map_or_else(String::new, |reason| format!(", {mostly}because of {}", in_words(reason)));
    let have = if lost == 1 { "has" } else { "have" };
    format!("{lost} of {frames} frames {have} no pose{why}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn judgements_are_ordered_and_thresholds_inclusive() {
        assert!(Judgement::Good < Judgement::Unknown && Judgement::Unknown < Judgement::Limits);
        assert!(Judgement::Limits < Judgement::Spoils);
        assert_eq!(Judgement::of(0.9, 1.0, 2.0), Judgement::Good);
        assert_eq!(Judgement::of(1.0, 1.0, 2.0), Judgement::Limits);
        assert_eq!(Judgement::of(2.0, 1.0, 2.0), Judgement::Spoils);
    }

    #[test]
    fn only_one_of_several_reasons_is_most_frequent() {
        let text = |lost, count, reason| losses_text(lost, 300, (count, reason));
        assert_eq!(text(0, 0, None), "0 of 300 frames have no pose");
        assert_eq!(
            text(1, 1, Some(LossReason::Bare)),
            "1 of 300 frames has no pose, because of too little texture"
        );
        assert_eq!(
            text(3, 3, Some(LossReason::Bare)),
            "3 of 300 frames have no pose, because of too little texture"
        );
        assert_eq!(
            text(3, 2, Some(LossReason::Bare)),
            "3 of 300 frames have no pose, mostly because of too little texture"
        );
    }
}
