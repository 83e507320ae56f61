//! A trajectory with a bounded number of points: the longer it is, the larger their spacing.

/// Maximum number of points. A viewer that seeks in time must read all of them at once.
const MAX_POINTS: usize = 1000;
/// Initial minimum distance between two points, metres; it doubles whenever [`MAX_POINTS`] are
/// reached.
const FIRST_SPACING_M: f64 = 5e-3;

/// The thinned trajectory so far.
#[derive(Debug)]
pub struct PathSketch {
    spacing_m: f64,
    points: Vec<(usize, [f64; 2])>,
    /// The newest position, if it is not already a point of the sketch.
    newest: Option<(usize, [f64; 2])>,
}

impl Default for PathSketch {
    fn default() -> Self {
        Self { spacing_m: FIRST_SPACING_M, points: Vec::new(), newest: None }
    }
}

impl PathSketch {
    /// Adds a position in metres. `segment` is the number of gaps before it.
    pub fn add(&mut self, segment: usize, place: [f64; 2]) {
        if !self.is_far(self.points.last(), (segment, place)) {
            self.newest = Some((segment, place));
            return;
        }
        self.newest = None;
        self.points.push((segment, place));
        while self.points.len() > MAX_POINTS {
            self.spacing_m *= 2.0;
            let mut kept: Vec<(usize, [f64; 2])> = Vec::with_capacity(MAX_POINTS + 1);
            for &point in &self.points {
                if self.is_far(kept.last(), point) {
                    kept.push(point);
                }
            }
            // With many gaps each segment has a single point: the oldest ones are dropped.
            if kept.len() > MAX_POINTS && self.spacing_m > 1e6 {
                kept.drain(..kept.len() - MAX_POINTS);
            }
            self.points = kept;
        }
    }

    fn is_far(&self, last: Option<&(usize, [f64; 2])>, (segment, [x, y]): (usize, [f64; 2])) -> bool {
        last.is_none_or(|(before, [u, v])| *before != segment || (x - u).hypot(y - v) >= self.spacing_m)
    }

    /// The points of each segment in order, up to the newest position.
    pub fn stretches(&self) -> Vec<Vec<[f64; 2]>> {
        let mut stretches: Vec<(usize, Vec<[f64; 2]>)> = Vec::new();
        for &(segment, place) in self.points.iter().chain(&self.newest) {
            match stretches.last_mut().filter(|(last, _)| *last == segment) {
                Some((_, stretch)) => stretch.push(place),
                None => stretches.push((segment, vec![place])),
            }
        }
        stretches.into_iter().map(|(_, stretch)| stretch).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinned_path_keeps_ends_and_gaps_with_few_points() {
        let mut sketch = PathSketch::default();
        for k in 0..200_000 {
            // 100 m long, ten segments of 10 m, and stationary at its end.
            let x = 5e-4 * f64::from(k.min(199_000));
            sketch.add((k / 20_000) as usize, [x, 0.0]);
        }
        let stretches = sketch.stretches();
        let points: usize = stretches.iter().map(Vec::len).sum();
        assert_eq!(stretches.len(), 10);
        assert!((MAX_POINTS / 3..=MAX_POINTS + 1).contains(&points), "{points}");
        assert_eq!((stretches[0][0], *stretches[9].last().unwrap()), ([0.0, 0.0], [99.5, 0.0]));
        // No holes: the distance of neighbours is at most the spacing plus one step.
        let widest =
            stretches.iter().flat_map(|s| s.windows(2)).map(|w| w[1][0] - w[0][0]).fold(0.0, f64::max);
        assert!(widest < 2.0 * sketch.spacing_m && sketch.spacing_m < 0.4, "{widest} {}", sketch.spacing_m);
        // The size is also bounded if every point is a segment of its own.
        let mut torn = PathSketch::default();
        (0..3000).for_each(|segment| torn.add(segment, [segment as f64, 0.0]));
        assert!(torn.stretches().len() <= MAX_POINTS + 1);
    }
}
