//! How two registered images of the ground differ: by noise, or by what is peculiar to a place.
//!
//! On ground that repeats, such as tiles or a printed floor, the corners of a place are found at
//! its lookalikes too. What remains when registered images are divided by each other tells them
//! apart: the repeating part cancels, at every period alike. Over one place noise remains, whose
//! mean over a square falls with the side of the square. Over a lookalike the differences of grain,
//! stains and wear remain too, whose mean falls much less.
//!
//! The images may differ by a gain, a black level (a picture of full range beside a video of
//! limited range) and darker corners, all of which are fitted and subtracted. On the demo's bricks
//! the black level had left 0.0145 where 0.005 remain without it, and a lookalike has 0.006 to
//! 0.02.

use super::overlap::{GROUPS, OverlapCell, OverlapGrid};

/// How two registered images of the ground differ: root mean squares of the logarithm of the ratio
/// of their brightness, without gain, black level and the darkening towards the corners of the
/// image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likeness {
    /// Over squares of two spots.
    fine: f64,
    /// Over squares of 16 spots.
    coarse: f64,
}

/// Minimum number of coarse squares in the overlap; a whole view has 300. Fewer judge smaller
/// overlaps, with more scatter of the two measures.
const MIN_SQUARES: usize = 60;

/// Largest ratio of the coarse to the fine difference of two images of one place. White noise has
/// 0.125; of rendered tiles of 20 cm 19 in 20 images have less, and 0.65 to 0.76 at any other
/// period.
const MAX_STRUCTURE: f64 = 0.35;

/// Largest coarse difference: noise does not hide another place. Rendered tiles have 0.0007 to
/// 0.0044, and 0.015 to 0.020 at any other period.
const MAX_DIFFERENCE: f64 = 0.008;

impl Likeness {
    /// Compares the ground that both images show; `None` if that is too little.
    pub fn of(overlap: &OverlapGrid) -> Option<Self> {
        let fitted = overlap.fitted_light()?;
        let known = || overlap.cells.iter().flatten();
        let squares = known().flat_map(|cell| cell.residuals(&fitted)).map(|residual| residual * residual);
        let fine = squares.sum::<f64>() / (GROUPS * known().count()) as f64;
        let mean = |cell: &OverlapCell| cell.residuals(&fitted).iter().sum::<f64>() / GROUPS as f64;
        let columns = overlap.columns;
        let square = |i: usize| {
            let first = 2 * (i / (columns / 2)) * columns + 2 * (i % (columns / 2));
            let at = [first, first + 1, first + columns, first + columns + 1];
            let [Some(a), Some(b), Some(c), Some(d)] = at.map(|at| overlap.cells[at].as_ref().map(mean))
            else {
                return None;
            };
            Some((0.25 * (a + b + c + d)).powi(2))
        };
        let rows = overlap.cells.len() / columns.max(1);
        let squares: Vec<f64> = (0..columns / 2 * (rows / 2)).filter_map(square).collect();
        if squares.len() < MIN_SQUARES {
            return None;
        }
        let coarse = squares.iter().sum::<f64>() / squares.len() as f64;
        Some(Self { fine: fine.sqrt(), coarse: coarse.sqrt() })
    }

    /// Whether the images differ by little more than noise.
    pub fn is_of_one_place(&self) -> bool {
        self.coarse <= MAX_DIFFERENCE && self.coarse <= MAX_STRUCTURE * self.fine
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Distortion};
    use crate::geometry::GroundPose;
    use crate::image::{GrayImage, Pyramid};
    use crate::loop_closure::overlap::RegisteredImage;
    use crate::motion::Random;
    use crate::simulation::{Ground, Renderer, Texture};

    #[test]
    fn a_tile_further_differs_by_more_than_noise() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let renderer = Renderer::new(&camera);
        let ground = Ground::new(Texture::Tiles, renderer.footprint_m(0.9), false, 9).unwrap();
        let mut random = Random::new(4);
        let mut picture = |pose: &GroundPose, gain: f64| {
            let mut image = renderer.gray_view(&ground, pose);
            for sample in image.samples_mut() {
                // The sum of four uniform numbers deviates by 0.577 of their width: 2 gray levels.
                let noise: f64 = (0..4).map(|_| random.below(1 << 16) as f64 / 65536.0 - 0.5).sum();
                *sample = (gain * f64::from(*sample) + 3.5 * noise).round().clamp(0.0, 255.0) as u8;
            }
            Pyramid::new(image, 3)
        };
        for turn in [0.0, 0.8, 2.5] {
            let here = GroundPose { x_m: turn, ..GroundPose::level(0.9) };
            let there = GroundPose { x_m: turn + 0.05, y_m: -0.08, heading_rad: turn, ..here };
            let further = GroundPose { x_m: there.x_m + 0.2, ..there };
            let (query, place) = (picture(&here, 1.0), picture(&there, 0.8));
            let lookalike = picture(&further, 0.9);
            let registered = |pyramid, pose| RegisteredImage { camera: &camera, pyramid, pose, mask: None };
            let compared = |pyramid| OverlapGrid::new(&registered(&query, here), &registered(pyramid, there));
            let [one, other] = [&place, &lookalike].map(|image| Likeness::of(&compared(image)).unwrap());
            assert!(one.is_of_one_place() && !other.is_of_one_place(), "{one:?} {other:?}");
        }
    }

    #[test]
    fn a_black_level_is_no_difference() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let renderer = Renderer::new(&camera);
        let ground = Ground::new(Texture::Bricks, renderer.footprint_m(0.9), false, 9).unwrap();
        let (here, there) = (GroundPose::level(0.9), GroundPose { x_m: 0.1, ..GroundPose::level(0.9) });
        let image = renderer.gray_view(&ground, &here);
        // Limited range, as a video has it.
        let mut limited = renderer.gray_view(&ground, &there);
        limited
            .samples_mut()
            .iter_mut()
            .for_each(|sample| *sample = (16 + u32::from(*sample) * 219 / 255) as u8);
        let [one, other] = [image, limited].map(|image| Pyramid::new(image, 3));
        let registered = |pyramid, pose| RegisteredImage { camera: &camera, pyramid, pose, mask: None };
        let overlap = OverlapGrid::new(&registered(&one, here), &registered(&other, there));
        let likeness = Likeness::of(&overlap).unwrap();
        assert!(likeness.coarse < 0.003, "{likeness:?}");
    }

    #[test]
    fn images_without_common_ground_are_not_compared() {
        let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), Distortion::None).unwrap();
        let pyramid = Pyramid::new(GrayImage::from_samples(320, 240, vec![100; 320 * 240]).unwrap(), 3);
        let at = |x_m: f64| RegisteredImage {
            camera: &camera,
            pyramid: &pyramid,
            pose: GroundPose { x_m, ..GroundPose::level(0.9) },
            mask: None,
        };
        assert!(Likeness::of(&OverlapGrid::new(&at(0.0), &at(2.0))).is_none());
        assert!(Likeness::of(&OverlapGrid::new(&at(0.0), &at(0.0))).is_some());
    }
}
