//! Detection of quadrangles among outlines.

use crate::finder::ring::interpolated;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// Minimum side of a quadrangle with a decodable marker, pixels.
const SHORTEST_SIDE_PX: f64 = 5.0;

/// The four corners of a convex quadrangular outline, in the order of the outline; `None` for other
/// outlines.
///
/// The outline is approximated by a polygon (U. Ramer, "An iterative procedure for the polygonal
/// approximation of plane curves", 1972). Then a straight line is fitted to the inner part of each
/// side, and adjacent lines are intersected.
pub(super) fn quadrangle(outline: &[Pixel]) -> Option<[Pixel; 4]> {
    let count = outline.len();
    if count < 12 {
        return None;
    }
    let scale = 1.0 / count as f64;
    let middle = Pixel::new(
        outline.iter().map(|p| p.x).sum::<f64>() * scale,
        outline.iter().map(|p| p.y).sum::<f64>() * scale,
    );
    let farthest = |from: Pixel| {
        let distances = outline.iter().map(|p| p.distance(from));
        distances.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map(|(at, _)| at)
    };
    let a = farthest(middle)?;
    let c = farthest(outline[a])?;
    // One pixel for the staircase and the rounded corners of a small outline, plus a share of the
    // side for the lens distortion of a large one.
    let tolerance = 1.0 + 0.03 * count as f64 / 4.0;
    let mut corners = Vec::with_capacity(6);
    let cuts = |from: usize, to: usize, corners: &mut Vec<usize>| {
        corners.push(from);
        cut(outline, from, to, tolerance, corners)
    };
    let (first, second) = (a.min(c), a.max(c));
    if !cuts(first, second, &mut corners) || !cuts(second, first + count, &mut corners) || corners.len() != 4
    {
        return None;
    }
    let mut lines = [EdgeLine { at: middle, direction: (1.0, 0.0) }; 4];
    for side in 0..4 {
        let (from, to) = (corners[side], corners[(side + 1) % 4]);
        let to = if to <= from { to + count } else { to };
        let inset = ((to - from) / 6).max(1);
        if outline[from % count].distance(outline[to % count]) < SHORTEST_SIDE_PX
            || from + inset + 3 > to - inset
        {
            return None;
        }
        lines[side] = EdgeLine::through((from + inset..to - inset).map(|i| outline[i % count]))?;
    }
    let mut result = [middle; 4];
    for (side, corner) in result.iter_mut().enumerate() {
        *corner = lines[(side + 3) % 4].meets(&lines[side])?;
        if corner.distance(outline[corners[side] % count]) > 2.0 * tolerance {
            return None;
        }
    }
    is_convex(&result).then_some(result)
}

/// Moves the sides of a dark quadrangle to the maximum image gradient, which makes them independent
/// of the threshold. `None` if a side has no edge.
pub(super) fn moved_to_edges(image: &GrayImage, corners: &[Pixel; 4]) -> Option<[Pixel; 4]> {
    let mut lines = [EdgeLine { at: corners[0], direction: (1.0, 0.0) }; 4];
    let shortest = (0..4).map(|i| corners[i].distance(corners[(i + 1) % 4])).fold(f64::MAX, f64::min);
    // The profile has steps of half a pixel. It extends by a quarter of a side into the bright area
    // and a sixth into the dark area, where other squares and the bits begin.
    let outwards = (((0.25 * shortest).clamp(1.0, 3.0)) * 2.0) as i32;
    let inwards = (((0.17 * shortest).clamp(1.0, 3.0)) * 2.0) as i32;
    for side in 0..4 {
        let (from, to) = (corners[side], corners[(side + 1) % 4]);
        let length = from.distance(to);
        let direction = ((to.x - from.x) / length, (to.y - from.y) / length);
        // With clockwise corners, dark is to the right of a side and the outward normal to the
        // left.
        let normal = (direction.1, -direction.0);
        let mut profile = [0.0; 16];
        let count = (inwards + outwards + 1) as usize;
        for (step, value) in profile[..count].iter_mut().enumerate() {
            let off = 0.5 * (step as f64 - f64::from(inwards));
            for place in 0..PLACES_ON_A_SIDE {
                let along = length * (0.12 + 0.76 * place as f64 / (PLACES_ON_A_SIDE - 1) as f64);
                let at = Pixel::new(
                    from.x + along * direction.0 + off * normal.0,
                    from.y + along * direction.1 + off * normal.1,
                );
                *value += interpolated(image, at)?;
            }
        }
        let rise = |step: usize| profile[step + 1] - profile[step - 1];
        let steepest = (1..count - 1).max_by(|&a, &b| rise(a).total_cmp(&rise(b)))?;
        if rise(steepest) <= 0.0 {
            return None;
        }
        let mut peak = steepest as f64;
        if steepest > 1 && steepest + 2 < count {
            let (before, here, after) = (rise(steepest - 1), rise(steepest), rise(steepest + 1));
            let bend = before - 2.0 * here + after;
            if bend < 0.0 {
                peak += (0.5 * (before - after) / bend).clamp(-0.5, 0.5);
            }
        }
        let off = 0.5 * (peak - f64::from(inwards));
        lines[side] =
            EdgeLine { at: Pixel::new(from.x + off * normal.0, from.y + off * normal.1), direction };
    }
    let mut result = *corners;
    for (side, corner) in result.iter_mut().enumerate() {
        *corner = lines[(side + 3) % 4].meets(&lines[side])?;
    }
    is_convex(&result).then_some(result)
}

