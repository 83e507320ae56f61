//! How bright each keyframe is against the others.
//!
//! Where two keyframes show the same ground, the ratio of their brightness is known; all those ratios together are settled by least squares in the
//! logarithms of the gains, held to 1 by a weak prior (M. Brown and D. G. Lowe, "Automatic panoramic image stitching using invariant features", 2007,
//! section 6; there in the gains themselves).

use super::super::footprint::View;
use super::Laid;
use crate::camera::Camera;
use crate::error::Result;
use crate::geometry::Pixel;
use crate::mapping::{KeyframeImage, KeyframeImages};
use std::collections::BTreeMap;

/// Cells of a keyframe's thumbnail, columns and rows.
const CELLS: (usize, usize) = (24, 18);
/// Overlaps looked at for each keyframe, nearest first.
const MOST_OVERLAPS: usize = 12;
/// Cells that two keyframes must share to be compared.
const LEAST_CELLS: usize = 12;
/// The square of how well a ratio is known (1 %) over how far exposure strays (20 %).
const PRIOR: f64 = 0.0025;

/// The gain of each keyframe and channel that brings all to the same brightness.
#[derive(Debug)]
pub(super) struct Gains(Vec<[f32; 3]>);

/// Two keyframes that show the same ground: the logarithm of the first's brightness over the second's, by channel.
struct Overlap {
    one: usize,
    other: usize,
    log_ratio: [f64; 3],
}

/// A keyframe's image in a few large cells: red, green, blue each.
struct Thumbnail(Vec<[f32; 3]>);

impl Gains {
    /// Settles the gains of all keyframes. Loads every image once.
    pub fn settle(camera: &Camera, keyframes: &[Laid], images: &mut dyn KeyframeImages) -> Result<Self> {
        let mut thumbnails = Vec::with_capacity(keyframes.len());
        for laid in keyframes {
            thumbnails.push(Thumbnail::of(&images.load(laid.id)?));
        }
        let overlaps = overlaps(camera, keyframes, &thumbnails);
        let logs: [Vec<f64>; 3] = std::array::from_fn(|channel| solve(keyframes.len(), &overlaps, channel));
        let gain = |k: usize| [0, 1, 2].map(|channel| logs[channel][k].exp().clamp(0.25, 4.0) as f32);
        Ok(Self((0..keyframes.len()).map(gain).collect()))
    }

    /// The gains of a keyframe's channels.
    pub fn of(&self, keyframe: usize) -> [f32; 3] {
        self.0[keyframe]
    }
}

impl Thumbnail {
    fn of(image: &KeyframeImage) -> Self {
        let (width, height) = (image.gray.width(), image.gray.height());
        let cell = |k: usize| {
            let (column, row) = (k % CELLS.0, k / CELLS.0);
            let (left, right) = (
                column * width / CELLS.0,
                ((column + 1) * width / CELLS.0).max(column * width / CELLS.0 + 1),
            );
            let (top, bottom) =
                (row * height / CELLS.1, ((row + 1) * height / CELLS.1).max(row * height / CELLS.1 + 1));
            let mut sum = [0.0_f32; 3];
            for y in top..bottom.min(height) {
                for x in left..right.min(width) {
                    let pixel = match &image.color {
                        Some(color) => color.pixel(x, y),
                        None => [image.gray.row(y)[x]; 3],
                    };
                    (0..3).for_each(|c| sum[c] += f32::from(pixel[c]));
                }
            }
            let count = ((right - left) * (bottom - top)) as f32;
            sum.map(|sum| sum / count)
        };
        Self((0..CELLS.0 * CELLS.1).map(cell).collect())
    }

    /// The brightness at a share of the image's width and height; `None` outside the centres of the outermost cells.
    fn at(&self, x: f64, y: f64) -> Option<[f64; 3]> {
        let (x, y) = (x * CELLS.0 as f64 - 0.5, y * CELLS.1 as f64 - 0.5);
        let (column, row) = (x.floor(), y.floor());
        if !(column >= 0.0 && row >= 0.0 && (column as usize) < CELLS.0 - 1 && (row as usize) < CELLS.1 - 1) {
            return None;
        }
        let (dx, dy) = (x - column, y - row);
        let at = row as usize * CELLS.0 + column as usize;
        let value = |c: usize| {
            let cell = |k: usize| f64::from(self.0[at + k][c]);
            let (up, down) =
                (cell(0) * (1.0 - dx) + cell(1) * dx, cell(CELLS.0) * (1.0 - dx) + cell(CELLS.0 + 1) * dx);
            up * (1.0 - dy) + down * dy
        };
        Some([value(0), value(1), value(2)])
    }
}

