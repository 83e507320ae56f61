//! Which views of a recording are worth calibrating with, and what is still missing.
//!
//! A recording shows the board hundreds of times, most of them nearly alike. [`ViewSelector`] keeps the views that differ,
//! prefers those that are sharp and held still, and chooses a bounded number of them greedily by what each adds to the
//! knowledge of the lens (D-optimality of the Fisher information, as the selection of views of J. Maye, P. Furgale, R. Siegwart,
//! "Self-supervised calibration for robotic systems", 2013) and to the coverage of the image. [`Guidance`] says in words what
//! a person should show next.

mod guidance;
mod nominal;
mod sharpness;
mod worth;

pub use guidance::{Coverage, Direction, Guidance, Hint, Region};
pub use sharpness::blur_px;

use super::{Board, BoardView};
use nominal::{Seen, nominal_focal_px};
use worth::Knowledge;

/// How views are chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SelectionConfig {
    /// At most so many views are chosen.
    pub most_views: usize,
    /// Two views are alike where the board's points moved less than this share of the image's diagonal …
    pub alike_displacement: f64,
    /// … and the board turned by less than this, radians.
    pub alike_turn_rad: f64,
}

impl Default for SelectionConfig {
    fn default() -> Self {
        // More than 60 views only take time: the errors that are left are no longer those of single corners.
        Self { most_views: 60, alike_displacement: 0.03, alike_turn_rad: 6.0_f64.to_radians() }
    }
}

/// The board seen in one frame or picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// The caller's number of the frame or picture.
    pub number: u64,
    /// When, seconds; `None` for pictures, which are taken as held still.
    pub time_s: Option<f64>,
    /// What was seen.
    pub view: BoardView,
    /// How blurred its edges are, pixels ([`blur_px`]); `None` where unknown.
    pub blur_px: Option<f64>,
}

/// A sighting that was kept, with what decides its worth.
#[derive(Debug, Clone)]
struct Kept {
    sighting: Sighting,
    seen: Seen,
    noise_px: f64,
    speed_px_s: f64,
}

/// Frames further apart than this do not tell how fast the board moves, seconds.
const FOLLOWS_S: f64 = 0.25;
/// The speed of a board that was seen in one frame only, image diagonals a second: it probably moved.
const SPEED_OF_A_LONE_FRAME: f64 = 0.2;
/// So many different views are remembered; then the half that teaches least is forgotten. Bounds memory and time.
const MOST_KEPT: usize = 1000;

/// Chooses the informative views of a recording. Sightings come in the order of time; the choice depends on nothing else.
#[derive(Debug, Clone)]
pub struct ViewSelector {
    board: Board,
    config: SelectionConfig,
    kept: Vec<Kept>,
    /// The last sighting: how fast the board moved there is known when the next one comes.
    last: Option<(Kept, Option<f64>)>,
    sightings: usize,
}

impl ViewSelector {
    /// A selector that has seen nothing yet.
    pub fn new(board: &Board, config: SelectionConfig) -> Self {
        Self { board: *board, config, kept: Vec::new(), last: None, sightings: 0 }
    }

    /// Takes the next sighting. One with fewer than four points, or all of them on a line, teaches nothing and is passed over.
    pub fn add(&mut self, sighting: Sighting) {
        self.sightings += 1;
        let Some(seen) = Seen::new(&self.board, &sighting.view) else { return };
        let kept = Kept { sighting, seen, noise_px: 0.0, speed_px_s: 0.0 };
        let speed_px_s = self.last.as_ref().and_then(|(last, _)| speed_px_s(last, &kept));
        if let Some((last, before)) = self.last.replace((kept, speed_px_s)) {
            self.keep(last, [before, speed_px_s]);
        }
    }

    /// How many sightings were taken.
    pub fn sightings(&self) -> usize {
        self.sightings
    }

    /// How many different views were seen, as far as they are remembered.
    pub fn distinct(&self) -> usize {
        self.with_last().kept.len()
    }

    /// The chosen sightings, in the order they came.
    pub fn chosen(&self) -> Vec<&Sighting> {
        let whole = self.with_last();
        let numbers: Vec<u64> = whole
            .choose(self.config.most_views)
            .into_iter()
            .map(|index| whole.kept[index].sighting.number)
            .collect();
        let last = self.last.iter().map(|(kept, _)| kept);
        let mut chosen: Vec<&Sighting> = self
            .kept
            .iter()
            .chain(last)
            .map(|kept| &kept.sighting)
            .filter(|s| numbers.contains(&s.number))
            .collect();
        chosen.sort_by_key(|sighting| sighting.number);
        chosen.dedup_by_key(|sighting| sighting.number);
        chosen
    }

