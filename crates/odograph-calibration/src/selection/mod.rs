//! Selection of informative views from a recording, and guidance on what is still missing.
//!
//! A recording shows the board hundreds of times, mostly in nearly the same pose. [`ViewSelector`]
//! keeps the distinct views and prefers those that are sharp and held still. From these it selects
//! a bounded number greedily, by their gain in Fisher information about the lens (D-optimality, as
//! the selection of views of J. Maye, P. Furgale, R. Siegwart, "Self-supervised calibration for
//! robotic systems", 2013) and in coverage of the image. [`Guidance`] states in words what the user
//! should show next.

mod guidance;
mod nominal;
mod sharpness;
mod worth;

pub use guidance::{Direction, Guidance, Hint, Region, ViewCoverage};
pub use sharpness::blur_px;

use super::{Board, BoardView};
use nominal::{NominalView, nominal_focal_px};
use odograph::error::{Error, Result};
use worth::Knowledge;

/// Minimum number of distinct views that determine a camera.
pub const MIN_VIEWS: usize = 3;

/// Configuration of the view selection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SelectionConfig {
    /// Maximum number of selected views.
    pub most_views: usize,
    /// Two views are similar if the RMS displacement of the board's points is below this share of
    /// the image diagonal and the angle between the board normals is below
    /// [`alike_turn_rad`](Self::alike_turn_rad).
    pub alike_displacement: f64,
    /// Maximum angle between the board normals of similar views, radians.
    pub alike_turn_rad: f64,
}

impl Default for SelectionConfig {
    fn default() -> Self {
        // More than 60 views only cost time: the noise of single corners no longer dominates the
        // remaining errors.
        Self { most_views: 60, alike_displacement: 0.03, alike_turn_rad: 6.0_f64.to_radians() }
    }
}

/// A detection of the board in one video frame or still image.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// Number of the frame or image, assigned by the caller.
    pub number: u64,
    /// Timestamp, seconds; `None` for still images, which are assumed to be free of motion.
    pub time_s: Option<f64>,
    /// The detected points.
    pub view: BoardView,
    /// Edge blur, pixels ([`blur_px`]); `None` if unknown.
    pub blur_px: Option<f64>,
}

/// A sighting with its noise model.
#[derive(Debug, Clone)]
struct WeightedSighting {
    sighting: Sighting,
    seen: NominalView,
    noise_px: f64,
    speed_px_s: f64,
}

/// Maximum interval between two frames for estimating the speed of the board, seconds.
const FOLLOWS_S: f64 = 0.25;
/// Assumed speed of a board that was detected in a single frame only, image diagonals per second.
/// It was probably moving.
const SPEED_OF_A_LONE_FRAME: f64 = 0.2;
/// Maximum number of distinct views in memory. Beyond it, the less informative half is dropped,
/// which bounds memory and time.
const MAX_KEPT: usize = 1000;

/// Selects the informative views of a recording. Sightings must be added in temporal order; the
/// selection is deterministic.
#[derive(Debug, Clone)]
pub struct ViewSelector {
    board: Board,
    config: SelectionConfig,
    kept: Vec<WeightedSighting>,
    /// The latest sighting and the speed towards it. It is stored only when the next sighting
    /// arrives, because its own speed is estimated from both neighbours.
    last: Option<(WeightedSighting, Option<f64>)>,
    sightings: usize,
}

impl ViewSelector {
    /// An empty selector.
    pub fn new(board: &Board, config: SelectionConfig) -> Self {
        Self { board: *board, config, kept: Vec::new(), last: None, sightings: 0 }
    }

    /// Adds the next sighting. Sightings with fewer than four points or with collinear points are
    /// ignored.
    pub fn add(&mut self, sighting: Sighting) {
        self.sightings += 1;
        let Some(seen) = NominalView::new(&self.board, &sighting.view) else { return };
        let kept = WeightedSighting { sighting, seen, noise_px: 0.0, speed_px_s: 0.0 };
        let speed_px_s = self.last.as_ref().and_then(|(last, _)| speed_px_s(last, &kept));
        if let Some((last, before)) = self.last.replace((kept, speed_px_s)) {
            self.keep(last, [before, speed_px_s]);
        }
    }

    /// Number of sightings added.
    pub fn sightings(&self) -> usize {
        self.sightings
    }

    /// Number of distinct views in memory.
    pub fn distinct(&self) -> usize {
        self.with_last().kept.len()
    }

