//! Rasterisation of drawings, with an embedded font.

use odograph::error::{Error, Result};
use odograph::image::GrayImage;
use resvg::{tiny_skia, usvg};
use std::sync::Arc;

const REGULAR: &[u8] = include_bytes!("fonts/Roboto-Regular.ttf");
const MEDIUM: &[u8] = include_bytes!("fonts/Roboto-Medium.ttf");
/// Width of `map.png`, pixels.
pub const MAP_WIDTH_PX: u32 = 1600;

/// Renders an SVG drawing as PNG, `width_px` wide. The result is the same on every machine: only
/// embedded fonts are used, and no external references of the drawing are opened.
pub fn drawing_png(svg: &str, width_px: u32) -> Result<Vec<u8>> {
    let pixels = picture(svg, width_px)?;
    // The background is opaque, so premultiplied colours equal the plain ones.
    let rgb: Vec<u8> = pixels.data().chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    odograph_session::files::png_from_rgb_samples(pixels.width() as usize, pixels.height() as usize, &rgb)
}

/// Renders a monochrome SVG drawing as a gray image, `width_px` wide, in the same way as
/// [`drawing_png`].
pub fn gray_picture(svg: &str, width_px: u32) -> Result<GrayImage> {
    let pixels = picture(svg, width_px)?;
    let mut gray = GrayImage::new(pixels.width() as usize, pixels.height() as usize);
    for (sample, pixel) in gray.samples_mut().iter_mut().zip(pixels.data().chunks_exact(4)) {
        *sample = pixel[1];
    }
    Ok(gray)
}

fn picture(svg: &str, width_px: u32) -> Result<tiny_skia::Pixmap> {
    let wrong = |what: String| Error::output(format!("the drawing cannot be made a picture: {what}"));
    let mut fonts = usvg::fontdb::Database::new();
    fonts.load_font_data(REGULAR.to_vec());
    fonts.load_font_data(MEDIUM.to_vec());
    fonts.set_sans_serif_family("Roboto");
    let options = usvg::Options {
        font_family: "Roboto".into(),
        fontdb: Arc::new(fonts),
        image_href_resolver: usvg::ImageHrefResolver {
            resolve_data: usvg::ImageHrefResolver::default_data_resolver(),
            resolve_string: Box::new(|_, _| None),
        },
        // Embedded images are downscaled, where bicubic interpolation over 4×4 pixels shows nothing
        // more than bilinear over 2×2.
        image_rendering: usvg::ImageRendering::Smooth,
        ..usvg::Options::default()
    };
    let tree = usvg::Tree::from_str(svg, &options).map_err(|error| wrong(error.to_string()))?;
    let scale = width_px as f32 / tree.size().width();
    let height_px = (tree.size().height() * scale).ceil() as u32;
    let mut pixels = tiny_skia::Pixmap::new(width_px, height_px)
        .ok_or_else(|| wrong(format!("{width_px}x{height_px} pixels are no picture")))?;
    pixels.fill(tiny_skia::Color::WHITE);
    resvg::render(&tree, tiny_skia::Transform::from_scale(scale, scale), &mut pixels.as_mut());
    Ok(pixels)
}
