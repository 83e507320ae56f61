//! Detection of dark elliptical blobs.

use odograph::geometry::Pixel;
use odograph::image::GrayImage;

/// A dark elliptical blob.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Blob {
    /// Centroid.
    pub pixel: Pixel,
    /// The symmetric matrix `[a, b, c]` of the ellipse `a x² + 2 b x y + c y² = 1` relative to the
    /// centroid.
    pub shape: [f64; 3],
    /// Semi-axes, the longer one first, pixels.
    pub axes_px: (f64, f64),
}

/// Minimum area, pixels; smaller blobs are noise.
const MIN_AREA: usize = 12;
/// Maximum ratio of the axes; beyond it, a disc is indistinguishable from a stroke.
const MAX_ELONGATION: f64 = 5.0;
/// Maximum relative difference between the area and that of the ellipse with the same second
/// moments. The rim of a blob of 12 pixels is ragged.
const MAX_UNLIKE: f64 = 0.12;
/// Minimum difference between a pixel and the local mean, gray levels.
const MIN_CONTRAST: u32 = 8;

/// The `most` largest dark elliptical blobs, largest first. A pixel is dark if it is below the mean
/// of a square window of `window_px`.
pub(super) fn blobs(image: &GrayImage, window_px: usize, most: usize) -> Vec<Blob> {
    let dark = darker_than_around(image, window_px);
    let mut found: Vec<(usize, Blob)> = components(&dark, image.width(), image.height());
    // The sort is stable and components are in reading order, so the result is deterministic.
    found.sort_by_key(|(area, _)| std::cmp::Reverse(*area));
    found.truncate(most);
    found.into_iter().map(|(_, blob)| blob).collect()
}

/// Adaptive threshold: whether each pixel is darker than the local mean.
fn darker_than_around(image: &GrayImage, window_px: usize) -> Vec<bool> {
    let (width, height) = (image.width(), image.height());
    let radius = window_px / 2;
    // Column sums over the rows of the window, updated row by row, and their running sum along the
    // row.
    let mut columns = vec![0u32; width];
    let mut dark = vec![false; width * height];
    for row in 0..radius.min(height) {
        columns.iter_mut().zip(image.row(row)).for_each(|(sum, &sample)| *sum += u32::from(sample));
    }
    for y in 0..height {
        if y + radius < height {
            columns
                .iter_mut()
                .zip(image.row(y + radius))
                .for_each(|(sum, &sample)| *sum += u32::from(sample));
        }
        if y > radius {
            columns
                .iter_mut()
                .zip(image.row(y - radius - 1))
                .for_each(|(sum, &sample)| *sum -= u32::from(sample));
        }
        let rows = (y + radius).min(height - 1) - y.saturating_sub(radius) + 1;
        let mut sum: u64 = columns[..radius.min(width)].iter().map(|&sum| u64::from(sum)).sum();
        let (samples, dark) = (image.row(y), &mut dark[y * width..(y + 1) * width]);
        for x in 0..width {
            if x + radius < width {
                sum += u64::from(columns[x + radius]);
            }
            if x > radius {
                sum -= u64::from(columns[x - radius - 1]);
            }
            let count = rows * ((x + radius).min(width - 1) - x.saturating_sub(radius) + 1);
            dark[x] = u64::from(u32::from(samples[x]) + MIN_CONTRAST) * count as u64 <= sum;
        }
    }
    dark
}

/// Area and moments of a connected component.
#[derive(Debug, Clone, Copy, Default)]
struct BlobMoments {
    count: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
    at_border: bool,
}

