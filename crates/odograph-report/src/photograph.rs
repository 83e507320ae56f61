//! A picture with transparent parts, for a page.
//!
//! Ground is like noise to a lossless format: as a PNG a mosaic has five to eight times the bytes
//! that it has as a JPEG. What is transparent is a mask beside it.

use odograph::drawing::svg::data_uri;
use odograph::image::RgbImage;
use odograph::mosaic::MosaicPicture;
use odograph_session::files;
use odograph_video::jpeg_from_rgb;

/// JPEG quality (1 to 100): higher enlarges the page without a visible difference at the size
/// shown.
const QUALITY: u8 = 88;

/// The image element of a mosaic; empty if it cannot be encoded.
pub fn photograph(picture: &MosaicPicture, alt: &str) -> String {
    let (width, height) = (picture.width, picture.height);
    let Some((jpeg, mask)) = jpeg_of(picture).zip(mask_of(picture)) else { return String::new() };
    format!(
        "<img width=\"{width}\" height=\"{height}\" alt=\"{alt}\" src=\"{}\" style=\"--seen:url({});\
         -webkit-mask:var(--seen) 0 0/100% 100%;mask:var(--seen) 0 0/100% 100%\">",
        data_uri("image/jpeg", &jpeg),
        data_uri("image/png", &mask),
    )
}

/// The colours. Transparent pixels repeat the last opaque one of their row, so that no edge is
/// coded.
fn jpeg_of(picture: &MosaicPicture) -> Option<Vec<u8>> {
    let mut rgb = Vec::with_capacity(3 * picture.width * picture.height);
    for row in picture.rgba.chunks_exact(4 * picture.width) {
        let first = row.chunks_exact(4).find(|pixel| pixel[3] > 0);
        let mut last = first.map_or([127; 3], |pixel| [pixel[0], pixel[1], pixel[2]]);
        for pixel in row.chunks_exact(4) {
            if pixel[3] > 0 {
                last = [pixel[0], pixel[1], pixel[2]];
            }
            rgb.extend_from_slice(&last);
        }
    }
    jpeg_from_rgb(&RgbImage::from_samples(picture.width, picture.height, rgb)?, QUALITY).ok()
}

/// The opacity alone, as a PNG.
fn mask_of(picture: &MosaicPicture) -> Option<Vec<u8>> {
    let black: Vec<u8> = picture.rgba.chunks_exact(4).flat_map(|pixel| [0, 0, 0, pixel[3]]).collect();
    files::png_from_rgba(picture.width, picture.height, &black).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::geometry::Placement;

    #[test]
    fn a_noisy_picture_is_smaller_than_its_png() {
        let (width, height) = (320, 240);
        let noise = |at: usize| (at.wrapping_mul(2_654_435_761) >> 13) as u8 & 31;
        let pixel = |at: usize| match at % width {
            // A third was not seen.
            x if x < width / 3 => [255, 255, 255, 0],
            _ => [100 + noise(at), 90 + noise(at + 1), 80 + noise(at + 2), 255],
        };
        let rgba: Vec<u8> = (0..width * height).flat_map(pixel).collect();
        let placement = Placement { metres_per_pixel: 0.01, x_m: 0.0, y_m: 0.0 };
        let picture = MosaicPicture { width, height, rgba, placement };
        let png = files::png_from_rgba(width, height, &picture.rgba).unwrap();
        let element = photograph(&picture, "ground");
        assert!(element.contains("data:image/jpeg;base64,") && element.contains("data:image/png;base64,"));
        assert!(4 * element.len() < 3 * png.len(), "{} {}", element.len(), png.len());
        let mask = mask_of(&picture).unwrap();
        assert!(10 * mask.len() < png.len(), "{} {}", mask.len(), png.len());
    }
}
