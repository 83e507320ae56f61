//! Fixed-pattern noise that competes with the ground: a dirty window, the columns of a sensor in
//! the dark, a thermal camera.
//!
//! Where the pattern is weaker, the static gradients of [`crate::fixed_pattern::FixedPattern`] are
//! all over the image. Where it is stronger, the tracker follows the pattern, and the camera seems
//! to stand. Differences between images are free of the pattern: three images at equal intervals
//! have two differences, and where the ground moves below the pattern, the second is the first,
//! shifted by the motion. Light that changes while the camera stands leaves differences, too, but
//! they are not shifted (`docs/math/fixed-pattern.md`).

use super::Odometry;
use super::last_pose::seen_apart;
use super::texture::is_bare;
use crate::camera::PosedCamera;
use crate::fixed_pattern::{NonuniformityCorrection, SinceLast};
use crate::geometry::{GroundPose, Pixel};
use crate::image::{GrayImage, Pyramid, noise_variance};
use crate::motion::{CoarseOptions, GroundView};
use std::collections::VecDeque;

/// Search for fixed-pattern noise, and its correction.
#[derive(Debug, Default)]
pub struct PatternNoise {
    correction: Option<NonuniformityCorrection>,
    is_active: bool,
    /// Images an interval apart, with the poses that the tracker gave them.
    earlier: VecDeque<(GrayImage, Option<GroundPose>)>,
    /// Frames since the last of them in which the tracker was away from its pose there.
    away: u64,
    /// Memory of an image that is no longer needed, for the next one.
    spare: Option<GrayImage>,
    /// The ground was seen to move and is assumed to go on until this frame.
    moves_until: u64,
    /// The next look is not before this frame, and the time from it to the one after it: a look
    /// takes as long as ten frames, and the time between fruitless ones doubles.
    not_before: u64,
    patience: u64,
}

/// Frames from one image to the next: ground that moves by one to some thirty pixels a frame
/// then overlaps, and has moved by more than the size of its texture.
const INTERVAL: u64 = 8;

/// While the ground moves, every second image is added to the mean.
const LEARNED_EVERY: u64 = 2;

/// Motion below which the tracker stands, and least motion of the ground, pixels in an interval.
const STANDS_PX: f64 = 2.0;
const MOVES_PX: f64 = 6.0;

/// The tracker moves if it is away from where it was in at least this many frames of an interval: a
/// camera that vibrates on the spot may be back at the end of it.
const AWAY_FRAMES: u64 = INTERVAL / 2;

/// Least way of the tracker in two intervals in which a pattern is learned, pixels: a camera that
/// vibrates on the spot would learn the ground.
const GOES_ON_PX: f64 = 24.0;

/// Poses explain the change between two images if less than this part of its square, without that
/// of the noise, is left where the same ground is compared.
const UNEXPLAINED: f64 = 0.5;

/// Pixels from one that is compared to the next.
const COMPARED_EVERY: usize = 4;

/// Largest turn in an interval, radians: 75°/s at 30 frames/s.
const MOST_TURN_RAD: f64 = 0.35;

/// Least score of the registration of two differences, of which chance reaches eight, and the part
/// of the view that must move alike, and at the same time stay alike. Where a person walks by, no
/// part does both.
const LEAST_SCORE: f64 = 12.0;
const LEAST_AGREEMENT: f64 = 0.85;

/// The correction is used after this many images of moving ground: with those of one interval, in
/// which a person may have walked by, it has seven.
const ENOUGH_SAMPLES: u32 = 12;

/// Least strength of the pattern in an image from which more of it is learned.
const IS_THERE: f64 = 0.5;

/// Longest time from one fruitless look to the next, frames.
const MOST_PATIENCE: u64 = 256;

/// How the ground moves.
enum MotionBelow {
    NotDue,
    /// The images change, but not as moving ground does.
    Unclear,
    None,
    /// The tracker moves.
    Followed,
    /// The ground moves, and the tracker stands or is lost.
    NotFollowed,
}

impl PatternNoise {
    /// With a pattern that is known from the beginning.
    pub fn known(correction: NonuniformityCorrection) -> Self {
        Self { correction: Some(correction), is_active: true, ..Self::default() }
    }

    /// The correction, where there is such a pattern.
    pub fn correction(&self) -> Option<&NonuniformityCorrection> {
        self.correction.as_ref().filter(|_| self.is_active)
    }

