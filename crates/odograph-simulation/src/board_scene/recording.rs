//! A recording of a board that is shown to a camera.

use super::{BoardEffects, BoardScene, Framing, mix};
use nalgebra::{Isometry3, Translation3};
use odograph::error::{Error, Result};
use odograph::image::GrayImage;

/// A board that is moved from place to place in front of a camera at rest and held still at each:
/// in every part of the image, near and far, tilted to all sides. Each frame can be rendered
/// independently, in any order and from any thread.
#[derive(Debug, Clone)]
pub struct BoardRecording {
    scene: BoardScene,
    effects: BoardEffects,
    /// Where the board is held; one more than times it is moved.
    camera_from_board: Vec<Isometry3<f64>>,
    times_s: Vec<f64>,
}

/// Time from one place to the next, and the part of it during which the board is held still,
/// seconds.
const PLACE_S: f64 = 1.0;
const STILL_S: f64 = 0.5;
/// Maximum number of frames.
const MAX_FRAMES: f64 = 1e6;

impl BoardRecording {
    /// The recording of a scene at `fps` frames per second for `duration_s` seconds. The first
    /// place is held from time 0, and another one from every full second. Places and noise follow
    /// from `seed`; [`BoardEffects::seed`] is not used.
    ///
    /// # Errors
    /// If frame rate or duration are not positive, or the recording has more than a million frames.
    pub fn new(
        scene: BoardScene,
        effects: BoardEffects,
        fps: f64,
        duration_s: f64,
        seed: u64,
    ) -> Result<Self> {
        for (name, value) in [("frame rate", fps), ("duration", duration_s)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::usage(format!("the {name} is {value:?}; it must be above 0")));
            }
        }
        if duration_s * fps >= MAX_FRAMES {
            return Err(Error::usage(format!(
                "{duration_s:?} s at {fps:?} frames per second are too many frames; {MAX_FRAMES:.0} are the limit"
            )));
        }
        let framing = if scene.board().may_be_partial() { Framing::Partial } else { Framing::Whole };
        let places = (duration_s / PLACE_S).floor() as usize + 2;
        let last = (duration_s * fps + 1e-6).floor() as u64;
        Ok(Self {
            camera_from_board: scene.poses(places, framing, seed),
            effects: BoardEffects { seed, ..effects },
            times_s: (0..=last).map(|tick| tick as f64 / fps).collect(),
            scene,
        })
    }

    /// The scene.
    pub fn scene(&self) -> &BoardScene {
        &self.scene
    }

    /// Times of all frames, seconds, ascending; at least one.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    /// The true pose of the board at a time, seconds.
    pub fn camera_from_board(&self, time_s: f64) -> Isometry3<f64> {
        let last = self.camera_from_board.len() - 1;
        let place = ((time_s / PLACE_S).max(0.0).floor() as usize).min(last);
        let (from, to) = (self.camera_from_board[place], self.camera_from_board[(place + 1).min(last)]);
        let moved = ((time_s - place as f64 * PLACE_S - STILL_S) / (PLACE_S - STILL_S)).clamp(0.0, 1.0);
        // From rest to rest.
        let share = moved * moved * (3.0 - 2.0 * moved);
        // The middle of the board moves along a line while the board turns about it.
        let middle = self.scene.middle();
        let way = (from * middle).coords.lerp(&(to * middle).coords, share);
        let rotation = from.rotation.try_slerp(&to.rotation, share, 1e-9).unwrap_or(from.rotation);
        Isometry3::from_parts(Translation3::from(way - rotation * middle.coords), rotation)
    }

    /// Renders a frame by its index; `None` beyond the last.
    pub fn frame(&self, number: usize) -> Option<GrayImage> {
        let pose = self.camera_from_board(*self.times_s.get(number)?);
        let seed = mix(self.effects.seed ^ mix(number as u64));
        Some(self.scene.render(&pose, &BoardEffects { seed, ..self.effects.clone() }))
    }
}
