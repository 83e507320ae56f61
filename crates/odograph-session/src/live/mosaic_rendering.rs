//! Incremental rendering of the mosaic.

use crate::timings::Timings;
use crate::views::{MosaicFrames, Posed};
use odograph::camera::Camera;
use odograph::error::Error;
use odograph::fixed_pattern::ImageMask;
use odograph::geometry::{PlaneTransform, Sim2};
use odograph::mosaic::Mosaic;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// The mosaic so far, and the frames from which it is rendered again at the end, at their final
/// poses.
pub struct MosaicRendering {
    camera: Camera,
    /// Whether there may be viewers.
    shown: bool,
    mosaic: Mosaic,
    /// Correction of the poses: identity until a loop moves the map.
    correction: Sim2,
    views: MosaicFrames,
    /// Error of the first frame that could not be stored.
    failure: Option<Error>,
    times: Timings,
    /// The previous frame if it was not rendered: rendered if it turns out to be the last of its
    /// segment.
    before: Option<Posed>,
    /// The frames that were rendered last: their keyframes may not be in the map yet.
    recent: VecDeque<Posed>,
}

/// Number of frames in `recent`. Keyframes are in the map within a few frames.
const RECENT: usize = 8;

/// Results besides the mosaic.
pub struct MosaicRenderingSummary {
    pub views: MosaicFrames,
    /// Why not all frames for the final mosaic could be stored.
    pub failure: Option<Error>,
    /// Rendering time of each frame.
    pub times: Timings,
}

impl MosaicRendering {
    /// For a run with this output folder. Without viewers frames are only stored for the end.
    pub fn new(camera: Camera, folder: &Path, shown: bool) -> Self {
        Self {
            views: MosaicFrames::new(&camera, folder),
            camera,
            shown,
            mosaic: Mosaic::new(Default::default()),
            correction: Sim2::IDENTITY,
            failure: None,
            times: Timings::default(),
            before: None,
            recent: VecDeque::new(),
        }
    }

    /// The mosaic so far.
    pub fn mosaic(&self) -> &Mosaic {
        &self.mosaic
    }

    /// The frames whose images are stored for the end.
    pub fn views(&mut self) -> &mut MosaicFrames {
        &mut self.views
    }

    /// Continues on a newly rendered mosaic, with corrected frames. `has` tells which frames are in
    /// it; of the latest ones, those that are not are rendered.
    pub fn go_on(&mut self, mosaic: Mosaic, correction: Sim2, has: impl Fn(u64) -> bool) {
        (self.mosaic, self.correction) = (mosaic, correction);
        let mut latest: Vec<Posed> = self.views.undecided().chain(&self.recent).cloned().collect();
        latest.sort_by_key(|posed| posed.frame.number);
        latest.dedup_by_key(|posed| posed.frame.number);
        for posed in latest.iter().filter(|posed| !has(posed.frame.number)) {
            if self.mosaic.wants(&self.camera, &correction.apply_to_pose(&posed.pose)) {
                self.render(posed);
            }
        }
    }

    /// Renders a frame where it shows new ground, outside the mask.
    pub fn next(&mut self, posed: Posed, mask: Option<Arc<ImageMask>>) {
        let started = Instant::now();
        self.mosaic.set_mask(mask);
        if let Some(before) = self.before.take().filter(|before| before.segment != posed.segment) {
            self.render(&before);
        }
        if self.failure.is_none() {
            self.failure = self.views.next(posed.clone()).err();
        }
        if self.shown {
            if self.mosaic.wants(&self.camera, &self.correction.apply_to_pose(&posed.pose)) {
                self.render(&posed);
                self.recent.truncate(RECENT - 1);
                self.recent.push_front(posed);
            } else {
                self.before = Some(posed);
            }
        }
        self.times.push(started.elapsed());
    }

    fn render(&mut self, posed: &Posed) {
        let pose = self.correction.apply_to_pose(&posed.pose);
        if posed.frame.has_color() {
            self.mosaic.add(&posed.frame.rgb(), &self.camera, &pose);
        } else {
            self.mosaic.add(&posed.frame.gray, &self.camera, &pose);
        }
    }

    /// The mosaic with the last frame, and the rest.
    pub fn finished(mut self) -> (Mosaic, MosaicRenderingSummary) {
        if let Some(before) = self.before.take() {
            self.render(&before);
        }
        let Self { mosaic, views, failure, times, .. } = self;
        (mosaic, MosaicRenderingSummary { views, failure, times })
    }
}
