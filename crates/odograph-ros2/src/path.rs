//! The path so far, in few poses.

use nalgebra::Isometry3;

/// Most poses of a published path: more are thinned, so that it stays a message of 200 kB.
const MOST: usize = 2000;
/// Least distance between two poses at first, metres.
const SPACING_M: f64 = 0.02;

/// The path so far. When it is full, every second pose goes, and those to come are twice as far
/// apart.
#[derive(Debug)]
pub struct SparsePath {
    poses: Vec<(u64, Isometry3<f64>)>,
    spacing_m: f64,
}

impl Default for SparsePath {
    fn default() -> Self {
        Self { poses: Vec::new(), spacing_m: SPACING_M }
    }
}

impl SparsePath {
    /// Adds a pose, if it is far enough from the one before.
    pub fn add(&mut self, time_ns: u64, pose: Isometry3<f64>) {
        let step_m = |last: &Isometry3<f64>| (pose.translation.vector - last.translation.vector).norm();
        if self.poses.last().is_some_and(|(_, last)| step_m(last) < self.spacing_m) {
            return;
        }
        self.poses.push((time_ns, pose));
        if self.poses.len() > MOST {
            let mut index = 0;
            self.poses.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.spacing_m *= 2.0;
        }
    }

    /// Times and poses.
    pub fn poses(&self) -> &[(u64, Isometry3<f64>)] {
        &self.poses
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_path_stays_small_and_keeps_its_beginning() {
        let mut path = SparsePath::default();
        (0..100_000).for_each(|k| path.add(k, Isometry3::translation(0.01 * k as f64, 0.0, 0.0)));
        assert!((MOST / 2..=MOST).contains(&path.poses().len()), "{}", path.poses().len());
        assert_eq!(path.poses()[0].0, 0);
        let end_m = path.poses()[path.poses().len() - 1].1.translation.x;
        assert!((1000.0 - end_m) < 2.0, "{end_m}");
    }
}
