//! Defects of images that can be seen in the images themselves.

use super::*;

/// A drive at constant speed over concrete, whose images are spoilt; the largest error from the
/// fifth frame on, millimetres, and what was found.
fn over_concrete(mut spoil: impl FnMut(usize, &mut GrayImage)) -> (f64, crate::image::ImageDefects) {
    let world = World::new("concrete");
    let mut odometry = world.odometry();
    let mut most_mm = 0.0f64;
    for number in 0..40 {
        let pose = at(0.015 * number as f64, 0.0, 0.0);
        let mut image = world.image(pose, number as u64);
        spoil(number, &mut image);
        let frame = odometry.process(image, number as f64 * FRAME_S).unwrap();
        if number >= 5 {
            most_mm = most_mm.max(errors(&frame, &pose).0);
        }
    }
    (most_mm, odometry.image_defects())
}

#[test]
fn rows_of_random_brightness_are_corrected() {
    let (most_mm, found) = over_concrete(|number, image| {
        let mut random = Random::new(1000 + number as u64);
        for row in image.samples_mut().chunks_exact_mut(640) {
            let offset = random.below(41) as i32 - 20;
            row.iter_mut().for_each(|sample| *sample = (i32::from(*sample) + offset).clamp(0, 255) as u8);
        }
    });
    assert!(found.row_noise && !found.impulse_noise && !found.interlaced, "{found:?}");
    assert!(most_mm < 0.5, "{most_mm}");
}

#[test]
fn columns_that_always_differ_are_corrected() {
    let mut random = Random::new(1000);
    let offsets: Vec<i32> = (0..640).map(|_| random.below(41) as i32 - 20).collect();
    let (most_mm, found) = over_concrete(|_, image| {
        for row in image.samples_mut().chunks_exact_mut(640) {
            for (sample, offset) in row.iter_mut().zip(&offsets) {
                *sample = (i32::from(*sample) + offset).clamp(0, 255) as u8;
            }
        }
    });
    assert!(found.column_noise && !found.row_noise && !found.impulse_noise, "{found:?}");
    assert!(most_mm < 0.5, "{most_mm}");
}

#[test]
fn pixels_that_are_black_or_white_are_replaced() {
    let (most_mm, found) = over_concrete(|number, image| {
        let mut random = Random::new(1000 + number as u64);
        for _ in 0..640 * 480 / 50 {
            let at = random.below(640 * 480);
            image.samples_mut()[at] = if random.below(2) == 0 { 0 } else { 255 };
        }
    });
    assert!(found.impulse_noise && !found.row_noise && !found.interlaced, "{found:?}");
    assert!(most_mm < 0.5, "{most_mm}");
}

#[test]
fn a_band_of_the_image_before_does_not_move_the_camera() {
    let mut shown: Option<GrayImage> = None;
    let (most_mm, found) = over_concrete(|number, image| {
        if let Some(shown) = shown.as_ref().filter(|_| number % 4 == 3) {
            let band = 160 * 640..480 * 640;
            image.samples_mut()[band.clone()].copy_from_slice(&shown.samples()[band]);
        }
        shown = Some(image.clone());
    });
    assert_eq!(found, Default::default());
    // The camera moves by 15 mm from one image to the next.
    assert!(most_mm < 0.5, "{most_mm}");
}

#[test]
fn clean_images_have_no_defects() {
    for texture in ["asphalt", "tiles", "bricks", "grass", "carpet", "bare"] {
        let world = World::new(texture);
        let mut odometry = world.odometry();
        let poses: Vec<_> = (0..5).map(|number| at(0.015 * f64::from(number), 0.0, 0.0)).collect();
        world.run(&mut odometry, &poses);
        assert_eq!(odometry.image_defects(), Default::default(), "{texture}");
    }
}