    /// Fails, with what to do, unless there are enough distinct views for a calibration.
    pub fn enough(&self) -> Result<()> {
        let (seen, distinct) = (self.sightings, self.distinct());
        let alike = match (seen, distinct) {
            (_, MIN_VIEWS..) => return Ok(()),
            (1, _) => "the board was seen in one view only".to_owned(),
            (_, 0) => format!("the {seen} views of the board show too few of its points"),
            (_, 1) => format!("all {seen} views show the board at the same place"),
            _ => format!("the {seen} views show the board at only {distinct} different places"),
        };
        Err(Error::input(format!(
            "{alike}; show it at 15 to 40 places: in the corners of the image, near and far, and tilted to all sides"
        )))
    }

    /// Numbers of the sightings in memory: only these can be selected, now or later.
    pub fn numbers(&self) -> impl Iterator<Item = u64> + '_ {
        self.in_memory().map(|sighting| sighting.number)
    }

    fn in_memory(&self) -> impl Iterator<Item = &Sighting> {
        self.kept.iter().chain(self.last.iter().map(|(last, _)| last)).map(|kept| &kept.sighting)
    }

    /// The selected sightings, sorted by number.
    pub fn chosen(&self) -> Vec<&Sighting> {
        let whole = self.with_last();
        let numbers: Vec<u64> = whole
            .choose(self.config.most_views)
            .into_iter()
            .map(|index| whole.kept[index].sighting.number)
            .collect();
        let mut chosen: Vec<&Sighting> =
            self.in_memory().filter(|sighting| numbers.contains(&sighting.number)).collect();
        chosen.sort_by_key(|sighting| sighting.number);
        chosen.dedup_by_key(|sighting| sighting.number);
        chosen
    }

    /// Guidance based on the views that would be selected now.
    pub fn guidance(&self) -> Guidance {
        let whole = self.with_last();
        let focal_px = whole.focal_px();
        let chosen: Vec<&WeightedSighting> =
            whole.choose(self.config.most_views).into_iter().map(|index| &whole.kept[index]).collect();
        Guidance::new(&self.board, &chosen, focal_px)
    }

    /// The selector with the latest sighting stored, as if the recording ended here.
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

    /// Stores a sighting if it is distinct from all stored ones, or more informative than the one
    /// it is similar to.
    fn keep(&mut self, mut new: WeightedSighting, speeds_px_s: [Option<f64>; 2]) {
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
            // Replacing a stored view may lose others that are similar to the new view but not to
            // the old one, so a small improvement is not enough.
            Some(at) if self.better(&new, at) => self.kept[at] = new,
            Some(_) => {}
            None => self.kept.push(new),
        }
        if self.kept.len() > MAX_KEPT {
            let stay = self.choose(MAX_KEPT / 2);
            let mut index = 0;
            self.kept.retain(|_| {
                index += 1;
                stay.contains(&(index - 1))
            });
        }
    }

    fn better(&self, new: &WeightedSighting, at: usize) -> bool {
        let old = &self.kept[at];
        let points = |kept: &WeightedSighting| kept.sighting.view.points.len() as f64;
        // The information of a view is proportional to its number of points over their variance.
        points(new) / new.noise_px.powi(2) > 1.5 * points(old) / old.noise_px.powi(2)
    }

    /// Indices of the `most` stored views with the largest joint information (greedy), in ascending
    /// order.
    fn choose(&self, most: usize) -> Vec<usize> {
        let focal_px = self.focal_px();
        let lessons: Vec<_> =
            self.kept.iter().map(|kept| kept.seen.lesson(focal_px, kept.noise_px)).collect();
        let mut knowledge = Knowledge::new();
        let mut open: Vec<usize> = (0..lessons.len()).collect();
        let mut chosen = Vec::new();
        while chosen.len() < most {
            let gains = open.iter().map(|&index| knowledge.gain(&lessons[index]));
            // The first one wins ties.
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

/// Speed of the board in the image between two consecutive sightings, pixels per second; `None` if
/// they are too far apart in time.
fn speed_px_s(before: &WeightedSighting, after: &WeightedSighting) -> Option<f64> {
    let elapsed_s = after.sighting.time_s? - before.sighting.time_s?;
    (elapsed_s > 0.0 && elapsed_s <= FOLLOWS_S).then(|| before.seen.displacement_px(&after.seen) / elapsed_s)
}

/// Effective standard deviation of a corner, pixels.
///
/// A sharp corner is detected to about 0.1 px; the error grows in proportion to the edge blur. A
/// rolling shutter reads an image in 10 to 30 ms. Board motion during the readout distorts the
/// image, and the estimated pose absorbs all but about a tenth of it, which leaves 2 ms of motion.
/// The motion term is limited to 1 px, beyond which all views are equally bad.
fn noise_px(speed_px_s: f64, blur_px: Option<f64>) -> f64 {
    let sharp = 0.1 * blur_px.map_or(1.0, |blur| blur.clamp(1.0, 10.0));
    let moved = (0.002 * speed_px_s).min(1.0);
    sharp.hypot(moved)
}

#[cfg(test)]
mod tests;
