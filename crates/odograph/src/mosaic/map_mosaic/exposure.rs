//! Gain compensation between keyframes.
//!
//! Where two keyframes show the same ground, the ratio of their brightness is known; the gains are
//! the least-squares solution for all ratios in logarithms, with a weak prior at 1 (M. Brown and D.
//! G. Lowe, "Automatic panoramic image stitching using invariant features", 2007, section 6; there
//! in the gains themselves). Vignetting is equal in all keyframes: it shows where two of them see
//! the same ground at different distances from the image centre, and is corrected first.

use super::super::footprint::GroundCamera;
use super::PlacedKeyframe;
use crate::camera::Camera;
use crate::error::Result;
use crate::fixed_pattern::ImageMask;
use crate::geometry::Pixel;
use crate::ground_map::{KeyframeImage, KeyframeImages};
use crate::numerics::median;
use std::collections::BTreeMap;

/// Cells of a keyframe's thumbnail, columns and rows: brightness over a twentieth of the view,
/// without its texture.
const CELLS: (usize, usize) = (24, 18);
/// Number of overlaps compared for each keyframe, nearest first: more average better and take
/// longer.
const MAX_OVERLAPS: usize = 12;
/// Minimum number of cells that two keyframes must share to be compared; a whole thumbnail has 432.
const MIN_CELLS: usize = 12;
/// Cells whose log brightness differs by more than this after correction of exposure (35 %) show
/// shadows or something that moved.
const FARTHEST_LOG: f64 = 0.3;
/// Prior of the lens shading: weight of no shading, in units of the spread of image positions of
/// the shared ground. It decides where keyframes see shared ground at the same place of the image,
/// which says nothing about the lens.
const SPREAD_PRIOR: f64 = 1.0;
/// Prior of equal exposure: squared ratio of the standard deviation of a brightness ratio (1 %) to
/// that of exposure (20 %).
const PRIOR: f64 = 0.0025;

/// The gain of each keyframe and channel that equalises brightness, and the vignetting of the
/// lenses.
#[derive(Debug)]
pub(super) struct Gains {
    of: Vec<[f32; 3]>,
    /// By camera.
    darkening: Vec<Darkening>,
}

/// Vignetting: the logarithm of the brightness changes by `log_at_corner` times the square of the
/// distance from the centre, in half diagonals.
#[derive(Debug, Clone, Copy)]
pub(super) struct Darkening {
    middle: [f32; 2],
    by_half_diagonal: f32,
    log_at_corner: f32,
}

impl Darkening {
    fn none(camera: &Camera) -> Self {
        let (width, height) = (camera.width() as f32, camera.height() as f32);
        let middle = [0.5 * (width - 1.0), 0.5 * (height - 1.0)];
        Self { middle, by_half_diagonal: 2.0 / width.hypot(height), log_at_corner: 0.0 }
    }

    /// The square of a pixel's distance from the middle of the image, in half diagonals.
    #[inline]
    fn square(&self, x: f32, y: f32) -> f32 {
        let (x, y) = (x - self.middle[0], y - self.middle[1]);
        (x * x + y * y) * self.by_half_diagonal * self.by_half_diagonal
    }

    /// Factor that corrects the brightness of a pixel.
    #[inline]
    pub fn gain(&self, x: f32, y: f32) -> f32 {
        (-self.log_at_corner * self.square(x, y)).exp()
    }
}

/// Two keyframes that show the same ground: the logarithm of the first's brightness over the
/// second's, by channel.
struct Overlap {
    one: usize,
    other: usize,
    log_ratio: [f64; 3],
}

/// A keyframe's image in a few large cells: red, green, blue each; NaN where more than half of a
/// cell is masked.
struct Thumbnail(Vec<[f32; 3]>);

