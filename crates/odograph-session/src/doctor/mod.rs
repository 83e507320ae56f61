//! Examination of a recording before it is run: what will limit the accuracy, and what to change.
//!
//! Some 300 frames are looked at, in stretches of consecutive ones spread over the recording: their
//! images, and how the tracker follows them. Each [`Finding`] has a measure, its unit, a
//! [`Judgement`], and what to do about it; an [`ExaminedFrame`] shows some of them. Thresholds are
//! derived from measurements where their comment says so, and otherwise chosen.

mod appearance;
mod findings;
mod intervals;
mod lens;
mod pictures;
mod stretches;
mod tracking;

use crate::builder::RunBuilder;
use crate::mask;
use crate::observer::Observer;
use crate::plan::RunPlan;
use appearance::Appearance;
use findings::Seen;
pub use findings::{Finding, Judgement};
use intervals::Intervals;
use odograph::error::{Error, Result};
use odograph::fixed_pattern::{FixedPattern, ImageMask};
use odograph::odometry::EarlierPass;
use odograph_video::Source;
pub use pictures::ExaminedFrame;
use pictures::Pictures;
use serde::Serialize;
use std::ops::Range;
use tracking::{Stretch, Tracking};

/// Result of the examination of a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Diagnosis {
    /// Format and size of the recording.
    pub description: String,
    /// Number of frames of the recording, where it says so.
    pub frames: Option<u64>,
    /// Number of frames that were looked at.
    pub frames_looked_at: u64,
    /// Time from the first to the last frame that was passed, seconds.
    pub duration_s: f64,
    /// What was found, good or not, in the order in which to read it.
    pub findings: Vec<Finding>,
    /// Defects of the recording, one sentence each.
    pub warnings: Vec<String>,
    /// Frames that show what was found.
    #[serde(skip)]
    pub pictures: Vec<ExaminedFrame>,
}

impl Diagnosis {
    /// The worst judgement.
    pub fn worst(&self) -> Judgement {
        self.findings.iter().map(|finding| finding.judgement).max().unwrap_or(Judgement::Good)
    }
}

impl RunBuilder {
    /// Examines the recording of the run and its camera; writes nothing. Unlike a run it needs
    /// neither a camera nor a height, and a camera file for another size is a finding.
    ///
    /// # Errors
    /// If the recording or a file that an option names cannot be read, if an option contradicts
    /// another, or if the observer asks to stop.
    pub fn examine(&self, observer: &dyn Observer) -> Result<Diagnosis> {
        let source = self.source.open()?;
        let size = (source.info().width, source.info().height);
        let (builder, lens) = lens::with_some_camera(self, size, observer)?;
        let (plan, mut source) = builder.plan_over(observer, |_| Ok((source, size)))?;
        let info = source.info().clone();
        let given = plan.mask.as_deref().map(mask::read).transpose()?;
        let given = given.map(|picture| ImageMask::from_picture(&picture));
        let given_share = given.as_ref().map_or(0.0, ImageMask::share);
        let stretches = stretches::of(info.frame_count);
        let rate_is_assumed = source.is_rate_assumed();
        let may_begin_again = plan.source.is_readable_again();
        let mut looked_at = Looked::new(size, &plan, given.clone());
        // Begins again as a run does: frames that were lost until a pattern that the camera adds,
        // or another mount or lens was known are not lost.
        let mut known = plan.clone();
        if let Some(pattern) = looked_at.look(&stretches, &mut source, &plan, may_begin_again, observer)? {
            known.images = pattern;
            source = known.source.open()?;
            looked_at = Looked::new(size, &known, given.clone());
            looked_at.look(&stretches, &mut source, &known, false, observer)?;
        }
        if let Some(found) = looked_at.tracking.found.clone()
            && may_begin_again
            && !looked_at.tracking.lost.is_empty()
        {
            (known.rig, known.camera) = (found.rig(&known.rig), found.camera(&known.camera));
            source = known.source.open()?;
            let mut again = Looked::new(size, &known, given);
            again.look(&stretches, &mut source, &known, false, observer)?;
            if again.tracking.lost.len() < looked_at.tracking.lost.len() {
                again.tracking.found = Some(found);
                looked_at = again;
            }
        }
        let seen = Seen {
            size,
            lens,
            camera: &plan.camera,
            rig: &plan.rig,
            intervals: Intervals::new(&looked_at.times_s),
            rate_is_assumed,
            coded: lens::bits_per_pixel(&self.source.path, &info, looked_at.times_s.len() as u64),
            appearance: &looked_at.appearance,
            tracking: &looked_at.tracking,
            fixed_share: looked_at.fixed.share() - given_share,
            fixed: &looked_at.fixed,
        };
        Ok(Diagnosis {
            findings: seen.findings(),
            description: info.description,
            frames: info.frame_count,
            frames_looked_at: looked_at.frames,
            duration_s: looked_at.times_s.last().zip(looked_at.times_s.first()).map_or(0.0, |(b, a)| b - a),
            warnings: source.take_warnings(),
            pictures: looked_at.pictures.frames(),
        })
    }
}

