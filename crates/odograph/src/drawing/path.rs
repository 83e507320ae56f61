//! The measured path: connected parts, and the gaps between them.

use crate::trajectory::{FrameSummary, PlaceSummary};

/// One measured pose with its time.
#[derive(Debug, Clone, Copy)]
pub(super) struct PathPoint<'a> {
    /// Seconds since the first frame.
    pub time_s: f64,
    pub at: &'a PlaceSummary,
}

/// The measured path: the poses of a segment are those of consecutive frames; between segments the
/// camera was lost.
#[derive(Debug, Default)]
pub(super) struct MeasuredPath<'a> {
    pub segments: Vec<Vec<PathPoint<'a>>>,
    /// Whether frames were lost after the last pose.
    pub ends_lost: bool,
    /// From the first frame to the last, seconds.
    pub duration_s: f64,
}

impl<'a> MeasuredPath<'a> {
    /// Splits frames into segments: at every lost frame and wherever the segment changes. Poses
    /// that are not finite are lost.
    pub fn new(frames: &'a [FrameSummary]) -> Self {
        let mut path = Self::default();
        let (Some(first), Some(last)) = (frames.first(), frames.last()) else {
            return path;
        };
        path.duration_s = (last.time_s - first.time_s).max(0.0);
        let mut segment = None;
        for frame in frames {
            let usable = frame.place.as_ref().filter(|at| {
                [at.x_m, at.y_m, at.heading_rad].iter().all(|v| v.is_finite() && v.abs() < 1e12)
            });
            let Some(at) = usable else {
                segment = None;
                path.ends_lost = !path.segments.is_empty();
                continue;
            };
            if segment != Some(frame.segment) {
                path.segments.push(vec![]);
                segment = Some(frame.segment);
            }
            path.ends_lost = false;
            if let Some(segment) = path.segments.last_mut() {
                segment.push(PathPoint { time_s: frame.time_s - first.time_s, at });
            }
        }
        path
    }

    pub fn places(&self) -> impl DoubleEndedIterator<Item = &PathPoint<'a>> {
        self.segments.iter().flatten()
    }
}

/// A polyline with the points left out that lie within `tolerance` of the line through the kept
/// ones.
///
/// One pass, constant work a point: from each kept point, the cone of directions that pass all
/// points since within the tolerance is narrowed; the point before the first that leaves it is kept
/// (the cone-intersection method of J. Sklansky and V. Gonzalez, "Fast polygonal approximation of
/// digitized curves", 1980).
pub(super) fn simplified(points: impl IntoIterator<Item = (f64, f64)>, tolerance: f64) -> Vec<(f64, f64)> {
    let mut points = points.into_iter();
    let Some(first) = points.next() else {
        return vec![];
    };
    let mut kept = vec![first];
    let mut anchor = first;
    // The middle direction of the cone and its half angle, the last point inside, and the farthest
    // reach from the anchor.
    let mut cone: Option<(f64, f64)> = None;
    let mut inside: Option<(f64, f64)> = None;
    let mut reach = 0.0;
    for point in points {
        let distance = (point.0 - anchor.0).hypot(point.1 - anchor.1);
        if distance <= tolerance && reach <= tolerance {
            inside = Some(point);
            continue;
        }
        let direction = (point.1 - anchor.1).atan2(point.0 - anchor.0);
        let half = if distance > tolerance { (tolerance / distance).asin() } else { std::f64::consts::PI };
        let narrowed = match cone {
            None => Some((direction, half)),
            Some((middle, width)) => {
                let offset = crate::geometry::wrap_angle(direction - middle);
                let low = (-width).max(offset - half);
                let high = width.min(offset + half);
                let backwards = distance < reach - tolerance;
                (offset.abs() <= width && low <= high && !backwards)
                    .then_some((middle + 0.5 * (low + high), 0.5 * (high - low)))
            }
        };
        if let (None, Some(previous)) = (narrowed, inside) {
            kept.push(previous);
            anchor = previous;
            let distance = (point.0 - anchor.0).hypot(point.1 - anchor.1);
            reach = distance;
            cone = (distance > tolerance)
                .then(|| ((point.1 - anchor.1).atan2(point.0 - anchor.0), (tolerance / distance).asin()));
        } else {
            cone = narrowed.or(Some((direction, half)));
            reach = f64::max(reach, distance);
        }
        inside = Some(point);
    }
    if let Some(last) = inside {
        kept.push(last);
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn distance_to_segment(p: (f64, f64), a: (f64, f64), b: (f64, f64)) -> f64 {
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        let length2 = dx * dx + dy * dy;
        let t = if length2 > 0.0 {
            (((p.0 - a.0) * dx + (p.1 - a.1) * dy) / length2).clamp(0.0, 1.0)
        } else {
            0.0
        };
        (p.0 - a.0 - t * dx).hypot(p.1 - a.1 - t * dy)
    }

    #[test]
    fn a_straight_line_of_many_points_becomes_two() {
        let line = (0..10_000).map(|k| (0.01 * k as f64, 0.005 * k as f64));
        assert_eq!(simplified(line, 0.2).len(), 2);
    }

    #[test]
    fn a_circle_keeps_its_shape_with_few_points() {
        let circle: Vec<_> = (0..=100_000)
            .map(|k| std::f64::consts::TAU * k as f64 / 100_000.0)
            .map(|a| (300.0 * a.cos(), 300.0 * a.sin()))
            .collect();
        let kept = simplified(circle.iter().copied(), 0.3);
        assert!(kept.len() < 120, "{}", kept.len());
        let worst = circle
            .iter()
            .map(|&p| kept.windows(2).map(|s| distance_to_segment(p, s[0], s[1])).fold(f64::MAX, f64::min))
            .fold(0.0, f64::max);
        assert!(worst <= 0.61, "{worst}");
    }

    proptest! {
        #[test]
        fn no_point_is_left_far_from_the_line(steps in proptest::collection::vec((-3.0..3.0f64, -3.0..3.0f64), 1..200)) {
            let mut at = (0.0, 0.0);
            let walk: Vec<_> = steps.into_iter().map(|(dx, dy)| { at = (at.0 + dx, at.1 + dy); at }).collect();
            let kept = simplified(walk.iter().copied(), 0.5);
            prop_assert_eq!(kept[0], walk[0]);
            prop_assert_eq!(*kept.last().unwrap(), *walk.last().unwrap());
            for &p in &walk {
                let near = kept.windows(2).map(|s| distance_to_segment(p, s[0], s[1])).fold(f64::MAX, f64::min);
                let near = near.min(kept.iter().map(|k| (k.0 - p.0).hypot(k.1 - p.1)).fold(f64::MAX, f64::min));
                prop_assert!(near <= 1.01, "{near}");
            }
        }
    }
}
