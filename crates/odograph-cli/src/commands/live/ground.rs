//! The mosaic while it grows under the page's eyes.

use super::laying::{Kept, Laying};
use crate::commands::run::views::Posed;
use odograph::camera::Camera;
use odograph::mapping::{Mosaic, MosaicSquare};
use odograph_live::Ground;
use odograph_live::ground::GroundState;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The ground of a live run: laid by one thread, looked at by those of the page.
#[derive(Clone)]
pub struct LiveGround(Arc<Mutex<State>>);

enum State {
    Growing(Box<Laying>),
    /// Neither, for a moment.
    Away,
    Finished(Box<Mosaic>),
}

impl LiveGround {
    pub fn new(camera: Camera, folder: &Path) -> Self {
        Self(Arc::new(Mutex::new(State::Growing(Box::new(Laying::new(camera, folder))))))
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

    /// Ends the laying: nothing grows any more, and those who look see the ground as it is. `None` where it has ended before.
    pub fn finish(&self) -> Option<Kept> {
        let mut state = self.state();
        let State::Growing(laying) = std::mem::replace(&mut *state, State::Away) else { return None };
        let (mosaic, kept) = laying.finished();
        *state = State::Finished(Box::new(mosaic));
        Some(kept)
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
