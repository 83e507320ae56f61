//! Frames of a Y4M stream (uncompressed video of the mjpegtools), in full range.

use odograph::image::{GrayImage, RgbImage};

/// The line that a stream begins with; the frame rate is a fraction.
pub fn header(size: (usize, usize), (numerator, denominator): (u64, u64), colored: bool) -> Vec<u8> {
    let colors = if colored { "C420jpeg" } else { "Cmono" };
    let (width, height) = size;
    format!("YUV4MPEG2 W{width} H{height} F{numerator}:{denominator} Ip A1:1 {colors} XCOLORRANGE=FULL\n")
        .into_bytes()
}

/// One frame with its own line: its luminance, and its colour, if any.
pub fn frame(luma: &GrayImage, color: Option<&RgbImage>) -> Vec<u8> {
    let mut bytes = b"FRAME\n".to_vec();
    bytes.extend_from_slice(luma.samples());
    if let Some(color) = color {
        add_chroma(luma, color, &mut bytes);
    }
    bytes
}

/// Adds the two planes of colour differences, each the mean over 2 × 2 pixels (fewer at odd edges).
fn add_chroma(luma: &GrayImage, color: &RgbImage, bytes: &mut Vec<u8>) {
    let (width, height) = (color.width(), color.height());
    // BT.601, full range: (B − Y) / 1.772 and (R − Y) / 1.402.
    for (channel, divisor) in [(2, 1.772f32), (0, 1.402)] {
        for top in (0..height).step_by(2) {
            for left in (0..width).step_by(2) {
                let (mut sum, mut count) = (0.0, 0.0);
                for y in top..(top + 2).min(height) {
                    for x in left..(left + 2).min(width) {
                        sum += f32::from(color.pixel(x, y)[channel]) - f32::from(luma.row(y)[x]);
                        count += 1.0;
                    }
                }
                bytes.push((128.5 + sum / count / divisor) as u8);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chroma_of_gray_is_128_and_of_red_is_larger() {
        let mut bytes = vec![];
        let gray = GrayImage::from_samples(3, 3, vec![90; 9]).unwrap();
        add_chroma(&gray, &RgbImage::from(&gray), &mut bytes);
        assert_eq!(bytes, vec![128; 8]);
        bytes.clear();
        let red = RgbImage::from_samples(3, 3, [255, 0, 0].repeat(9)).unwrap();
        add_chroma(&GrayImage::from_samples(3, 3, vec![76; 9]).unwrap(), &red, &mut bytes);
        assert!(bytes[0] == 85 && bytes[4] == 255, "{bytes:?}");
    }
}
