//! Digital image correction (subsystem 2 of the paper): removes lens distortion.
//!
//! Points are undistorted one by one, for a few microseconds each; tracking needs nothing else.
//! Whole images are rectified only for display and export: [`ImageCorrection`] precomputes the
//! remap table once.

use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};
use crate::geometry::{Pixel, Ray};
use crate::image::simd::remap::{ONE, Remap, SourcePosition};
use crate::image::{GrayImage, RgbImage};

fn pinhole_ray(camera: &Camera, pixel: Pixel) -> Ray {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    Ray::new((pixel.x - cx) / fx, (pixel.y - cy) / fy)
}

/// Field of view of a rectified image. Its size in pixels and the ratio of its focal lengths are
/// always those of the source, so square pixels stay square.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FieldOfViewKept {
    /// Keeps focal lengths and principal point: the scale at the centre is that of the source.
    #[default]
    SameFocalLength,
    /// The largest field of view without empty pixels.
    ValidPixels,
    /// The whole field of view of the source; pixels outside it are black.
    AllPixels,
}

/// Rectification of whole images of one camera by a precomputed remap table.
///
/// The table holds, for every pixel of the rectified image, its position in the source: the upper
/// left of the four interpolated samples and two fractions in 1/2048 pixel, 6 bytes a pixel.
/// Rounding the fractions changes a sample by at most one level. No lens model is evaluated while
/// images are rectified.
#[derive(Debug, Clone)]
pub struct ImageCorrection {
    source: Camera,
    corrected: Camera,
    remap: Remap,
}

impl ImageCorrection {
    /// The rectification of images of `camera` to a pinhole camera.
    ///
    /// Fails where `kept` is all pixels but the lens model does not reach the edge of the image,
    /// and where the requested field of view has no valid pinhole camera.
    pub fn new(camera: &Camera, kept: FieldOfViewKept) -> Result<Self> {
        let corrected = match kept {
            FieldOfViewKept::SameFocalLength => {
                let size = (camera.width(), camera.height());
                Camera::new(size, camera.focal_px(), camera.principal_px(), Distortion::None)?
            }
            FieldOfViewKept::ValidPixels => valid_view(camera)?,
            FieldOfViewKept::AllPixels => whole_view(camera)?,
        };
        // The rows of a rolling shutter are curves in the rectified image, which no readout time
        // describes; a global shutter stays one.
        let corrected = corrected.with_readout_s(camera.readout_s().filter(|readout_s| *readout_s == 0.0))?;
        let size = |camera: &Camera| (camera.width(), camera.height());
        let remap = Remap::new(size(camera), size(&corrected), |x, y| {
            let place = source_pixel(camera, &corrected, Pixel::new(x as f64, y as f64))?;
            Some(rounded(camera, place))
        });
        Ok(Self { source: camera.clone(), corrected, remap })
    }

    /// The pinhole camera of the rectified images. Its readout time is that of a global shutter
    /// where the source has one, and unknown otherwise.
    pub fn camera(&self) -> &Camera {
        &self.corrected
    }

    /// Number of pixels of a rectified image that lie outside the source; they are black.
    pub fn pixels_without_source(&self) -> usize {
        self.remap.without_source()
    }

    /// Position in the source of a rectified pixel; `None` outside the source, whose border is half
    /// a pixel beyond the centres of its outermost pixels.
    pub fn source_pixel(&self, pixel: Pixel) -> Option<Pixel> {
        source_pixel(&self.source, &self.corrected, pixel)
    }

    /// The rectified image: bilinear interpolation, border samples replicated over the outer half
    /// pixel, black outside the source.
    ///
    /// Fails where the image is not of the camera's size.
    pub fn apply(&self, image: &GrayImage) -> Result<GrayImage> {
        let mut corrected = GrayImage::new(self.corrected.width(), self.corrected.height());
        self.apply_into(image, &mut corrected)?;
        Ok(corrected)
    }

    /// [`ImageCorrection::apply`] into an existing image. Also fails where that has another size.
    pub fn apply_into(&self, image: &GrayImage, corrected: &mut GrayImage) -> Result<()> {
        self.check_size(image.width(), image.height())?;
        self.check_size(corrected.width(), corrected.height())?;
        self.remap.apply::<1>(image.samples(), corrected.samples_mut());
        Ok(())
    }