/// The pairs of keyframes that show the same ground.
fn overlaps(camera: &Camera, keyframes: &[Laid], thumbnails: &[Thumbnail]) -> Vec<Overlap> {
    let centre = |k: usize| {
        let [left, bottom, right, top] = keyframes[k].bounds;
        (0.5 * (left + right), 0.5 * (bottom + top))
    };
    // Squares as large as the largest footprint: overlapping ones are in the same or in neighbouring squares.
    let reach = |laid: &Laid| (laid.bounds[2] - laid.bounds[0]).max(laid.bounds[3] - laid.bounds[1]);
    let side = keyframes.iter().map(reach).fold(f64::MIN_POSITIVE, f64::max);
    let square = |k: usize| ((centre(k).0 / side).floor() as i64, (centre(k).1 / side).floor() as i64);
    let mut squares: BTreeMap<(i64, i64), Vec<usize>> = BTreeMap::new();
    (0..keyframes.len()).for_each(|k| squares.entry(square(k)).or_default().push(k));
    let mut found = Vec::new();
    for one in 0..keyframes.len() {
        let (column, row) = square(one);
        let neighbours =
            (row - 1..=row + 1).flat_map(|row| (column - 1..=column + 1).map(move |column| (column, row)));
        let distance = |k: usize| (centre(k).0 - centre(one).0).hypot(centre(k).1 - centre(one).1);
        let mut others: Vec<usize> =
            neighbours.filter_map(|key| squares.get(&key)).flatten().copied().filter(|&k| k < one).collect();
        others.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
        for other in others.into_iter().take(MOST_OVERLAPS) {
            let pair = (&keyframes[one], &keyframes[other]);
            if let Some(log_ratio) = log_ratio(camera, pair, (&thumbnails[one], &thumbnails[other])) {
                found.push(Overlap { one, other, log_ratio });
            }
        }
    }
    found
}

/// The median logarithm of the ratio of brightness over the cells that two keyframes share.
fn log_ratio(
    camera: &Camera,
    (one, other): (&Laid, &Laid),
    thumbnails: (&Thumbnail, &Thumbnail),
) -> Option<[f64; 3]> {
    let view = View::new(camera, &other.pose)?;
    let (width, height) = (camera.width() as f64, camera.height() as f64);
    let mut ratios: [Vec<f64>; 3] = Default::default();
    for row in 0..CELLS.1 {
        for column in 0..CELLS.0 {
            let share = ((column as f64 + 0.5) / CELLS.0 as f64, (row as f64 + 0.5) / CELLS.1 as f64);
            let pixel = Pixel::new(share.0 * width - 0.5, share.1 * height - 0.5);
            let Some(ground) = camera.ray_from_pixel(pixel).and_then(|ray| one.pose.ground_from_ray(ray))
            else {
                continue;
            };
            let Some(look) = view.look(ground) else { continue };
            let Some(seen) = thumbnails.1.at((look.x + 0.5) / width, (look.y + 0.5) / height) else {
                continue;
            };
            let own = thumbnails.0.0[row * CELLS.0 + column].map(f64::from);
            for channel in 0..3 {
                let (a, b) = (own[channel], seen[channel]);
                if a.min(b) > 8.0 && a.max(b) < 247.0 {
                    ratios[channel].push((a / b).ln());
                }
            }
        }
    }
    if ratios.iter().any(|ratios| ratios.len() < LEAST_CELLS) {
        return None;
    }
    Some(ratios.map(|mut ratios| {
        let middle = ratios.len() / 2;
        *ratios.select_nth_unstable_by(middle, f64::total_cmp).1
    }))
}

/// The logarithms of one channel's gains: least squares of `gain(one) − gain(other) + log_ratio` over all overlaps and of the gains themselves, by
/// conjugate gradients.
fn solve(count: usize, overlaps: &[Overlap], channel: usize) -> Vec<f64> {
    let apply = |x: &[f64]| -> Vec<f64> {
        let mut y: Vec<f64> = x.iter().map(|x| PRIOR * x).collect();
        for overlap in overlaps {
            let difference = x[overlap.one] - x[overlap.other];
            y[overlap.one] += difference;
            y[overlap.other] -= difference;
        }
        y
    };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut residual = vec![0.0; count];
    for overlap in overlaps {
        residual[overlap.one] -= overlap.log_ratio[channel];
        residual[overlap.other] += overlap.log_ratio[channel];
    }
    let (mut gains, mut direction) = (vec![0.0; count], residual.clone());
    let mut square = dot(&residual, &residual);
    for _ in 0..1000 {
        if square < 1e-12 {
            break;
        }
        let image = apply(&direction);
        let step = square / dot(&direction, &image);
        for k in 0..count {
            gains[k] += step * direction[k];
            residual[k] -= step * image[k];
        }
        let next = dot(&residual, &residual);
        direction.iter_mut().zip(&residual).for_each(|(d, r)| *d = r + next / square * *d);
        square = next;
    }
    gains
}