/// Number of positions along a side that are averaged in the profile.
const PLACES_ON_A_SIDE: usize = 9;

/// Ramer's recursion: splits the outline between two indices where it is farthest from the chord,
/// if by more than `tolerance`, and appends the corners in order. False if that would make more
/// than four corners.
fn cut(outline: &[Pixel], from: usize, to: usize, tolerance: f64, corners: &mut Vec<usize>) -> bool {
    let count = outline.len();
    let (start, end) = (outline[from % count], outline[to % count]);
    let (dx, dy) = (end.x - start.x, end.y - start.y);
    let length = dx.hypot(dy).max(1e-9);
    let mut worst = (tolerance, None);
    for at in from + 1..to {
        let p = outline[at % count];
        let distance = ((p.x - start.x) * dy - (p.y - start.y) * dx).abs() / length;
        if distance > worst.0 {
            worst = (distance, Some(at));
        }
    }
    let Some(at) = worst.1 else { return true };
    if corners.len() >= 4 {
        return false;
    }
    if !cut(outline, from, at, tolerance, corners) {
        return false;
    }
    corners.push(at % count);
    corners.len() <= 4 && cut(outline, at, to, tolerance, corners)
}

#[derive(Clone, Copy)]
struct EdgeLine {
    at: Pixel,
    direction: (f64, f64),
}

impl EdgeLine {
    /// Total least-squares line through points.
    fn through(points: impl Iterator<Item = Pixel> + Clone) -> Option<Self> {
        let (mut n, mut x, mut y) = (0.0, 0.0, 0.0);
        for p in points.clone() {
            n += 1.0;
            x += p.x;
            y += p.y;
        }
        if n < 2.0 {
            return None;
        }
        let at = Pixel::new(x / n, y / n);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for p in points {
            let (dx, dy) = (p.x - at.x, p.y - at.y);
            xx += dx * dx;
            xy += dx * dy;
            yy += dy * dy;
        }
        let angle = 0.5 * f64::atan2(2.0 * xy, xx - yy);
        Some(Self { at, direction: (angle.cos(), angle.sin()) })
    }

    fn meets(&self, other: &Self) -> Option<Pixel> {
        let ((ax, ay), (bx, by)) = (self.direction, other.direction);
        let cross = ax * by - ay * bx;
        // Sides that meet at less than 5 degrees are not usable.
        if cross.abs() < 0.09 {
            return None;
        }
        let along = ((other.at.x - self.at.x) * by - (other.at.y - self.at.y) * bx) / cross;
        Some(Pixel::new(self.at.x + along * ax, self.at.y + along * ay))
    }
}

/// Whether a quadrangle turns right at each of its corners, as clockwise outlines do.
fn is_convex(corners: &[Pixel; 4]) -> bool {
    (0..4).all(|i| {
        let (a, b, c) = (corners[i], corners[(i + 1) % 4], corners[(i + 2) % 4]);
        (b.x - a.x) * (c.y - b.y) - (b.y - a.y) * (c.x - b.x) > 0.0
    })
}