    /// Whether a pattern is being learned, or corrected.
    pub fn is_suspected(&self) -> bool {
        self.correction.is_some()
    }

    /// The ground has moved up to this image, and is assumed to go on.
    fn learn_while_it_moves(&mut self, image: &GrayImage, frame: u64) {
        let correction = self.correction.get_or_insert_with(|| {
            let mut correction = NonuniformityCorrection::new((image.width(), image.height()));
            self.earlier.iter().for_each(|(earlier, _)| correction.learn(earlier));
            correction
        });
        if frame >= self.moves_until {
            correction.learn(image);
        }
        self.moves_until = frame + INTERVAL + 1;
    }

    fn look_again_at_once(&mut self) {
        (self.patience, self.not_before) = (0, 0);
    }

    fn look_later(&mut self, frame: u64) {
        self.patience = (2 * self.patience).clamp(INTERVAL, MOST_PATIENCE);
        self.not_before = frame + self.patience;
        self.correction = None;
    }

    /// A copy of an image before its correction, if something is to be learned from it.
    pub fn keep(&mut self, image: &GrayImage, frame: u64) -> Option<GrayImage> {
        let is_learning = self.correction.is_some() && frame.is_multiple_of(LEARNED_EVERY);
        let is_due = self.is_active || is_learning || frame.is_multiple_of(INTERVAL);
        is_due.then(|| {
            let mut copy = self.spare.take().unwrap_or_else(|| GrayImage::new(0, 0));
            copy.resize(image.width(), image.height());
            copy.samples_mut().copy_from_slice(image.samples());
            copy
        })
    }
}

impl Odometry {
    /// Learns the pattern from a frame's image as the camera saw it, and the pose it was given.
    pub(super) fn learn_pattern(
        &mut self,
        seen: Option<GrayImage>,
        pose: Option<GroundPose>,
        since_last: SinceLast,
    ) {
        self.pattern_noise.away += u64::from(self.is_away(pose.as_ref()));
        let Some(image) = seen else { return };
        self.learn_from(&image, since_last);
        if self.pattern_noise.is_active || !self.frames.is_multiple_of(INTERVAL) {
            self.pattern_noise.spare = Some(image);
            return;
        }
        let motion = self.look_for_motion(&image, pose.as_ref());
        let goes_on = self.fixed.is_everywhere() && self.goes_on(pose.as_ref());
        let (frame, noise) = (self.frames, &mut self.pattern_noise);
        noise.away = 0;
        match motion {
            MotionBelow::NotDue => {}
            MotionBelow::Unclear => noise.look_later(frame),
            MotionBelow::None => noise.look_again_at_once(),
            MotionBelow::Followed => {
                noise.look_again_at_once();
                if goes_on {
                    noise.learn_while_it_moves(&image, frame);
                }
            }
            MotionBelow::NotFollowed => {
                noise.look_again_at_once();
                noise.learn_while_it_moves(&image, frame);
                self.standing.suspect(pose);
            }
        }
        noise.earlier.push_back((image, pose));
        if noise.earlier.len() > 2 {
            noise.spare = noise.earlier.pop_front().map(|(image, _)| image);
        }
    }

    /// Adds an image to the mean if the ground has moved since the last one.
    fn learn_from(&mut self, image: &GrayImage, since_last: SinceLast) {
        let (frame, noise) = (self.frames, &mut self.pattern_noise);
        let moves = since_last == SinceLast::Moved || !noise.is_active && frame < noise.moves_until;
        if let Some(correction) = noise.correction.as_mut().filter(|_| moves)
            && (!noise.is_active || correction.strength(image) > IS_THERE)
        {
            correction.learn(image);
            if !noise.is_active && correction.samples() >= ENOUGH_SAMPLES {
                self.correct_from_now_on();
            }
        }
    }

    /// Whether a pose differs from that of the last image an interval apart.
    fn is_away(&self, pose: Option<&GroundPose>) -> bool {
        let before = self.pattern_noise.earlier.back().and_then(|(_, before)| before.as_ref());
        before.zip(pose).is_some_and(|(before, pose)| self.moves_px(before, pose) > STANDS_PX)
    }

    /// Whether a pose is far from that two intervals ago.
    fn goes_on(&self, pose: Option<&GroundPose>) -> bool {
        let first = self.pattern_noise.earlier.front().and_then(|(_, first)| first.as_ref());
        first.zip(pose).is_some_and(|(first, pose)| self.moves_px(first, pose) > GOES_ON_PX)
    }

