//! Digital image correction (subsystem 2 of the paper): what a lens has bent is made straight again.
//!
//! Points are corrected by themselves, for a few microseconds each: tracking needs nothing else. A whole image is corrected
//! only where somebody wants a picture: [`ImageCorrection`] looks up once where each of its pixels comes from.

use crate::camera::{Camera, Distortion};
use crate::error::{Error, Result};
use crate::geometry::{Pixel, Ray};
use crate::image::simd::remap::{ONE, Place, Remap};
use crate::image::{GrayImage, RgbImage};

/// Where a pinhole of the same focal lengths and principal point sees what `camera` sees at `pixel`; may lie outside the image.
/// `None` where no ray of the lens model reaches the pixel.
pub fn undistorted_pixel(camera: &Camera, pixel: Pixel) -> Option<Pixel> {
    camera.ray_from_pixel(pixel).map(|ray| pinhole_pixel(camera, ray))
}

/// [`undistorted_pixel`] of each of the pixels, in their order.
pub fn undistorted_pixels(camera: &Camera, pixels: &[Pixel]) -> Vec<Option<Pixel>> {
    pixels.iter().map(|&pixel| undistorted_pixel(camera, pixel)).collect()
}

/// Where `camera` sees what a pinhole of the same focal lengths and principal point sees at `pixel`; undoes
/// [`undistorted_pixel`]. `None` where the lens model is not one to one.
pub fn distorted_pixel(camera: &Camera, pixel: Pixel) -> Option<Pixel> {
    camera.pixel_from_ray(pinhole_ray(camera, pixel))
}

/// [`distorted_pixel`] of each of the pixels, in their order.
pub fn distorted_pixels(camera: &Camera, pixels: &[Pixel]) -> Vec<Option<Pixel>> {
    pixels.iter().map(|&pixel| distorted_pixel(camera, pixel)).collect()
}

fn pinhole_pixel(camera: &Camera, ray: Ray) -> Pixel {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    Pixel::new(fx * ray.x + cx, fy * ray.y + cy)
}

fn pinhole_ray(camera: &Camera, pixel: Pixel) -> Ray {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    Ray::new((pixel.x - cx) / fx, (pixel.y - cy) / fy)
}

/// How much of what the lens sees a corrected image shows. Its size in pixels is that of the source in every case, and the ratio
/// of its focal lengths too: square pixels stay square.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum FieldOfViewKept {
    /// Focal lengths and principal point stay: the scale at the centre is that of the source.
    #[default]
    SameFocalLength,
    /// As much as fits without an empty pixel.
    ValidPixels,
    /// Everything; pixels that the lens does not see are black.
    AllPixels,
}

/// The correction of whole images of one camera.
///
/// It holds, for every pixel of the corrected image, where in the source it comes from: the place of the upper left of four
/// samples and two fractions in 1/2048 pixel, 6 bytes a pixel. That is exact enough that a sample differs by at most one level
/// from the one computed without rounding, and no lens model is evaluated while images are corrected.
#[derive(Debug, Clone)]
pub struct ImageCorrection {
    source: Camera,
    corrected: Camera,
    remap: Remap,
}

impl ImageCorrection {
    /// The correction of images of `camera` to those of a pinhole.
    ///
    /// Fails where the lens model does not reach the whole image but all pixels are to be kept, or where the view that is to be
    /// kept is no camera's.
    pub fn new(camera: &Camera, kept: FieldOfViewKept) -> Result<Self> {
        let corrected = match kept {
            FieldOfViewKept::SameFocalLength => {
                let size = (camera.width(), camera.height());
                Camera::new(size, camera.focal_px(), camera.principal_px(), Distortion::None)?
            }
            FieldOfViewKept::ValidPixels => valid_view(camera)?,
            FieldOfViewKept::AllPixels => whole_view(camera)?,
        };
        let size = |camera: &Camera| (camera.width(), camera.height());
        let remap = Remap::new(size(camera), size(&corrected), |x, y| {
            let place = source_pixel(camera, &corrected, Pixel::new(x as f64, y as f64))?;
            Some(rounded(camera, place))
        });
        Ok(Self { source: camera.clone(), corrected, remap })
    }

    /// The camera that takes the corrected images: a pinhole.
    pub fn camera(&self) -> &Camera {
        &self.corrected
    }

    /// How many pixels of a corrected image lie outside the source; they are black.
    pub fn pixels_without_source(&self) -> usize {
        self.remap.without_source()
    }

    /// Where the corrected image shows what the source has at `pixel`; may lie outside the image. `None` where no ray of the lens
    /// model reaches the pixel.
    pub fn corrected_pixel(&self, pixel: Pixel) -> Option<Pixel> {
        self.source.ray_from_pixel(pixel).map(|ray| pinhole_pixel(&self.corrected, ray))
    }

    /// Where the source has what the corrected image shows at `pixel`; `None` outside the source, whose outer edge is half a pixel
    /// beyond the centres of its outermost pixels.
    pub fn source_pixel(&self, pixel: Pixel) -> Option<Pixel> {
        source_pixel(&self.source, &self.corrected, pixel)
    }