impl Gains {
    /// Estimates the gains of all keyframes. Loads every image once.
    pub fn settle(
        cameras: &[Camera],
        keyframes: &[PlacedKeyframe],
        images: &mut dyn KeyframeImages,
    ) -> Result<Self> {
        let mut thumbnails = Vec::with_capacity(keyframes.len());
        for placed in keyframes {
            thumbnails.push(Thumbnail::of(&images.load(placed.id)?, placed.mask.as_deref()));
        }
        let pairs = pairs(keyframes);
        let lens = |(index, camera): (usize, &Camera)| {
            let lens = Darkening::none(camera);
            let own = |k: &usize| keyframes[*k].camera == index;
            let pairs: Vec<_> = pairs.iter().copied().filter(|(one, other)| own(one) && own(other)).collect();
            let log_at_corner = log_at_corner(camera, keyframes, &thumbnails, &pairs, lens);
            Darkening { log_at_corner, ..lens }
        };
        let darkening: Vec<Darkening> = cameras.iter().enumerate().map(lens).collect();
        for (thumbnail, placed) in thumbnails.iter_mut().zip(keyframes) {
            thumbnail.brighten(&cameras[placed.camera], darkening[placed.camera]);
        }
        let overlaps: Vec<Overlap> = pairs
            .iter()
            .filter_map(|&(one, other)| {
                let shared = shared(
                    [one, other].map(|k| &cameras[keyframes[k].camera]),
                    (&keyframes[one], &keyframes[other]),
                    (&thumbnails[one], &thumbnails[other]),
                );
                Some(Overlap { one, other, log_ratio: log_exposure(&shared)? })
            })
            .collect();
        let logs: [Vec<f64>; 3] = std::array::from_fn(|channel| solve(keyframes.len(), &overlaps, channel));
        let gain = |k: usize| [0, 1, 2].map(|channel| logs[channel][k].exp().clamp(0.25, 4.0) as f32);
        Ok(Self { of: (0..keyframes.len()).map(gain).collect(), darkening })
    }

    /// The gains of a keyframe's channels.
    pub fn of(&self, keyframe: usize) -> [f32; 3] {
        self.of[keyframe]
    }

    /// The vignetting of a camera.
    pub fn darkening(&self, camera: usize) -> Darkening {
        self.darkening[camera]
    }
}

impl Thumbnail {
    fn of(image: &KeyframeImage, mask: Option<&ImageMask>) -> Self {
        let (width, height) = (image.gray.width(), image.gray.height());
        let cell = |k: usize| {
            let (column, row) = (k % CELLS.0, k / CELLS.0);
            let (left, right) = (
                column * width / CELLS.0,
                ((column + 1) * width / CELLS.0).max(column * width / CELLS.0 + 1),
            );
            let (top, bottom) =
                (row * height / CELLS.1, ((row + 1) * height / CELLS.1).max(row * height / CELLS.1 + 1));
            let (mut sum, mut count) = ([0.0_f32; 3], 0);
            for y in top..bottom.min(height) {
                for x in (left..right.min(width)).filter(|&x| mask.is_none_or(|mask| !mask.covers(x, y))) {
                    let pixel = match &image.color {
                        Some(color) => color.pixel(x, y),
                        None => [image.gray.row(y)[x]; 3],
                    };
                    (0..3).for_each(|c| sum[c] += f32::from(pixel[c]));
                    count += 1;
                }
            }
            let is_known = 2 * count >= (right - left) * (bottom - top);
            sum.map(|sum| if is_known { sum / count as f32 } else { f32::NAN })
        };
        Self((0..CELLS.0 * CELLS.1).map(cell).collect())
    }

    /// Corrects the vignetting.
    fn brighten(&mut self, camera: &Camera, darkening: Darkening) {
        for (k, cell) in self.0.iter_mut().enumerate() {
            let pixel = centre_of(camera, k);
            let gain = darkening.gain(pixel.x as f32, pixel.y as f32);
            cell.iter_mut().for_each(|value| *value *= gain);
        }
    }

    /// The brightness at a share of the image's width and height; `None` outside the centres of the
    /// outermost cells.
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

/// The pixel in the middle of a thumbnail's cell.
fn centre_of(camera: &Camera, cell: usize) -> Pixel {
    let (column, row) = (cell % CELLS.0, cell / CELLS.0);
    Pixel::new(
        (column as f64 + 0.5) / CELLS.0 as f64 * camera.width() as f64 - 0.5,
        (row as f64 + 0.5) / CELLS.1 as f64 * camera.height() as f64 - 0.5,
    )
}

/// The pairs of keyframes that may show the same ground.
fn pairs(keyframes: &[PlacedKeyframe]) -> Vec<(usize, usize)> {
    let centre = |k: usize| {
        let [left, bottom, right, top] = keyframes[k].bounds;
        (0.5 * (left + right), 0.5 * (bottom + top))
    };
    // Squares as large as the largest footprint: overlapping ones are in the same or in
    // neighbouring squares.
    let reach = |placed: &PlacedKeyframe| {
        (placed.bounds[2] - placed.bounds[0]).max(placed.bounds[3] - placed.bounds[1])
    };
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
        found.extend(others.into_iter().take(MAX_OVERLAPS).map(|other| (one, other)));
    }
    found
}

