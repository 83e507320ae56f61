//! The orthorectified view of the ground, a sample per spot.

use crate::camera::Camera;
use crate::fixed_pattern::ImageMask;
use crate::geometry::{GroundPoint, GroundPose, Pixel};
use crate::image::{GrayImage, Pyramid};

/// Mesh width, spots: the mapping from ground to image is exact at the nodes and interpolated
/// between them. Over 16 spots, a twentieth of an image, lens and tilt bend it by hundredths of a
/// pixel.
const MESH: usize = 16;

/// Maximum width and height of a view, spots: what a camera sees from twice the usual height.
const MAX_SPOTS: usize = 640;

/// Maximum distance from the point below the camera, in heights: beyond it ground is seen too
/// obliquely.
const REACH_IN_HEIGHTS: f64 = 2.5;

/// A picture of the ground from straight above: rows run against x (forward is up), columns against
/// y (left is left).
pub(super) struct OrthoView<'a> {
    /// One sample a spot; outside the camera's image, what its border shows.
    pub image: GrayImage,
    /// Ground in the camera's image and within the view, in spots.
    pub area: f64,
    /// What of the camera's image is not ground.
    mask: Option<&'a ImageMask>,
    spot_m: f64,
    /// Of the sample at the top left, metres from the point below the camera.
    corner_m: (f64, f64),
    mesh: Mesh,
}

/// Where the spots are in the camera's image, every [`MESH`] of them; pixels of the full image.
struct Mesh {
    columns: usize,
    pixels: Vec<[f32; 2]>,
    /// Coordinates of the last pixels.
    last: [f32; 2],
}

impl<'a> OrthoView<'a> {
    /// `None` where less than 64 spots of ground are seen along a side.
    pub fn new(
        pyramid: &Pyramid,
        camera: &Camera,
        mask: Option<&'a ImageMask>,
        pose: &GroundPose,
        spot_m: f64,
    ) -> Option<Self> {
        const LEAST: usize = 64;
        let pose = GroundPose { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, ..*pose };
        let (low, high) = footprint(camera, &pose)?;
        let middle = (0.5 * (low.0 + high.0), 0.5 * (low.1 + high.1));
        let spots = |low: f64, high: f64| (((high - low) / spot_m) as usize).min(MAX_SPOTS);
        let (width, height) = (spots(low.1, high.1), spots(low.0, high.0));
        if width < LEAST || height < LEAST {
            return None;
        }
        let half = |spots: usize| 0.5 * (spots as f64 - 1.0) * spot_m;
        let corner_m = (middle.0 + half(height), middle.1 + half(width));
        let mesh = Mesh::new(camera, &pose, (width, height), corner_m, spot_m);
        let spot_px = mesh.pixels_per_spot(width, height);
        let image = mesh.sampled(pyramid, spot_px, (width, height));
        let seen = (camera.width() * camera.height()) as f64 / (spot_px * spot_px);
        let open = 1.0 - mask.map_or(0.0, ImageMask::share);
        let area = open * seen.min((width * height) as f64);
        Some(Self { image, area, mask, spot_m, corner_m, mesh })
    }

    /// Whether the camera's image shows the ground in a disc of `radius` spots around a sample.
    pub fn sees(&self, (column, row): (usize, usize), radius: f32) -> bool {
        let place = (column as f32, row as f32);
        let around = |radius: f32| {
            (0..8).map(move |eighth| {
                let (sin, cos) = (eighth as f32 * std::f32::consts::FRAC_PI_4).sin_cos();
                (place.0 + radius * cos, place.1 + radius * sin)
            })
        };
        let is_inside = |(column, row): (f32, f32)| {
            let [x, y] = self.mesh.pixel(column, row);
            x >= 0.0 && y >= 0.0 && x <= self.mesh.last[0] && y <= self.mesh.last[1]
        };
        around(radius).all(is_inside)
            && !around(radius).chain(around(0.5 * radius)).chain([place]).any(|at| self.is_masked(at))
    }

    /// Whether a place of the view is known not to show the ground.
    pub fn is_masked(&self, (column, row): (f32, f32)) -> bool {
        self.mask.is_some_and(|mask| {
            let [x, y] = self.mesh.pixel(column, row);
            mask.covers_pixel(Pixel::new(f64::from(x), f64::from(y)))
        })
    }

    /// Whether some of the camera's image is known not to show the ground.
    pub fn has_mask(&self) -> bool {
        self.mask.is_some()
    }

    /// Where a sample lies from the point below the camera: forward and to the left, metres.
    pub fn position_m(&self, (column, row): (f64, f64)) -> [f32; 2] {
        [(self.corner_m.0 - row * self.spot_m) as f32, (self.corner_m.1 - column * self.spot_m) as f32]
    }
}

