//! Follows a clip as `odograph run` and `odograph live` would.

use crate::clip::Clip;
use crate::processor::busy_ms;
use crate::rows::Follow;
use odograph::camera::{Camera, Rig};
use odograph::error::Result;
use odograph::motion::MotionModel;
use odograph::mounting::{Found, Untold};
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::slam::{Mapper, MemoryImages, SlamConfig, map_frames};
use odograph::trajectory::FrameEstimate;

/// What following a clip gave.
#[derive(Debug, Default)]
pub struct Followed {
    /// Every frame, in the map's frame where a map was made.
    pub frames: Vec<FrameEstimate>,
    /// Processor time of the odometry for each of them, milliseconds.
    pub times_ms: Vec<f64>,
    /// How often it began again because the mount or the lens was found not to be as told.
    pub restarts: usize,
}

/// What one pass over a clip ended with.
enum Pass {
    Finished(Followed),
    /// The camera is not as it was told.
    Again(Box<Found>),
}

/// Follows a clip from its first frame to its last.
pub fn follow(clip: &Clip, follow: Follow, model: MotionModel) -> Result<Followed> {
    let mut config = OdometryConfig::default();
    config.motion.model = model;
    let watched = follow != Follow::Live && model == MotionModel::Auto;
    let (mut camera, mut rig) = (clip.camera.clone(), clip.rig);
    let mut watch = watched.then(|| Untold::new(&camera, &rig));
    let mut restarts = 0;
    loop {
        match pass(clip, follow, &config, &camera, rig, watch)? {
            Pass::Finished(followed) => return Ok(Followed { restarts, ..followed }),
            Pass::Again(found) => {
                rig = found.rig(&rig);
                camera = found.camera(&camera);
                watch = Some(Untold::found(&camera, &rig, &found));
                restarts += 1;
            }
        }
    }
}

fn pass(
    clip: &Clip,
    follow: Follow,
    config: &OdometryConfig,
    camera: &Camera,
    rig: Rig,
    mut watch: Option<Untold>,
) -> Result<Pass> {
    let mut odometry = Odometry::new(camera.clone(), rig, *config)?;
    let mut mapper = (follow == Follow::Mapped).then(|| {
        odometry.tell_keyframes();
        (Mapper::new(camera, rig, config, SlamConfig::default()), MemoryImages::default())
    });
    let mut followed = Followed::default();
    let mut references = Vec::new();
    for (time_s, image) in &clip.frames {
        // A decoder would hand the image over; the copy is not timed.
        let image = image.clone();
        let begun = busy_ms();
        let frame = odometry.process(image, *time_s)?;
        followed.times_ms.push(busy_ms() - begun);
        if let Some(found) = watch.as_mut().and_then(|watch| watch.watch(&frame, &odometry.global_tracks())) {
            return Ok(Pass::Again(Box::new(found)));
        }
        followed.frames.push(frame);
        if let Some((mapper, images)) = &mut mapper {
            references.push(odometry.reference());
            for event in odometry.take_keyframe_events() {
                mapper.take(event, None, images)?;
            }
        }
    }
    if let Some(found) = watch.as_ref().and_then(Untold::at_end) {
        return Ok(Pass::Again(Box::new(found)));
    }
    if let Some((mapper, _)) = &mut mapper {
        mapper.finish();
        followed.frames = map_frames(mapper, &followed.frames, &references);
    }
    Ok(Pass::Finished(followed))
}
