//! The last keyframes, to be taken up again when the camera comes back to them.

use super::Keyframe;
use super::overlap::{image_grid, overlap};
use crate::camera::Camera;
use crate::detection::DetectionConfig;
use crate::fixed_pattern::ImageMask;
use crate::geometry::GroundPose;
use crate::motion::ViewingPose;
use crate::odometry::OdometryConfig;
use std::collections::VecDeque;
use std::sync::{Arc, OnceLock};

/// The last keyframes, to be taken up again when the camera comes back to them.
#[derive(Debug)]
pub struct KeyframeMemory {
    records: VecDeque<Remembered>,
    most: usize,
    /// What is known by now not to be ground, and how corners are sought where one lies there.
    mask: Option<(Arc<ImageMask>, DetectionConfig)>,
}

#[derive(Debug)]
struct Remembered {
    keyframe: Keyframe,
    /// Whether its pose is connected with the present one by measurement.
    reachable: bool,
}

impl Remembered {
    /// Whether it is connected with the present by measurement, and shows the ground for sure.
    fn shows_ground(&self) -> bool {
        self.reachable && !self.keyframe.was_on_trial
    }
}

impl KeyframeMemory {
    pub fn new(most: usize) -> Self {
        Self { records: VecDeque::new(), most, mask: None }
    }

    /// Keeps a keyframe that is no longer in use.
    pub fn remember(&mut self, keyframe: Keyframe) {
        self.records.push_back(Remembered { keyframe: keyframe.retired(), reachable: true });
        while self.records.len() > self.most {
            self.records.pop_front();
        }
    }

    /// Removes and returns a keyframe with its overlap: the part of its image that a camera at
    /// `pose` sees. It is the one with the largest overlap if that is at least `most`, otherwise,
    /// of those with an overlap of at least `least`, the one whose pose is known best.
    pub fn take_best(
        &mut self,
        camera: &Camera,
        pose: &GroundPose,
        (least, most): (f64, f64),
    ) -> Option<(f64, Keyframe)> {
        let seen = ViewingPose::new(*pose);
        let rays = image_grid(camera);
        let in_view: Vec<(f64, usize)> = (self.records.iter().enumerate())
            .map(|(i, record)| (overlap(&record.keyframe.pose, &rays, camera, &seen), i))
            .filter(|(overlap, _)| *overlap >= least)
            .collect();
        let spread_m2 = |i: usize| self.records[i].keyframe.spread_m2();
        let best = in_view.iter().filter(|(overlap, _)| *overlap >= most).max_by(|a, b| a.0.total_cmp(&b.0));
        let surest = || in_view.iter().min_by(|a, b| spread_m2(a.1).total_cmp(&spread_m2(b.1)));
        let &(overlap, index) = best.or_else(surest)?;
        Some((overlap, self.take(index, camera)?))
    }

    /// Sets height and tilt of all records to those of `mount`, if given.
    pub fn recalibrate(&mut self, mount: Option<&GroundPose>) {
        for Remembered { keyframe, .. } in &mut self.records {
            keyframe.view = OnceLock::new();
            if let Some(mount) = mount {
                keyframe.pose = keyframe.pose.with_mount_of(mount);
                (keyframe.surface, keyframe.undulates) = (None, false);
            }
        }
    }

    /// Halves the resolution of all records.
    pub fn halve(&mut self, mask: Option<&Arc<ImageMask>>, config: &OdometryConfig) {
        self.mask = None;
        let records = std::mem::take(&mut self.records).into_iter();
        self.records.extend(records.map(|Remembered { keyframe, reachable }| Remembered {
            keyframe: keyframe.halved(mask, config).retired(),
            reachable,
        }));
    }

    /// More is known about what is not ground.
    pub fn set_mask(&mut self, mask: &Arc<ImageMask>, detection: &DetectionConfig) {
        self.mask = Some((mask.clone(), *detection));
    }

    /// Takes out the newest of those keyframes.
    pub fn take_newest(&mut self, camera: &Camera) -> Option<Keyframe> {
        let newest = *self.newest().first()?;
        self.take(newest, camera)
    }

    /// Takes out the keyframe with that index.
    pub fn take(&mut self, index: usize, camera: &Camera) -> Option<Keyframe> {
        let mut keyframe = self.records.remove(index)?.keyframe;
        if let Some((mask, detection)) = &self.mask
            && keyframe.mask.as_ref().is_none_or(|known| !Arc::ptr_eq(known, mask))
        {
            keyframe.set_mask(mask, detection);
        }
        keyframe.prepare(camera);
        Some(keyframe)
    }

    /// Puts a keyframe back where [`KeyframeMemory::take`] took it from.
    pub fn put_back_at(&mut self, index: usize, keyframe: Keyframe) {
        let record = Remembered { keyframe: keyframe.retired(), reachable: true };
        self.records.insert(index.min(self.records.len()), record);
    }

    /// Starts a new segment: remembered keyframes are no longer connected to the present pose.
    pub fn close_segment(&mut self) {
        self.records.iter_mut().for_each(|record| record.reachable = false);
    }

    /// How many keyframes a lost frame may be looked for in: those that are connected with the
    /// present by measurement, and show the ground for sure.
    pub fn reachable(&self) -> usize {
        self.records.iter().filter(|record| record.shows_ground()).count()
    }

    /// The indices of those keyframes, the newest first.
    pub fn newest(&self) -> Vec<usize> {
        (0..self.records.len()).rev().filter(|&index| self.records[index].shows_ground()).collect()
    }

    /// The indices of those keyframes, the nearest to a pose first.
    pub fn nearest(&self, pose: &GroundPose) -> Vec<usize> {
        let away = |index: usize| self.records[index].keyframe.pose.distance_m(pose);
        let mut indices = self.newest();
        indices.sort_by(|&a, &b| away(a).total_cmp(&away(b)));
        indices
    }
}
