//! The mosaic as it is laid while the frames come.

use crate::timings::Timings;
use crate::views::{Posed, Views};
use odograph::camera::Camera;
use odograph::error::Error;
use odograph::geometry::{PlaneTransform, Sim2};
use odograph::mosaic::Mosaic;
use std::path::Path;
use std::time::Instant;

/// The mosaic so far, and the frames of which it is laid again at the end, where they then are.
pub struct Laying {
    camera: Camera,
    /// Whether somebody can look at the mosaic.
    shown: bool,
    mosaic: Mosaic,
    /// Where frames are laid: as odometry has them, until a loop has moved that.
    correction: Sim2,
    views: Views,
    /// Of the first frame that could not be kept.
    failure: Option<Error>,
    times: Timings,
    /// The frame before, where it was not laid: laid after all when it turns out to be the last of
    /// its stretch.
    before: Option<Posed>,
}

/// What laying leaves beside the mosaic.
pub struct Kept {
    pub views: Views,
    /// Why not all frames could be kept of which the mosaic is laid again.
    pub failure: Option<Error>,
    /// How long each frame took.
    pub times: Timings,
}

impl Laying {
    /// Of a run that writes into `folder`. Where nobody can look, frames are only kept for the end.
    pub fn new(camera: Camera, folder: &Path, shown: bool) -> Self {
        Self {
            views: Views::new(&camera, folder),
            camera,
            shown,
            mosaic: Mosaic::new(Default::default()),
            correction: Sim2::IDENTITY,
            failure: None,
            times: Timings::default(),
            before: None,
        }
    }

    /// The ground so far.
    pub fn mosaic(&self) -> &Mosaic {
        &self.mosaic
    }

    /// Goes on upon a ground that was laid anew, with frames corrected from now on.
    pub fn go_on(&mut self, mosaic: Mosaic, correction: Sim2) {
        (self.mosaic, self.correction) = (mosaic, correction);
    }

    /// Lays a frame where it shows something new.
    pub fn next(&mut self, posed: Posed) {
        let started = Instant::now();
        if let Some(before) = self.before.take().filter(|before| before.segment != posed.segment) {
            self.lay(&before);
        }
        if self.failure.is_none() {
            self.failure = self.views.next(posed.clone()).err();
        }
        if self.shown {
            if self.mosaic.wants(&self.camera, &self.correction.apply_to_pose(&posed.pose)) {
                self.lay(&posed);
            } else {
                self.before = Some(posed);
            }
        }
        self.times.push(started.elapsed());
    }

    fn lay(&mut self, posed: &Posed) {
        let pose = self.correction.apply_to_pose(&posed.pose);
        if posed.frame.has_color() {
            self.mosaic.add(&posed.frame.rgb(), &self.camera, &pose);
        } else {
            self.mosaic.add(&posed.frame.gray, &self.camera, &pose);
        }
    }

    /// The mosaic with the last frame on it, and the rest.
    pub fn finished(mut self) -> (Mosaic, Kept) {
        if let Some(before) = self.before.take() {
            self.lay(&before);
        }
        let Self { mosaic, views, failure, times, .. } = self;
        (mosaic, Kept { views, failure, times })
    }
}