    /// [`ImageCorrection::apply`] for colour images.
    pub fn apply_rgb(&self, image: &RgbImage) -> Result<RgbImage> {
        let mut corrected = RgbImage::new(self.corrected.width(), self.corrected.height());
        self.apply_rgb_into(image, &mut corrected)?;
        Ok(corrected)
    }

    /// [`ImageCorrection::apply_into`] for colour images.
    pub fn apply_rgb_into(&self, image: &RgbImage, corrected: &mut RgbImage) -> Result<()> {
        self.check_size(image.width(), image.height())?;
        self.check_size(corrected.width(), corrected.height())?;
        self.remap.apply::<3>(image.samples(), corrected.samples_mut());
        Ok(())
    }

    fn check_size(&self, width: usize, height: usize) -> Result<()> {
        if (width, height) == (self.source.width(), self.source.height()) {
            return Ok(());
        }
        Err(Error::input(format!(
            "an image of {width}x{height} pixels cannot be corrected by a camera calibrated for {}x{}",
            self.source.width(),
            self.source.height()
        )))
    }
}

fn source_pixel(source: &Camera, corrected: &Camera, pixel: Pixel) -> Option<Pixel> {
    source.pixel_from_ray(pinhole_ray(corrected, pixel)).filter(|&at| source.contains(at, -0.5))
}

/// Quantises a source position to a [`SourcePosition`]; positions beyond the outermost pixel
/// centres are clamped to them.
fn rounded(camera: &Camera, place: Pixel) -> SourcePosition {
    let split = |place: f64, size: usize| {
        let place = place.clamp(0.0, size as f64 - 1.0);
        let first = (place as usize).min(size.saturating_sub(2));
        (first, ((place - first as f64) * f64::from(ONE)).round() as u16)
    };
    let (column, right) = split(place.x, camera.width());
    let (row, down) = split(place.y, camera.height());
    SourcePosition { column, row, right, down }
}

/// A rectangular field of view: tangents of the angles of its left, right, top and bottom sides.
#[derive(Debug, Clone, Copy)]
struct TangentBounds {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

impl TangentBounds {
    /// The pinhole camera of the same image size centred on this view, with focal lengths `zoom`
    /// times those of `camera`.
    fn pinhole(&self, camera: &Camera, zoom: f64) -> Result<Camera> {
        let (w, h) = (camera.width() as f64, camera.height() as f64);
        let (fx, fy) = (zoom * camera.focal_px().0, zoom * camera.focal_px().1);
        let principal_px = (
            (w - 1.0) / 2.0 - fx * (self.left + self.right) / 2.0,
            (h - 1.0) / 2.0 - fy * (self.top + self.bottom) / 2.0,
        );
        Camera::new((camera.width(), camera.height()), (fx, fy), principal_px, Distortion::None)
    }

