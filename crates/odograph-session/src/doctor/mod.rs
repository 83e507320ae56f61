//! Examination of a recording before it is run: what will limit the accuracy, and what to change.
//!
//! Some 300 frames are looked at, in stretches of consecutive ones spread over the recording: their
//! images, and how the tracker follows them. Each [`Finding`] has a measure, its unit, a
//! [`Judgement`], and what to do about it. Thresholds are derived from measurements where their
//! comment says so, and otherwise chosen.

mod appearance;
mod findings;
mod intervals;
mod lens;
mod stretches;
mod tracking;

use crate::builder::RunBuilder;
use crate::mask;
use crate::observer::Observer;
use appearance::Appearance;
use findings::Seen;
pub use findings::{Finding, Judgement};
use intervals::Intervals;
use odograph::error::{Error, Result};
use odograph::fixed_pattern::{FixedPattern, ImageMask};
use odograph_video::Source;
use serde::Serialize;
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
        let fixed = FixedPattern::new(size);
        let mut looked_at = Looked {
            appearance: Appearance::new(size, plan.odometry.detection),
            fixed: given.into_iter().fold(fixed, FixedPattern::with_given),
            tracking: Tracking::new(&plan),
            times_s: Vec::new(),
            frames: 0,
        };
        let stretches = stretches::of(info.frame_count);
        observer.tracking_begins(Some(stretches.iter().map(|one| one.end - one.start).sum()));
        for stretch in &stretches {
            if !looked_at.pass_to(stretch.start, &mut source, observer)? {
                break;
            }
            if !looked_at.follow_to(stretch.end, &mut source, Stretch::new(&plan)?, observer)? {
                break;
            }
        }
        observer.tracking_ends();
        let seen = Seen {
            size,
            lens,
            camera: &plan.camera,
            rig: &plan.rig,
            intervals: Intervals::new(&looked_at.times_s),
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
        })
    }
}

/// What the frames have shown so far.
struct Looked {
    appearance: Appearance,
    fixed: FixedPattern,
    tracking: Tracking,
    /// Times of all frames, those that were only passed included.
    times_s: Vec<f64>,
    /// Frames that were looked at.
    frames: u64,
}

impl Looked {
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

    /// Looks at consecutive frames. Returns false at the end of the recording.
    fn follow_to(
        &mut self,
        end: u64,
        source: &mut Source,
        mut stretch: Stretch,
        observer: &dyn Observer,
    ) -> Result<bool> {
        let mut more = true;
        while (self.times_s.len() as u64) < end {
            check_stop(observer)?;
            let Some(frame) = source.next_frame()? else {
                more = false;
                break;
            };
            self.times_s.push(frame.time_s);
            self.frames += 1;
            self.fixed.look(&frame.gray);
            let look = self.appearance.look(&frame.gray);
            let estimate = stretch.follow(frame, look, &mut self.tracking)?;
            observer.frame(&estimate);
        }
        stretch.end(&mut self.tracking);
        Ok(more)
    }
}

fn check_stop(observer: &dyn Observer) -> Result<()> {
    match observer.is_stop_asked() {
        true => Err(Error::output("interrupted before the recording was examined")),
        false => Ok(()),
    }
}
