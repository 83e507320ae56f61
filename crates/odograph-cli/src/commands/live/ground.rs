//! The mosaic while it grows under the page's eyes.

use crate::commands::run::pipeline::{Laying, Posed};
use odograph::camera::Camera;
use odograph::mapping::{Mosaic, MosaicSquare};
use odograph_live::Ground;
use odograph_live::ground::GroundState;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The ground of a live run: laid by one thread, looked at by those of the page.
#[derive(Clone)]
pub struct LiveGround(Arc<Mutex<State>>);

enum State {
    Growing(Box<Laying>),
    /// Taken for writing.
    Away,
    Finished(Mosaic),
}

impl LiveGround {
    pub fn new(camera: Camera) -> Self {
        Self(Arc::new(Mutex::new(State::Growing(Box::new(Laying::new(camera))))))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lays a frame where it shows something new.
    pub fn lay(&self, posed: Posed) {
        if let State::Growing(laying) = &mut *self.state() {
            laying.next(posed);
        }
    }

    /// The finished ground and how long each frame took; nothing grows any more.
    pub fn finish(&self) -> (Mosaic, Vec<Duration>) {
        match std::mem::replace(&mut *self.state(), State::Away) {
            State::Growing(laying) => laying.finished(),
            State::Finished(mosaic) => (mosaic, Vec::new()),
            State::Away => (Mosaic::new(Default::default()), Vec::new()),
        }
    }

    /// Gives the finished ground back to those who look.
    pub fn show(&self, mosaic: Mosaic) {
        *self.state() = State::Finished(mosaic);
    }

    fn with<T>(&self, look: impl FnOnce(&Mosaic) -> T) -> Option<T> {
        match &*self.state() {
            State::Growing(laying) => Some(look(laying.mosaic())),
            State::Away => None,
            State::Finished(mosaic) => Some(look(mosaic)),
        }
    }
}

impl Ground for LiveGround {
    fn state(&self) -> Option<GroundState> {
        self.with(|mosaic| {
            let metres_per_pixel = mosaic.resolution_m()?;
            Some(GroundState { metres_per_pixel, revision: mosaic.revision() })
        })?
    }

    fn changed_since(&self, revision: u64) -> Vec<MosaicSquare> {
        self.with(|mosaic| mosaic.changed_since(revision).collect()).unwrap_or_default()
    }

    fn tile_rgba(&self, tile: MosaicSquare) -> Option<Vec<u8>> {
        self.with(|mosaic| mosaic.tile_rgba(tile))?
    }
}