impl BlobMoments {
    fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.x += other.x;
        self.y += other.y;
        self.xx += other.xx;
        self.xy += other.xy;
        self.yy += other.yy;
        self.at_border |= other.at_border;
    }

    /// Moments of the run of pixels `from..to` in a row.
    fn of_run(from: usize, to: usize, y: usize, (width, height): (usize, usize)) -> Self {
        let (first, last, y_px) = (from as f64, to as f64 - 1.0, y as f64);
        let count = (to - from) as f64;
        let squares = |n: f64| n * (n + 1.0) * (2.0 * n + 1.0) / 6.0;
        let x = 0.5 * count * (first + last);
        Self {
            count,
            x,
            y: count * y_px,
            xx: squares(last) - squares(first - 1.0),
            xy: x * y_px,
            yy: count * y_px * y_px,
            at_border: from == 0 || to == width || y == 0 || y + 1 == height,
        }
    }

    fn blob(&self) -> Option<(usize, Blob)> {
        if self.at_border || self.count < MIN_AREA as f64 {
            return None;
        }
        let (x, y) = (self.x / self.count, self.y / self.count);
        // A square pixel has a second moment of 1/12 about its own centre.
        let xx = self.xx / self.count - x * x + 1.0 / 12.0;
        let yy = self.yy / self.count - y * y + 1.0 / 12.0;
        let xy = self.xy / self.count - x * y;
        let determinant = xx * yy - xy * xy;
        if determinant <= 0.0 {
            return None;
        }
        // A filled ellipse with semi-axes p and q has second moments p²/4 and q²/4 and the area π p
        // q.
        let area = 4.0 * std::f64::consts::PI * determinant.sqrt();
        let (mean, spread) = (0.5 * (xx + yy), (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt());
        let axes_px = (2.0 * (mean + spread).sqrt(), 2.0 * (mean - spread).max(0.0).sqrt());
        if (self.count / area - 1.0).abs() > MAX_UNLIKE || axes_px.0 > MAX_ELONGATION * axes_px.1 {
            return None;
        }
        let shape = [yy, -xy, xx].map(|moment| 0.25 * moment / determinant);
        Some((self.count as usize, Blob { pixel: Pixel::new(x, y), shape, axes_px }))
    }
}

/// The elliptical ones of the 8-connected components, by union–find over runs.
fn components(dark: &[bool], width: usize, height: usize) -> Vec<(usize, Blob)> {
    let mut moments: Vec<BlobMoments> = Vec::new();
    let mut parent: Vec<u32> = Vec::new();
    fn root(parent: &mut [u32], mut at: u32) -> u32 {
        while parent[at as usize] != at {
            parent[at as usize] = parent[parent[at as usize] as usize];
            at = parent[at as usize];
        }
        at
    }
    // Runs of the previous and of the current row: start, end, component.
    type PixelRun = (usize, usize, u32);
    let (mut above, mut here): (Vec<PixelRun>, Vec<PixelRun>) = (Vec::new(), Vec::new());
    for y in 0..height {
        let row = &dark[y * width..(y + 1) * width];
        here.clear();
        let (mut x, mut over) = (0, 0);
        while x < width {
            if !row[x] {
                x += 1;
                continue;
            }
            let from = x;
            while x < width && row[x] {
                x += 1;
            }
            let mut component = None;
            while over < above.len() && above[over].1 < from {
                over += 1;
            }
            let mut touching = over;
            while touching < above.len() && above[touching].0 <= x {
                let other = root(&mut parent, above[touching].2);
                component = match component {
                    None => Some(other),
                    Some(own) if own == other => Some(own),
                    Some(own) => {
                        let (first, second): (u32, u32) = (own.min(other), own.max(other));
                        parent[second as usize] = first;
                        let joined = moments[second as usize];
                        moments[first as usize].add(&joined);
                        Some(first)
                    }
                };
                touching += 1;
            }
            let run = BlobMoments::of_run(from, x, y, (width, height));
            let component = component.unwrap_or_else(|| {
                parent.push(parent.len() as u32);
                moments.push(BlobMoments::default());
                parent.len() as u32 - 1
            });
            moments[component as usize].add(&run);
            here.push((from, x, component));
        }
        std::mem::swap(&mut above, &mut here);
    }
    (0..moments.len()).filter(|&i| parent[i] == i as u32).filter_map(|i| moments[i].blob()).collect()
}
