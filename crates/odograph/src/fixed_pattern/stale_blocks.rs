//! Parts of an image that are copies of the image before: what a lossy transmission did not
//! deliver, and a decoder left as it was.

use super::image_mask::{CELL_PX, ImageMask, cells};
use crate::image::GrayImage;

/// Side length of a block, cells: the macroblocks of video and JPEG are of 16x16 pixels.
const BLOCK_CELLS: usize = 4;
const BLOCK_PX: usize = BLOCK_CELLS * CELL_PX;

/// Blocks side by side that must be copies: what is lost are slices. Single blocks of coarsely
/// quantized video may be equal by chance.
const LEAST_RUN: usize = 8;

/// Part of the neighbouring pixels of a block that must differ: flat blocks are alike in any case.
const TEXTURED: f64 = 0.25;

/// Of an image with a larger share of copied blocks, the rest is not enough to go by.
const MOST_STALE: f64 = 0.75;

/// Parts of an image that are exactly as they were in the image before, with the patches that reach
/// into them. `None` if there is none, or little else. While the camera moves, no two images of the
/// same place have the same noise.
pub fn stale_blocks(image: &GrayImage, before: &GrayImage) -> Option<ImageMask> {
    let size = (image.width(), image.height());
    if size != (before.width(), before.height()) {
        return None;
    }
    let (columns, rows) = cells(size);
    let (across, down) = (size.0 / BLOCK_PX, size.1 / BLOCK_PX);
    let mut stale = Vec::new(); // allocated where something is found
    let mut count = 0;
    for row in 0..down {
        let mut run = 0;
        for column in 0..=across {
            if column < across && is_copied(image, before, (column * BLOCK_PX, row * BLOCK_PX)) {
                run += 1;
                continue;
            }
            if run >= LEAST_RUN {
                count += run;
                stale.resize(columns * rows, false);
                for cells in stale.chunks_exact_mut(columns).skip(row * BLOCK_CELLS).take(BLOCK_CELLS) {
                    cells[(column - run) * BLOCK_CELLS..column * BLOCK_CELLS].fill(true);
                }
            }
            run = 0;
        }
    }
    let is_partly = count > 0 && count as f64 <= MOST_STALE * (across * down) as f64;
    is_partly.then(|| ImageMask::of_cells(size, &stale, None).with_patches())
}

/// Whether the block at a pixel has texture and is the same in both images.
fn is_copied(image: &GrayImage, before: &GrayImage, (left, top): (usize, usize)) -> bool {
    let mut steps = 0;
    for y in top..top + BLOCK_PX {
        let block = &image.row(y)[left..][..BLOCK_PX];
        if block != &before.row(y)[left..][..BLOCK_PX] {
            return false;
        }
        steps += block.windows(2).filter(|pair| pair[0] != pair[1]).count();
    }
    steps as f64 > TEXTURED * (BLOCK_PX * (BLOCK_PX - 1)) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;

    const W: usize = 192;

    fn noise(seed: u64) -> GrayImage {
        let mut random = Random::new(seed);
        GrayImage::from_samples(W, 64, (0..W * 64).map(|_| random.below(256) as u8).collect()).unwrap()
    }

    #[test]
    fn copied_rows_are_found() {
        let before = noise(1);
        let mut image = noise(2);
        assert_eq!(stale_blocks(&image, &before), None);
        image.samples_mut()[16 * W..32 * W].copy_from_slice(&before.samples()[16 * W..32 * W]);
        let stale = stale_blocks(&image, &before).unwrap();
        assert!(stale.covers(50, 20) && stale.covers(50, 10), "patches reach into the block");
        assert!(!stale.covers(50, 55));
        assert_eq!(stale_blocks(&before, &before), None, "a copy of the whole image is something else");
        let [image, gray] = [3, 4].map(|seed| {
            let mut image = noise(seed);
            image.samples_mut()[16 * W..32 * W].fill(90);
            image
        });
        assert_eq!(stale_blocks(&image, &gray), None, "flat blocks are alike in any case");
    }
}