    /// The corrected image: bilinear between pixel centres, the outermost samples out to the edge, black outside.
    ///
    /// Fails where the image is not of the camera's size.
    pub fn apply(&self, image: &GrayImage) -> Result<GrayImage> {
        let mut corrected = GrayImage::new(self.corrected.width(), self.corrected.height());
        self.apply_into(image, &mut corrected)?;
        Ok(corrected)
    }

    /// [`ImageCorrection::apply`] into an image whose memory is used again. Fails also where that is of another size.
    pub fn apply_into(&self, image: &GrayImage, corrected: &mut GrayImage) -> Result<()> {
        self.check_size(image.width(), image.height())?;
        self.check_size(corrected.width(), corrected.height())?;
        self.remap.apply::<1>(image.samples(), corrected.samples_mut());
        Ok(())
    }

    /// [`ImageCorrection::apply`] in colour.
    pub fn apply_rgb(&self, image: &RgbImage) -> Result<RgbImage> {
        let mut corrected = RgbImage::new(self.corrected.width(), self.corrected.height());
        self.apply_rgb_into(image, &mut corrected)?;
        Ok(corrected)
    }

    /// [`ImageCorrection::apply_into`] in colour.
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

/// A place between the centres of the source's pixels; what lies beyond the outermost centres is moved to them.
fn rounded(camera: &Camera, place: Pixel) -> Place {
    let split = |place: f64, size: usize| {
        let place = place.clamp(0.0, size as f64 - 1.0);
        let first = (place as usize).min(size.saturating_sub(2));
        (first, ((place - first as f64) * f64::from(ONE)).round() as u16)
    };
    let (column, right) = split(place.x, camera.width());
    let (row, down) = split(place.y, camera.height());
    Place { column, row, right, down }
}

/// A rectangle of directions: tangents to the left, right, top and bottom.
#[derive(Debug, Clone, Copy)]
struct View {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

impl View {
    /// The pinhole of the camera's size that looks at the view's middle, with focal lengths `zoom` times the camera's.
    fn pinhole(&self, camera: &Camera, zoom: f64) -> Result<Camera> {
        let (w, h) = (camera.width() as f64, camera.height() as f64);
        let (fx, fy) = (zoom * camera.focal_px().0, zoom * camera.focal_px().1);
        let principal_px = (
            (w - 1.0) / 2.0 - fx * (self.left + self.right) / 2.0,
            (h - 1.0) / 2.0 - fy * (self.top + self.bottom) / 2.0,
        );
        Camera::new((camera.width(), camera.height()), (fx, fy), principal_px, Distortion::None)
    }

    /// The zooms at which the view is as wide, and as high, as the image from first to last pixel centre.
    fn zooms(&self, camera: &Camera) -> (f64, f64) {
        let zoom = |pixels: usize, focal_px: f64, tangents: f64| {
            // One column or row shows any view.
            if pixels > 1 { (pixels as f64 - 1.0) / (focal_px * tangents) } else { 1.0 }
        };
        let (fx, fy) = camera.focal_px();
        let Self { left, right, top, bottom } = *self;
        (zoom(camera.width(), fx, right - left), zoom(camera.height(), fy, bottom - top))
    }
}

/// The pixels of the image's first and last row and column.
fn edge_pixels(camera: &Camera) -> impl Iterator<Item = Pixel> {
    let (last_x, last_y) = (camera.width() - 1, camera.height() - 1);
    let rows = (0..=last_x).flat_map(move |x| [(x, 0), (x, last_y)]);
    let columns = (0..=last_y).flat_map(move |y| [(0, y), (last_x, y)]);
    rows.chain(columns).map(|(x, y)| Pixel::new(x as f64, y as f64))
}

/// The pinhole that sees all that the camera sees.
fn whole_view(camera: &Camera) -> Result<Camera> {
    const OUT_OF_REACH: &str = "the lens model does not reach the edge of the image, so that not all pixels can be kept; keep \
                                the valid pixels or the focal length instead";
    let mut view =
        View { left: f64::INFINITY, right: f64::NEG_INFINITY, top: f64::INFINITY, bottom: f64::NEG_INFINITY };
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

/// The pinhole that sees as much as it can without seeing anything that the camera does not.
fn valid_view(camera: &Camera) -> Result<Camera> {
    const NOTHING: &str = "the lens model leaves no rectangle of valid pixels; keep the focal length instead";
    let nothing = || Error::input(NOTHING);
    let (last_x, last_y) = (camera.width() as f64 - 1.0, camera.height() as f64 - 1.0);
    let mut view =
        View { left: f64::NEG_INFINITY, right: f64::INFINITY, top: f64::NEG_INFINITY, bottom: f64::INFINITY };
    for pixel in edge_pixels(camera) {
        // Where the model does not reach the edge, what it reaches decides below.
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
    // A side that the model reaches nowhere: as far as it reaches from the principal point towards it.
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
    // A lens whose edges are not simply curved, or that does not reach them: zoom in until everything is seen.
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