/// A spot of ground that two keyframes show: where each has it in its image, and the logarithms of
/// the ratios of their brightness by channel.
struct CommonGround {
    pixels: [[f32; 2]; 2],
    log_ratio: [f64; 3],
}

/// The spots that two keyframes share, one for each cell of the first.
fn shared(
    [camera, camera_of_other]: [&Camera; 2],
    (one, other): (&PlacedKeyframe, &PlacedKeyframe),
    thumbnails: (&Thumbnail, &Thumbnail),
) -> Vec<CommonGround> {
    let Some(view) = GroundCamera::new(camera_of_other, &other.pose) else { return Vec::new() };
    let (width, height) = (camera_of_other.width() as f64, camera_of_other.height() as f64);
    let spot = |(k, own): (usize, &[f32; 3])| {
        let pixel = centre_of(camera, k);
        let look = view.look(one.pose.ground_from_ray(camera.ray_from_pixel(pixel)?)?)?;
        let seen = thumbnails.1.at((look.x + 0.5) / width, (look.y + 0.5) / height)?;
        let is_exposed = |value: f64| value > 8.0 && value < 247.0;
        let known = (0..3).all(|c| is_exposed(f64::from(own[c])) && is_exposed(seen[c]));
        known.then(|| CommonGround {
            pixels: [[pixel.x as f32, pixel.y as f32], [look.x as f32, look.y as f32]],
            log_ratio: [0, 1, 2].map(|c| (f64::from(own[c]) / seen[c]).ln()),
        })
    };
    thumbnails.0.0.iter().enumerate().filter_map(spot).collect()
}

/// The median logarithm of each channel's ratio; `None` where too little is shared.
fn log_exposure(shared: &[CommonGround]) -> Option<[f64; 3]> {
    let of_channel = |channel: usize| {
        let mut ratios: Vec<f64> = shared.iter().map(|spot| spot.log_ratio[channel]).collect();
        median(&mut ratios).filter(|_| ratios.len() >= MIN_CELLS)
    };
    Some([of_channel(0)?, of_channel(1)?, of_channel(2)?])
}

/// Vignetting at the corner, as a logarithm: the slope of the brightness ratio over the difference
/// of the squared distances from the centre, over all shared spots; the median ratio of each pair
/// is its exposure and is subtracted.
fn log_at_corner(
    camera: &Camera,
    keyframes: &[PlacedKeyframe],
    thumbnails: &[Thumbnail],
    pairs: &[(usize, usize)],
    lens: Darkening,
) -> f32 {
    let (mut squares, mut products) = (SPREAD_PRIOR, 0.0);
    for &(one, other) in pairs {
        let spots =
            shared([camera; 2], (&keyframes[one], &keyframes[other]), (&thumbnails[one], &thumbnails[other]));
        let Some(exposure) = log_exposure(&spots) else { continue };
        let apart = |spot: &CommonGround| {
            f64::from(
                lens.square(spot.pixels[0][0], spot.pixels[0][1])
                    - lens.square(spot.pixels[1][0], spot.pixels[1][1]),
            )
        };
        let mean = spots.iter().map(apart).sum::<f64>() / spots.len() as f64;
        for spot in &spots {
            // Green represents all channels.
            let off = spot.log_ratio[1] - exposure[1];
            if off.abs() < FARTHEST_LOG {
                squares += (apart(spot) - mean).powi(2);
                products += (apart(spot) - mean) * off;
            }
        }
    }
    (products / squares).clamp(-1.5, 0.5) as f32
}

/// The logarithms of one channel's gains: least squares of `gain(one) − gain(other) + log_ratio`
/// over all overlaps and of the gains themselves, by conjugate gradients.
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