/// What the frames have shown so far.
struct Looked {
    appearance: Appearance,
    fixed: FixedPattern,
    tracking: Tracking,
    pictures: Pictures,
    /// Times of all frames, those that were only passed included.
    times_s: Vec<f64>,
    /// Frames that were looked at.
    frames: u64,
}

impl Looked {
    fn new(size: (usize, usize), plan: &RunPlan, given: Option<ImageMask>) -> Self {
        Self {
            appearance: Appearance::new(size, plan.odometry.detection),
            fixed: given.into_iter().fold(FixedPattern::new(size), FixedPattern::with_given),
            tracking: Tracking::new(plan),
            pictures: Pictures::default(),
            times_s: Vec::new(),
            frames: 0,
        }
    }

    /// Looks at all stretches. Where a pattern that the camera adds to its images may end that,
    /// returns it as soon as it is known.
    fn look(
        &mut self,
        stretches: &[Range<u64>],
        source: &mut Source,
        plan: &RunPlan,
        pattern_may_end: bool,
        observer: &dyn Observer,
    ) -> Result<Option<EarlierPass>> {
        observer.tracking_begins(Some(stretches.iter().map(|one| one.end - one.start).sum()));
        let mut pattern = None;
        for one in stretches {
            if !self.pass_to(one.start, source, observer)? {
                break;
            }
            let mut stretch = Stretch::new(plan)?;
            let more = self.follow_to(one.end, source, &mut stretch, pattern_may_end, observer)?;
            pattern = stretch.pattern().filter(|_| pattern_may_end);
            stretch.end(&mut self.tracking);
            if !more || pattern.is_some() {
                break;
            }
        }
        observer.tracking_ends();
        Ok(pattern)
    }

    /// Passes frames without looking at them. Returns false at the end of the recording.
    fn pass_to(&mut self, start: u64, source: &mut Source, observer: &dyn Observer) -> Result<bool> {
        while (self.times_s.len() as u64) < start {
            check_stop(observer)?;
            match source.skip_frame()? {
                Some(time_s) => self.times_s.push(time_s),
                None => return Ok(false),
            }
        }
        Ok(true)
    }

    /// Looks at consecutive frames, at most until a pattern is known that may end that. Returns
    /// false at the end of the recording.
    fn follow_to(
        &mut self,
        end: u64,
        source: &mut Source,
        stretch: &mut Stretch,
        pattern_may_end: bool,
        observer: &dyn Observer,
    ) -> Result<bool> {
        while (self.times_s.len() as u64) < end {
            check_stop(observer)?;
            let Some(frame) = source.next_frame()? else { return Ok(false) };
            self.times_s.push(frame.time_s);
            self.frames += 1;
            self.fixed.look(&frame.gray);
            let look = self.appearance.look(&frame.gray);
            let (image, steps) = ((frame.number, frame.gray.clone()), self.tracking.steps.len());
            let estimate = stretch.follow(frame, look, &mut self.tracking)?;
            let step_px = self.tracking.steps.get(steps).map(|step| step.most_px);
            self.pictures.look(image, &estimate, step_px, stretch.tracks());
            observer.frame(&estimate);
            if pattern_may_end && stretch.pattern().is_some() {
                break;
            }
        }
        Ok(true)
    }
}

fn check_stop(observer: &dyn Observer) -> Result<()> {
    match observer.is_stop_asked() {
        true => Err(Error::output("interrupted before the recording was examined")),
        false => Ok(()),
    }
}