impl Mesh {
    fn new(
        camera: &Camera,
        pose: &GroundPose,
        (width, height): (usize, usize),
        corner_m: (f64, f64),
        spot_m: f64,
    ) -> Self {
        let (columns, rows) = (width.div_ceil(MESH) + 1, height.div_ceil(MESH) + 1);
        let at = |i: usize| {
            let (column, row) = ((i % columns * MESH) as f64, (i / columns * MESH) as f64);
            let point = GroundPoint::new(corner_m.0 - row * spot_m, corner_m.1 - column * spot_m);
            let pixel = pose.ray_from_ground(point).and_then(|ray| camera.pixel_from_ray(ray));
            pixel.map_or([f32::NAN; 2], |pixel| [pixel.x as f32, pixel.y as f32])
        };
        let pixels = (0..columns * rows).map(at).collect();
        Self { columns, pixels, last: [camera.width() as f32 - 1.0, camera.height() as f32 - 1.0] }
    }

    /// The pixel of a place in the view; NaN where the lens shows none.
    fn pixel(&self, column: f32, row: f32) -> [f32; 2] {
        let rows = self.pixels.len() / self.columns;
        let (u, v) = (column.max(0.0) / MESH as f32, row.max(0.0) / MESH as f32);
        let (i, j) = ((u as usize).min(self.columns - 2), (v as usize).min(rows - 2));
        let (u, v) = (u - i as f32, v - j as f32);
        let at = |i: usize, j: usize| self.pixels[j * self.columns + i];
        let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i, j + 1), at(i + 1, j + 1));
        std::array::from_fn(|k| {
            let (above, below) = (a[k] + (b[k] - a[k]) * u, c[k] + (d[k] - c[k]) * u);
            above + (below - above) * v
        })
    }

    /// How many pixels a spot in the middle of the view is wide.
    fn pixels_per_spot(&self, width: usize, height: usize) -> f64 {
        let (column, row) = (0.5 * width as f32, 0.5 * height as f32);
        let [a, b, c] = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)].map(|(i, j)| self.pixel(column + i, row + j));
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        f64::from(area.abs().sqrt())
    }

    /// The view, from the level of the pyramid whose pixels cover about a spot.
    fn sampled(&self, pyramid: &Pyramid, spot_px: f64, (width, height): (usize, usize)) -> GrayImage {
        let level = ((spot_px.log2() + 0.3).max(0.0) as usize).min(pyramid.levels() - 1);
        let (source, scale) = (pyramid.level(level), 1.0 / (1u32 << level) as f32);
        let mut view = GrayImage::new(width, height);
        for (row, samples) in view.samples_mut().chunks_exact_mut(width).enumerate() {
            for (block, samples) in samples.chunks_mut(MESH).enumerate() {
                let first = self.pixel((block * MESH) as f32, row as f32);
                let beyond = self.pixel(((block + 1) * MESH) as f32, row as f32);
                let step: [f32; 2] = std::array::from_fn(|k| (beyond[k] - first[k]) / MESH as f32);
                for (i, sample) in samples.iter_mut().enumerate() {
                    let at = |k: usize| (first[k] + i as f32 * step[k]) * scale;
                    *sample = bilinear(source, at(0), at(1));
                }
            }
        }
        view
    }
}

/// The sample at a place of an image; outside it, at the nearest place of its border.
#[inline]
fn bilinear(image: &GrayImage, x: f32, y: f32) -> u8 {
    let (width, height) = (image.width(), image.height());
    // `max` before `min` takes NaN to zero.
    let (x, y) = (x.max(0.0).min(width as f32 - 1.001), y.max(0.0).min(height as f32 - 1.001));
    let (left, top) = (x as usize, y as usize);
    let (u, v) = (x - left as f32, y - top as f32);
    let at = top * width + left;
    let samples = image.samples();
    let [a, b] = [samples[at], samples[at + 1]].map(f32::from);
    let [c, d] = [samples[at + width], samples[at + width + 1]].map(f32::from);
    let (above, below) = (a + (b - a) * u, c + (d - c) * u);
    (above + (below - above) * v + 0.5) as u8
}

/// The rectangle of ground that the image covers, as far as it is near enough: lower and upper ends
/// of x and y, metres.
fn footprint(camera: &Camera, pose: &GroundPose) -> Option<((f64, f64), (f64, f64))> {
    const STEPS: usize = 12;
    let (width, height) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let mut low = (f64::INFINITY, f64::INFINITY);
    let mut high = (f64::NEG_INFINITY, f64::NEG_INFINITY);
    for (j, i) in (0..=STEPS).flat_map(|j| (0..=STEPS).map(move |i| (j, i))) {
        let pixel = Pixel::new(i as f64 / STEPS as f64 * width, j as f64 / STEPS as f64 * height);
        let point = camera.ray_from_pixel(pixel).and_then(|ray| pose.ground_from_ray(ray));
        let Some(point) = point.filter(|p| p.x_m.hypot(p.y_m) <= REACH_IN_HEIGHTS * pose.height_m) else {
            continue;
        };
        low = (low.0.min(point.x_m), low.1.min(point.y_m));
        high = (high.0.max(point.x_m), high.1.max(point.y_m));
    }
    (low.0 < high.0 && low.1 < high.1).then_some((low, high))
}