    fn moves_px(&self, from: &GroundPose, to: &GroundPose) -> f64 {
        seen_apart(from, to) * self.camera.focal_px().0
    }

    /// Whether the ground has moved from the last image but one to the last, and on to this one,
    /// while the tracker stood or was lost.
    fn look_for_motion(&self, image: &GrayImage, pose: Option<&GroundPose>) -> MotionBelow {
        let noise = &self.pattern_noise;
        let mut earlier = noise.earlier.iter();
        let (Some((first, _)), Some((second, before))) = (earlier.next(), earlier.next()) else {
            return MotionBelow::NotDue;
        };
        if self.is_away(pose) || noise.away >= AWAY_FRAMES {
            return MotionBelow::Followed;
        }
        if self.frames < noise.not_before {
            return MotionBelow::NotDue;
        }
        let change = difference(image, second);
        if is_bare(&change) {
            return MotionBelow::None;
        }
        if before
            .zip(pose)
            .is_some_and(|(before, pose)| self.explain(&change, [(second, &before), (image, pose)]))
        {
            return MotionBelow::Followed;
        }
        let from = before.unwrap_or(self.first_pose);
        let registration = self.recovery.registration();
        let view = |image| registration.view(&Pyramid::new(image, self.config.flow.levels), None, &from);
        let moves = |before: GroundView, now: GroundView| {
            let options =
                CoarseOptions { heading_rad: (0.0, MOST_TURN_RAD), scale_free: false, hypotheses: 1 };
            registration.register(&before, &now, &options).first().is_some_and(|found| {
                found.score > LEAST_SCORE
                    && found.agreement > LEAST_AGREEMENT
                    && self.moves_px(&from, &found.pose(&from, &from)) > MOVES_PX
            })
        };
        let stays = || {
            let views = view(second.clone()).zip(view(image.clone()));
            let share = views.map(|(before, now)| registration.static_share(&before, &now));
            self.fixed.is_everywhere() || share.is_some_and(|share| share > LEAST_AGREEMENT)
        };
        let is_below_a_pattern =
            view(difference(second, first)).zip(view(change)).is_some_and(|(a, b)| moves(a, b)) && stays();
        if is_below_a_pattern { MotionBelow::NotFollowed } else { MotionBelow::Unclear }
    }

    /// Whether the poses of two images explain most of the change between them: a camera that
    /// vibrates by less than what counts as a movement, and not a pattern that hides the ground.
    fn explain(
        &self,
        change: &GrayImage,
        [(before, from), (now, to)]: [(&GrayImage, &GroundPose); 2],
    ) -> bool {
        let (camera, from) = (&self.camera, PosedCamera::new(&self.camera, *from));
        let noise = noise_variance(change);
        let (mut changes, mut left) = (0.0, 0.0);
        for y in (0..now.height()).step_by(COMPARED_EVERY) {
            for x in (0..now.width()).step_by(COMPARED_EVERY) {
                let then = camera.ray_from_pixel(Pixel::new(x as f64, y as f64)).and_then(|ray| {
                    let seen = from.see(to.ground_from_ray(ray)?)?;
                    before.bilinear(seen.pixel.x, seen.pixel.y)
                });
                let Some(then) = then else { continue };
                let change_from = |before: f64| (f64::from(now.row(y)[x]) - before).powi(2) - noise;
                changes += change_from(f64::from(before.row(y)[x]));
                left += change_from(then);
            }
        }
        left < UNEXPLAINED * changes
    }

    /// Removes the pattern from all images to come, and from the keyframe.
    fn correct_from_now_on(&mut self) {
        let noise = &mut self.pattern_noise;
        noise.is_active = true;
        noise.earlier.clear();
        // What was found in images with the pattern may have been the pattern.
        self.fixed.reset();
        (self.candidate, self.standing) = (None, Default::default());
        if let (Some(keyframe), Some(correction)) = (&mut self.keyframe, &noise.correction) {
            keyframe.correct(correction, self.fixed.mask(), &self.config.detection);
            keyframe.prepare(&self.camera);
        }
    }
}

/// The change from one image to another, about middle gray.
fn difference(to: &GrayImage, from: &GrayImage) -> GrayImage {
    let mut change = to.clone();
    for (sample, before) in change.samples_mut().iter_mut().zip(from.samples()) {
        *sample = (128 + i16::from(*sample) - i16::from(*before)).clamp(0, 255) as u8;
    }
    change
}
