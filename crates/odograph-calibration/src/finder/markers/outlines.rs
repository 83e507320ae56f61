//! Outlines of dark regions.

use super::threshold::Dark;
use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// A 4-connected dark region.
struct Area {
    /// The leftmost pixel of its top row.
    start: (usize, usize),
    left: usize,
    right: usize,
    top: usize,
    bottom: usize,
}

/// A run of dark pixels in a row, from `start` to before `end`.
struct DarkRun {
    row: usize,
    start: usize,
    end: usize,
    /// Union–find parent: an earlier run of the same region; the root points to itself.
    parent: usize,
}

fn first(runs: &mut [DarkRun], mut run: usize) -> usize {
    while runs[run].parent != run {
        let parent = runs[run].parent;
        runs[run].parent = runs[parent].parent;
        run = parent;
    }
    run
}

/// All dark regions whose bounding box is at least `least` pixels wide and high and that do not
/// touch the image border.
fn areas(dark: &Dark, least: usize) -> Vec<Area> {
    let mut runs: Vec<DarkRun> = Vec::new();
    let mut above = 0..0;
    for y in 0..dark.height {
        let row = &dark.dark[y * dark.width..][..dark.width];
        let begin = runs.len();
        let mut candidate = above.start;
        let mut x = 0;
        while let Some(skip) = row[x..].iter().position(|&d| d != 0) {
            let start = x + skip;
            let end = row[start..].iter().position(|&d| d == 0).map_or(dark.width, |n| start + n);
            let this = runs.len();
            runs.push(DarkRun { row: y, start, end, parent: this });
            while candidate < above.end && runs[candidate].end <= start {
                candidate += 1;
            }
            let mut touching = candidate;
            while touching < above.end && runs[touching].start < end {
                let (a, b) = (first(&mut runs, touching), first(&mut runs, this));
                // The earlier run remains the root, so the root is in the top row of its region.
                runs[a.max(b)].parent = a.min(b);
                touching += 1;
            }
            x = end;
        }
        above = begin..runs.len();
    }
    let mut of_root = vec![usize::MAX; runs.len()];
    let mut areas: Vec<Area> = Vec::new();
    for i in 0..runs.len() {
        let root = first(&mut runs, i);
        let run = &runs[i];
        if root == i {
            of_root[i] = areas.len();
            areas.push(Area {
                start: (run.start, run.row),
                left: run.start,
                right: run.end,
                top: run.row,
                bottom: run.row + 1,
            });
        } else if let Some(area) = areas.get_mut(of_root[root]) {
            area.left = area.left.min(run.start);
            area.right = area.right.max(run.end);
            area.bottom = run.row + 1;
        }
    }
    areas.retain(|area| {
        area.right - area.left >= least
            && area.bottom - area.top >= least
            && area.left > 0
            && area.top > 0
            && area.right < dark.width
            && area.bottom < dark.height
    });
    areas
}

/// Maximum length of an outline relative to half the perimeter of its bounding box. A convex
/// outline along pixel borders is exactly as long as the perimeter.
const MAX_DENTED: usize = 3;

/// The outer outlines of the dark regions, clockwise in the image. Their points have sub-pixel
/// accuracy: the threshold crossing between a dark pixel and its bright neighbour.
pub(super) fn outlines(image: &GrayImage, dark: &Dark, least: usize) -> Vec<Vec<Pixel>> {
    areas(dark, least)
        .iter()
        .filter_map(|area| {
            let most = (area.right - area.left + area.bottom - area.top) * MAX_DENTED;
            outline(image, dark, area.start, most)
        })
        .collect()
}

/// Traces one outline along pixel borders with the dark pixels to the right; `None` if it is longer
/// than `most`.
fn outline(image: &GrayImage, dark: &Dark, start: (usize, usize), most: usize) -> Option<Vec<Pixel>> {
    // Positions are pixel corners: (x, y) is the top left corner of pixel (x, y). Directions: east,
    // south, west, north.
    const STEPS: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];
    // The pixels to the right and to the left of a step, relative to its starting corner.
    const RIGHT: [(i32, i32); 4] = [(0, 0), (-1, 0), (-1, -1), (0, -1)];
    const LEFT: [(i32, i32); 4] = [(0, -1), (0, 0), (-1, 0), (-1, -1)];
    let begin = (start.0 as i32, start.1 as i32);
    let (mut at, mut direction) = (begin, 0);
    let mut points = Vec::new();
    loop {
        let inner = (at.0 + RIGHT[direction].0, at.1 + RIGHT[direction].1);
        let outer = (at.0 + LEFT[direction].0, at.1 + LEFT[direction].1);
        points.push(crossing(image, dark, inner, outer)?);
        if points.len() > most {
            return None;
        }
        at = (at.0 + STEPS[direction].0, at.1 + STEPS[direction].1);
        let right = (at.0 + RIGHT[direction].0, at.1 + RIGHT[direction].1);
        let left = (at.0 + LEFT[direction].0, at.1 + LEFT[direction].1);
        // The right pixel is tested first, so regions that only touch at a corner are separate
        // (4-connectivity).
        if !dark.at(right.0, right.1) {
            direction = (direction + 1) % 4;
        } else if dark.at(left.0, left.1) {
            direction = (direction + 3) % 4;
        }
        if at == begin && direction == 0 {
            return Some(points);
        }
    }
}

/// Linear interpolation of the threshold crossing between a dark pixel and its bright neighbour;
/// `None` if either is outside the image.
fn crossing(image: &GrayImage, dark: &Dark, inner: (i32, i32), outer: (i32, i32)) -> Option<Pixel> {
    let sample = |(x, y): (i32, i32)| {
        let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
        (x < image.width() && y < image.height()).then(|| f64::from(image.row(y)[x]))
    };
    let (low, high) = (sample(inner)?, sample(outer)?);
    let threshold = f64::from(dark.threshold(inner.0 as usize, inner.1 as usize));
    let share = if high > low { ((threshold - low) / (high - low)).clamp(0.0, 1.0) } else { 0.5 };
    let between = |a: i32, b: i32| f64::from(a) + share * f64::from(b - a);
    Some(Pixel::new(between(inner.0, outer.0), between(inner.1, outer.1)))
}
