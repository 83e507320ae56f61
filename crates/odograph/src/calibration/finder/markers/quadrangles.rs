//! Quadrangles among outlines.

use crate::geometry::Pixel;

/// The shortest side of a quadrangle that can hold a marker that is read, pixels.
const SHORTEST_SIDE_PX: f64 = 5.0;

/// The four corners of an outline that is a convex quadrangle, in the outline's order.
///
/// The outline is cut where it is farthest from its chords (U. Ramer, "An iterative procedure for the polygonal approximation of plane
/// curves", 1972); then each side is fitted anew by a straight line, its ends left out, and neighbouring lines are intersected.
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
    // A pixel for the stairs and rounding of a small outline, a part of the side for a bent large one.
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
    let mut lines = [Line { at: middle, direction: (1.0, 0.0) }; 4];
    for side in 0..4 {
        let (from, to) = (corners[side], corners[(side + 1) % 4]);
        let to = if to <= from { to + count } else { to };
        let inset = ((to - from) / 6).max(1);
        if outline[from % count].distance(outline[to % count]) < SHORTEST_SIDE_PX
            || from + inset + 3 > to - inset
        {
            return None;
        }
        lines[side] = Line::through((from + inset..to - inset).map(|i| outline[i % count]))?;
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

/// Cuts the outline between two places where it is farther than `tolerance` from their chord, in order; false where that would make
/// more corners than four.
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
struct Line {
    at: Pixel,
    direction: (f64, f64),
}

impl Line {
    /// The line with the least squared distances to points.
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
        // Sides of a marker seen at an angle of less than 5 degrees are of no use.
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
