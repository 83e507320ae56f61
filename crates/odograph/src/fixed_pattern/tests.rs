use super::*;
use crate::camera::{Camera, Distortion};
use crate::geometry::GroundPose;
use crate::motion::Random;
use crate::simulation::{Renderer, shared_ground};

const HEIGHT_M: f64 = 0.75;

/// Rendered 320x240 images of a ground at the given (x, heading) poses, with one gray level of
/// noise.
fn images(texture: &str, poses: impl Iterator<Item = (f64, f64)>) -> Vec<GrayImage> {
    let lens = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap();
    let camera = Camera::new((320, 240), (250.0, 250.0), (160.5, 119.0), lens).unwrap();
    let renderer = Renderer::new(&camera);
    let footprint_m = renderer.footprint_m(HEIGHT_M);
    let ground = shared_ground(texture, footprint_m, 3);
    let mut random = Random::new(5);
    let image = |(x_m, heading_rad): (f64, f64)| {
        let mut image =
            renderer.gray_view(&ground, &GroundPose { x_m, heading_rad, ..GroundPose::level(HEIGHT_M) });
        for sample in image.samples_mut() {
            let noise: i32 = (0..3).map(|_| random.below(3) as i32 - 1).sum();
            *sample = (i32::from(*sample) + noise).clamp(0, 255) as u8;
        }
        image
    };
    poses.map(image).collect()
}

/// Overlays the lowest quarter of an image with random blocks of 7 pixels.
fn with_bumper(mut image: GrayImage) -> GrayImage {
    let (width, height) = (image.width(), image.height());
    for (at, sample) in image.samples_mut().iter_mut().enumerate().skip(width * height / 4 * 3) {
        let block = at % width / 7 + 57 * (at / width / 7);
        *sample = 30 + (Random::new(block as u64).below(180)) as u8;
    }
    image
}

fn drive(frames: usize) -> impl Iterator<Item = (f64, f64)> {
    (0..frames).map(|i| (0.017 * i as f64, 0.0))
}

fn learned(images: Vec<GrayImage>) -> FixedPattern {
    let mut fixed = FixedPattern::new((320, 240));
    images.iter().for_each(|image| {
        fixed.look(image);
    });
    fixed
}

#[test]
fn moving_ground_is_not_masked() {
    for texture in ["asphalt", "carpet", "concrete", "grass", "tiles", "bricks"] {
        assert_eq!(learned(images(texture, drive(60))).share(), 0.0, "{texture} straight on");
        let turning = (0..60).map(|i| (0.01 * f64::from(i), 0.02 * f64::from(i)));
        assert_eq!(learned(images(texture, turning)).share(), 0.0, "{texture} turning");
    }
}

#[test]
fn a_stationary_camera_masks_nothing() {
    let still = images("concrete", std::iter::repeat_n((0.0, 0.0), 40));
    let fixed = learned(still.into_iter().map(with_bumper).collect());
    assert_eq!(fixed.share(), 0.0);
}

#[test]
fn noise_that_grows_is_no_motion() {
    let moving = drive(16).chain(std::iter::repeat_n((0.255, 0.0), 26));
    let mut fixed = FixedPattern::new((320, 240));
    let mut random = Random::new(9);
    for (frame, mut image) in images("tiles", moving).into_iter().enumerate() {
        if frame >= 16 {
            for sample in image.samples_mut() {
                let noise: i32 = (0..12).map(|_| random.below(5) as i32 - 2).sum();
                *sample = (i32::from(*sample) + noise).clamp(0, 255) as u8;
            }
        }
        let since_last = fixed.look(&image);
        assert!(frame <= 24 || since_last == SinceLast::Unclear, "frame {frame}");
    }
}

#[test]
fn a_bumper_is_masked_within_ten_frames_and_little_else() {
    for texture in ["concrete", "asphalt", "tiles"] {
        let driving: Vec<GrayImage> = images(texture, drive(10)).into_iter().map(with_bumper).collect();
        let fixed = learned(driving);
        let mask = fixed.mask().expect("found");
        let covered = |rows: std::ops::Range<usize>| {
            let pixels = rows.clone().flat_map(|y| (0..320).map(move |x| (x, y)));
            pixels.filter(|&(x, y)| mask.covers(x, y)).count() as f64 / (320 * rows.len()) as f64
        };
        assert!(covered(180..240) > 0.95, "{texture}: {}", covered(180..240));
        // A joint that continues from the bumper is masked for some pixels.
        assert!(covered(0..160) < 0.04, "{texture}: {}", covered(0..160));
    }
}

/// Overlays the lowest quarter of an image, and a part that protrudes from it, with diagonal
/// stripes.
fn with_stripes(mut image: GrayImage) -> GrayImage {
    for (at, sample) in image.samples_mut().iter_mut().enumerate() {
        let (x, y) = (at % 320, at / 320);
        if y >= if (80..120).contains(&x) { 165 } else { 180 } {
            *sample = if (x + y) / 12 % 2 == 0 { 40 } else { 190 };
        }
    }
    image
}

#[test]
fn a_striped_bumper_is_masked_as_a_whole() {
    for texture in ["concrete", "asphalt", "carpet", "grass"] {
        let driving: Vec<GrayImage> = images(texture, drive(16)).into_iter().map(with_stripes).collect();
        let fixed = learned(driving);
        let mask = fixed.mask().expect("found");
        let pixels = || (0..320 * 240).map(|at| (at % 320, at / 320));
        let left = pixels().filter(|&(x, y)| y >= 190 && !mask.covers(x, y)).count();
        assert_eq!(left, 0, "{texture}");
        let ground = pixels().filter(|&(x, y)| y < 140 && mask.covers(x, y)).count();
        assert_eq!(ground, 0, "{texture}");
    }
}

#[test]
fn a_given_mask_is_dilated_by_the_patch_radius() {
    let mut picture = GrayImage::new(320, 240);
    picture.samples_mut().fill(255);
    picture.samples_mut()[100 * 320..110 * 320].fill(0);
    let given = ImageMask::from_picture(&picture);
    let fixed = FixedPattern::new((320, 240)).with_given(given);
    let mask = fixed.mask().expect("given");
    assert!(mask.covers(5, 105) && mask.covers(300, 90) && mask.covers(300, 119));
    assert!(!mask.covers(5, 80) && !mask.covers(5, 130));
    assert_eq!(fixed.picture().row(105)[7], 0);
}

#[test]
fn a_known_mask_applies_until_the_own_one_is_sure() {
    let with_bumper_driving: Vec<GrayImage> =
        images("concrete", drive(30)).into_iter().map(with_bumper).collect();
    let found = learned(with_bumper_driving.clone());
    let mask = found.settled_mask().expect("a quarter of the image").clone();
    let mut again = FixedPattern::new((320, 240)).with_known(&mask);
    for (number, image) in with_bumper_driving.iter().enumerate() {
        assert!(again.share() > 0.2, "image {number}");
        again.look(image);
    }
    // Where nothing is fixed it is forgotten.
    let mut without = FixedPattern::new((320, 240)).with_known(&mask);
    images("concrete", drive(300)).iter().for_each(|image| {
        without.look(image);
    });
    assert_eq!(without.share(), 0.0);
}