    /// What has been seen and what is missing, judged by the views that would be chosen now.
    pub fn guidance(&self) -> Guidance {
        let whole = self.with_last();
        let focal_px = whole.focal_px();
        let chosen: Vec<&Kept> =
            whole.choose(self.config.most_views).into_iter().map(|index| &whole.kept[index]).collect();
        Guidance::new(&self.board, &chosen, focal_px)
    }

    /// The selector as it would be if the recording ended here.
    fn with_last(&self) -> Self {
        let mut whole = self.clone();
        if let Some((last, before)) = whole.last.take() {
            whole.keep(last, [before, None]);
        }
        whole
    }

    fn focal_px(&self) -> f64 {
        nominal_focal_px(self.kept.iter().map(|kept| &kept.seen))
    }

    /// Keeps a sighting if it differs from all that are kept, or is better than the one it is like.
    fn keep(&mut self, mut new: Kept, speeds_px_s: [Option<f64>; 2]) {
        let known = || speeds_px_s.into_iter().flatten();
        new.speed_px_s = match (new.sighting.time_s, known().count()) {
            (None, _) => 0.0,
            (Some(_), 0) => SPEED_OF_A_LONE_FRAME * new.seen.diagonal_px(),
            (Some(_), count) => known().sum::<f64>() / count as f64,
        };
        new.noise_px = noise_px(new.speed_px_s, new.sighting.blur_px);
        let config = self.config;
        let like = self.kept.iter().position(|kept| {
            let displacement = kept.seen.displacement_px(&new.seen);
            displacement < config.alike_displacement * new.seen.diagonal_px()
                && kept.seen.turn_rad(&new.seen) < config.alike_turn_rad
        });
        match like {
            // A little better is not worth the views that differ from the one and not from the other.
            Some(at) if self.better(&new, at) => self.kept[at] = new,
            Some(_) => {}
            None => self.kept.push(new),
        }
        if self.kept.len() > MOST_KEPT {
            let stay = self.choose(MOST_KEPT / 2);
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                stay.contains(&(index - 1))
            });
        }
    }

    fn better(&self, new: &Kept, at: usize) -> bool {
        let old = &self.kept[at];
        let points = |kept: &Kept| kept.sighting.view.points.len() as f64;
        // The information of a view goes with its points and with the inverse of their variance.
        points(new) / new.noise_px.powi(2) > 1.5 * points(old) / old.noise_px.powi(2)
    }

    /// Indices of the `most` kept views that together teach most, in the order they were kept.
    fn choose(&self, most: usize) -> Vec<usize> {
        let focal_px = self.focal_px();
        let lessons: Vec<_> =
            self.kept.iter().map(|kept| kept.seen.lesson(focal_px, kept.noise_px)).collect();
        let mut knowledge = Knowledge::new();
        let mut open: Vec<usize> = (0..lessons.len()).collect();
        let mut chosen = Vec::new();
        while chosen.len() < most {
            let gains = open.iter().map(|&index| knowledge.gain(&lessons[index]));
            // Of equals the first.
            let best = gains.enumerate().fold(None, |best: Option<(usize, f64)>, (place, gain)| match best {
                Some((_, most)) if gain <= most => best,
                _ => Some((place, gain)),
            });
            let Some((place, _)) = best else { break };
            let index = open.remove(place);
            knowledge.learn(&lessons[index]);
            chosen.push(index);
        }
        chosen.sort_unstable();
        chosen
    }
}

/// How fast the board moved in the image from one sighting to the next, where the second follows soon enough.
fn speed_px_s(before: &Kept, after: &Kept) -> Option<f64> {
    let elapsed_s = after.sighting.time_s? - before.sighting.time_s?;
    (elapsed_s > 0.0 && elapsed_s <= FOLLOWS_S).then(|| before.seen.displacement_px(&after.seen) / elapsed_s)
}

/// The standard deviation of a corner that has to be reckoned with, pixels.
///
/// A sharp corner is found to about 0.1 px, and worse in proportion to the blur of its edges. A rolling shutter reads its lines over
/// 10 to 30 ms; what the board moves meanwhile bends its picture, and the board's pose can follow all of it but about a
/// tenth. That makes 2 ms of movement. Beyond a pixel all views are equally bad.
fn noise_px(speed_px_s: f64, blur_px: Option<f64>) -> f64 {
    let sharp = 0.1 * blur_px.map_or(1.0, |blur| blur.clamp(1.0, 10.0));
    let moved = (0.002 * speed_px_s).min(1.0);
    sharp.hypot(moved)
}

#[cfg(test)]
mod tests;
