//! Selection of the frames of the mosaic.
//!
//! Keyframes show nearly all of the ground and are in the map anyway; a few more frames are kept
//! that show what no keyframe does. So a frame only costs a test of coverage, and the mosaic is
//! rendered once, at the end, at the final poses.

use crate::kept_frames::KeptFrames;
use crate::mapping::Mapping;
use odograph::camera::Camera;
use odograph::error::Result;
use odograph::geometry::GroundPose;
use odograph::ground_map::KeyframeImage;
use odograph::mosaic::{Coverage, Mosaic};
use odograph_map::FrameImages;
use odograph_video::Frame;
use std::panic::resume_unwind;
use std::path::Path;
use std::sync::mpsc;
use std::thread;

/// A frame with its pose in the odometry frame.
#[derive(Clone)]
pub struct Posed {
    pub frame: Frame,
    pub pose: GroundPose,
    pub segment: usize,
    /// Whether it became a keyframe; its image is then in the map.
    pub is_keyframe: bool,
}

/// Share of a frame's footprint that must be new for the frame to wait for the next keyframe, and
/// the share still new after that keyframe for the frame to be kept. In a curve this is the strip
/// on the outer side. Lower values leave fewer holes in the mosaic and need more disk space.
const WAITS_WHERE_NEW: f64 = 0.08;
const KEPT_WHERE_NEW: f64 = 0.01;
/// Largest number of frames that wait for a keyframe: more need more memory, fewer decide before
/// the keyframe has come.
const MAX_WAITING: usize = 8;

/// The frames of the mosaic.
pub struct MosaicFrames {
    covered: Coverage,
    waiting: Vec<Posed>,
    waiting_covers: Coverage,
    /// The previous frame, unless it waits or is a keyframe.
    before: Option<Posed>,
    images: FrameImages,
    /// Number of each frame with a stored image, and its pose in the odometry frame.
    kept: Vec<(u64, GroundPose)>,
}

impl MosaicFrames {
    /// For a run with this output folder.
    pub fn new(camera: &Camera, folder: &Path) -> Self {
        Self {
            covered: Coverage::new(camera),
            waiting: Vec::new(),
            waiting_covers: Coverage::new(camera),
            before: None,
            images: FrameImages::new(folder, (camera.width(), camera.height())),
            kept: Vec::new(),
        }
    }

    /// Adds the next frame with a pose. Fails where one cannot be stored.
    pub fn next(&mut self, posed: Posed) -> Result<()> {
        if self.segment().is_some_and(|segment| segment != posed.segment) {
            self.end_stretch()?;
        }
        if posed.is_keyframe {
            self.covered.add(&posed.pose);
            self.before = None;
            return self.keep_waiting();
        }
        if self.covered.share_new(Some(&self.waiting_covers), &posed.pose) < WAITS_WHERE_NEW {
            self.before = Some(posed);
            return Ok(());
        }
        self.waiting_covers.add(&posed.pose);
        self.waiting.push(posed);
        self.before = None;
        if self.waiting.len() > MAX_WAITING { self.keep_waiting() } else { Ok(()) }
    }

    /// Renders keyframes and kept frames at the poses of `frames` into an empty mosaic, decoding
    /// concurrently where `threads` allow.
    pub fn render(
        &mut self,
        mut mosaic: Mosaic,
        camera: &Camera,
        frames: &mut KeptFrames,
        mapping: &mut Mapping,
        threads: usize,
    ) -> Result<Mosaic> {
        self.end_stretch()?;
        let mut views: Vec<_> = mapping.own_keyframes().map(|(id, frame)| (frame, Some(id))).collect();
        views.extend(self.images.frames().map(|frame| (frame, None)));
        views.sort_unstable_by_key(|(frame, _)| *frame);
        let (mut posed, mut wanted) = (Vec::with_capacity(views.len()), views.into_iter().peekable());
        frames.each(|frame, _| {
            while let Some((number, keyframe)) = wanted.next_if(|(number, _)| *number <= frame.frame) {
                let known = frame.estimate.as_ref().filter(|_| number == frame.frame);
                posed.extend(known.map(|known| (number, keyframe, known.pose)));
            }
            Ok(())
        })?;
        let images = &mut self.images;
        let mut loaded = posed.into_iter().map(move |(number, keyframe, pose)| {
            let image = keyframe.map_or_else(|| images.load(number), |id| mapping.image(id));
            image.map(|image| (image, pose))
        });
        let mut render = |(KeyframeImage { gray, color }, pose): (KeyframeImage, GroundPose)| {
            match color {
                Some(color) => mosaic.add(&color, camera, &pose),
                None => mosaic.add(&gray, camera, &pose),
            };
        };
        if threads < 2 {
            loaded.try_for_each(|view| view.map(&mut render))?;
            return Ok(mosaic);
        }
        thread::scope(|scope| {
            let (load, decoded) = mpsc::sync_channel(1);
            let loading = scope.spawn(move || {
                loaded.try_for_each(|view| {
                    let _ = load.send(view?); // fails only where rendering has ended in a panic
                    Ok(())
                })
            });
            decoded.iter().for_each(render);
            loading.join().unwrap_or_else(|panic| resume_unwind(panic))
        })?;
        Ok(mosaic)
    }

    /// Segment of the last frame.
    fn segment(&self) -> Option<usize> {
        self.before.as_ref().or(self.waiting.last()).map(|posed| posed.segment)
    }

    /// Keeps the waiting frames and the last one, as far as they show new ground.
    fn end_stretch(&mut self) -> Result<()> {
        self.keep_waiting()?;
        match self.before.take() {
            Some(before) => self.keep(&before),
            None => Ok(()),
        }
    }

    fn keep_waiting(&mut self) -> Result<()> {
        self.waiting_covers.clear();
        let mut waiting = std::mem::take(&mut self.waiting);
        // The one that shows most comes first: the others may then show nothing new any more.
        while !waiting.is_empty() {
            let share_new = |posed: &Posed| self.covered.share_new(None, &posed.pose);
            waiting.retain(|posed| share_new(posed) >= KEPT_WHERE_NEW);
            let most =
                (0..waiting.len()).max_by(|&a, &b| share_new(&waiting[a]).total_cmp(&share_new(&waiting[b])));
            if let Some(most) = most {
                let posed = waiting.remove(most);
                self.keep(&posed)?;
            }
        }
        Ok(())
    }

    fn keep(&mut self, posed: &Posed) -> Result<()> {
        if self.covered.share_new(None, &posed.pose) < KEPT_WHERE_NEW {
            return Ok(());
        }
        self.covered.add(&posed.pose);
        let color = posed.frame.has_color().then(|| posed.frame.rgb());
        self.images.keep(posed.frame.number, &KeyframeImage { gray: posed.frame.gray.clone(), color })?;
        self.kept.push((posed.frame.number, posed.pose));
        Ok(())
    }
}

#[cfg(feature = "live")]
impl MosaicFrames {
    /// Number and pose in the odometry frame of each frame whose image is stored.
    pub fn kept(&self) -> &[(u64, GroundPose)] {
        &self.kept
    }

    /// The image of a frame that is stored.
    pub fn image(&mut self, frame: u64) -> Result<KeyframeImage> {
        self.images.load(frame)
    }

    /// The frames of which it is not decided whether their images are stored.
    pub fn undecided(&self) -> impl Iterator<Item = &Posed> {
        self.waiting.iter().chain(&self.before)
    }
}