    /// The zooms at which the view's width and height fill the image from first to last pixel
    /// centre.
    fn zooms(&self, camera: &Camera) -> (f64, f64) {
        let zoom = |pixels: usize, focal_px: f64, tangents: f64| {
            // An image of one column or row has no extent to fit.
            if pixels > 1 { (pixels as f64 - 1.0) / (focal_px * tangents) } else { 1.0 }
        };
        let (fx, fy) = camera.focal_px();
        let Self { left, right, top, bottom } = *self;
        (zoom(camera.width(), fx, right - left), zoom(camera.height(), fy, bottom - top))
    }
}

/// The pixels of the first and last rows and columns of the image.
fn edge_pixels(camera: &Camera) -> impl Iterator<Item = Pixel> {
    let (last_x, last_y) = (camera.width() - 1, camera.height() - 1);
    let rows = (0..=last_x).flat_map(move |x| [(x, 0), (x, last_y)]);
    let columns = (0..=last_y).flat_map(move |y| [(0, y), (last_x, y)]);
    rows.chain(columns).map(|(x, y)| Pixel::new(x as f64, y as f64))
}

/// The pinhole camera with the smallest view that contains the whole view of `camera`.
fn whole_view(camera: &Camera) -> Result<Camera> {
    const OUT_OF_REACH: &str = "the lens model does not reach the edge of the image, so that not all pixels can be kept; keep \
                                the valid pixels or the focal length instead";
    let mut view = TangentBounds {
        left: f64::INFINITY,
        right: f64::NEG_INFINITY,
        top: f64::INFINITY,
        bottom: f64::NEG_INFINITY,
    };
    for pixel in edge_pixels(camera) {
        let ray = camera.ray_from_pixel(pixel).ok_or_else(|| Error::input(OUT_OF_REACH))?;
        view.left = view.left.min(ray.x);
        view.right = view.right.max(ray.x);
        view.top = view.top.min(ray.y);
        view.bottom = view.bottom.max(ray.y);
    }
    let (across, along) = view.zooms(camera);
    view.pinhole(camera, across.min(along))
}

/// The pinhole camera with the largest view inside that of `camera`.
fn valid_view(camera: &Camera) -> Result<Camera> {
    const NOTHING: &str = "the lens model leaves no rectangle of valid pixels; keep the focal length instead";
    let nothing = || Error::input(NOTHING);
    let (last_x, last_y) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let mut view = TangentBounds {
        left: f64::NEG_INFINITY,
        right: f64::INFINITY,
        top: f64::NEG_INFINITY,
        bottom: f64::INFINITY,
    };
    for pixel in edge_pixels(camera) {
        // Where the model does not reach the border, the fallback below applies.
        let Some(ray) = camera.ray_from_pixel(pixel) else { continue };
        if pixel.x == 0.0 {
            view.left = view.left.max(ray.x);
        }
        if pixel.x == last_x {
            view.right = view.right.min(ray.x);
        }
        if pixel.y == 0.0 {
            view.top = view.top.max(ray.y);
        }
        if pixel.y == last_y {
            view.bottom = view.bottom.min(ray.y);
        }
    }
    let size = (camera.width(), camera.height());
    // For a side whose border the model does not reach at all: the outermost pixel it reaches on
    // the line through the principal point.
    let (cx, cy) = camera.principal_px();
    let across = |x: usize| camera.ray_from_pixel(Pixel::new(x as f64, cy)).map(|ray| ray.x);
    let along = |y: usize| camera.ray_from_pixel(Pixel::new(cx, y as f64)).map(|ray| ray.y);
    for (side, reached) in [
        (&mut view.left, (0..size.0).find_map(across)),
        (&mut view.right, (0..size.0).rev().find_map(across)),
        (&mut view.top, (0..size.1).find_map(along)),
        (&mut view.bottom, (0..size.1).rev().find_map(along)),
    ] {
        if side.is_infinite() {
            *side = reached.ok_or_else(nothing)?;
        }
    }
    if (size.0 > 1 && view.left >= view.right) || (size.1 > 1 && view.top >= view.bottom) {
        return Err(nothing());
    }
    let (across, along) = view.zooms(camera);
    let fits = |pinhole: &Camera| edge_pixels(pinhole).all(|p| source_pixel(camera, pinhole, p).is_some());
    let widest = across.max(along);
    let pinhole = view.pinhole(camera, widest)?;
    if fits(&pinhole) {
        return Ok(pinhole);
    }
    // For borders that are not simply curved or that the model does not reach: zoom in until all
    // pixels are valid, then bisect.
    let (mut too_wide, mut narrow) = (widest, widest);
    let mut pinhole = loop {
        narrow *= 1.25;
        let pinhole = view.pinhole(camera, narrow)?;
        if fits(&pinhole) {
            break pinhole;
        }
        if narrow > 100.0 * widest {
            return Err(nothing());
        }
        too_wide = narrow;
    };
    for _ in 0..20 {
        let between = (too_wide + narrow) / 2.0;
        let candidate = view.pinhole(camera, between)?;
        if fits(&candidate) {
            (narrow, pinhole) = (between, candidate);
        } else {
            too_wide = between;
        }
    }
    Ok(pinhole)
}

#[cfg(test)]
mod tests;
