use super::*;
use proptest::prelude::*;

const SIZE: (usize, usize) = (64, 48);

/// Undistorted, barrel, pincushion, tangential, rational and fisheye lenses with off-centre
/// principal points.
fn cameras() -> Vec<Camera> {
    let make = |focal, principal, distortion| Camera::new(SIZE, focal, principal, distortion).unwrap();
    let opencv = |coefficients: &[f64]| Distortion::from_opencv(coefficients).unwrap();
    vec![
        make((50.0, 50.5), (32.5, 23.8), Distortion::None),
        make((50.0, 50.5), (32.5, 23.8), opencv(&[-0.28, 0.07, 0.0002, -0.0003])),
        make((50.0, 50.0), (29.0, 26.0), opencv(&[0.2, 0.05, 0.001, 0.002])),
        make((53.3, 53.2), (34.2, 23.4), opencv(&[-0.3, 0.15, -0.0008, 0.0003, -0.066])),
        make((40.0, 41.0), (31.5, 23.5), opencv(&[0.4, 0.1, 0.0, 0.0, 0.01, 0.7, 0.2, 0.02])),
        make(
            (30.0, 30.1),
            (31.0, 24.0),
            Distortion::KannalaBrandt { k1: -0.01, k2: 0.003, k3: -0.002, k4: 0.0003 },
        ),
    ]
}

fn every_way() -> [FieldOfViewKept; 3] {
    [FieldOfViewKept::SameFocalLength, FieldOfViewKept::ValidPixels, FieldOfViewKept::AllPixels]
}

/// Reference: pixel → ray → distorted pixel → bilinear interpolation with replicated border.
fn by_definition(camera: &Camera, corrected: &Camera, image: &GrayImage, x: usize, y: usize) -> Option<f64> {
    let ray = corrected.ray_from_pixel(Pixel::new(x as f64, y as f64))?;
    let place = camera.pixel_from_ray(ray)?;
    let (w, h) = (image.width() as f64, image.height() as f64);
    if !(-0.5..=w - 0.5).contains(&place.x) || !(-0.5..=h - 0.5).contains(&place.y) {
        return None;
    }
    let sample =
        |x: f64, y: f64| f64::from(image.row(y.clamp(0.0, h - 1.0) as usize)[x.clamp(0.0, w - 1.0) as usize]);
    let (left, top) = (place.x.floor(), place.y.floor());
    let (u, v) = (place.x - left, place.y - top);
    let upper = sample(left, top) * (1.0 - u) + sample(left + 1.0, top) * u;
    let lower = sample(left, top + 1.0) * (1.0 - u) + sample(left + 1.0, top + 1.0) * u;
    Some(upper * (1.0 - v) + lower * v)
}

/// Position in the rectified image of a source pixel.
fn corrected_pixel(source: &Camera, correction: &ImageCorrection, pixel: Pixel) -> Pixel {
    let (ray, pinhole) = (source.ray_from_pixel(pixel).unwrap(), correction.camera());
    let ((fx, fy), (cx, cy)) = (pinhole.focal_px(), pinhole.principal_px());
    Pixel::new(fx * ray.x + cx, fy * ray.y + cy)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]
    #[test]
    fn an_image_is_corrected_as_defined(samples in prop::collection::vec(any::<u8>(), SIZE.0 * SIZE.1)) {
        let image = GrayImage::from_samples(SIZE.0, SIZE.1, samples).unwrap();
        for camera in cameras() {
            for kept in every_way() {
                let correction = ImageCorrection::new(&camera, kept).unwrap();
                let corrected = correction.apply(&image).unwrap();
                let mut without_source = 0;
                for y in 0..SIZE.1 {
                    for x in 0..SIZE.0 {
                        let got = f64::from(corrected.row(y)[x]);
                        match by_definition(&camera, correction.camera(), &image, x, y) {
                            // Half a level of rounding, plus the quantisation of two fractions to
                            // 1/2048 pixel: 2 · 255 / 4096.
                            Some(wanted) => prop_assert!((got - wanted).abs() < 0.63, "{x} {y} {got} {wanted}"),
                            None => {
                                prop_assert_eq!(got, 0.0);
                                without_source += 1;
                            }
                        }
                    }
                }
                prop_assert_eq!(without_source, correction.pixels_without_source());
            }
        }
    }

    #[test]
    fn colours_are_corrected_alike(samples in prop::collection::vec(any::<u8>(), 3 * SIZE.0 * SIZE.1)) {
        let image = RgbImage::from_samples(SIZE.0, SIZE.1, samples).unwrap();
        let correction = ImageCorrection::new(&cameras()[1], FieldOfViewKept::AllPixels).unwrap();
        let corrected = correction.apply_rgb(&image).unwrap();
        for channel in 0..3 {
            let alone = image.samples().iter().skip(channel).step_by(3).copied().collect();
            let alone = correction.apply(&GrayImage::from_samples(SIZE.0, SIZE.1, alone).unwrap()).unwrap();
            let among = corrected.samples().iter().skip(channel).step_by(3);
            prop_assert!(alone.samples().iter().eq(among));
        }
    }

    #[test]
    fn points_come_back(x in 0.0..63.0, y in 0.0..47.0) {
        let pixel = Pixel::new(x, y);
        for camera in cameras() {
            for kept in every_way() {
                let correction = ImageCorrection::new(&camera, kept).unwrap();
                let there = corrected_pixel(&camera, &correction, pixel);
                prop_assert!(correction.source_pixel(there).unwrap().distance(pixel) < 1e-6);
            }
        }
    }
}

#[test]
fn rectifying_a_pinhole_image_changes_nothing() {
    let samples = (0..SIZE.0 * SIZE.1).map(|i| (i * 7919 % 251) as u8).collect();
    let image = GrayImage::from_samples(SIZE.0, SIZE.1, samples).unwrap();
    for kept in every_way() {
        let correction = ImageCorrection::new(&cameras()[0], kept).unwrap();
        assert_eq!(correction.pixels_without_source(), 0);
        assert_eq!(correction.apply(&image).unwrap(), image);
    }
}

#[test]
fn valid_view_has_no_empty_pixels_and_is_maximal() {
    for camera in cameras() {
        let correction = ImageCorrection::new(&camera, FieldOfViewKept::ValidPixels).unwrap();
        assert_eq!(correction.pixels_without_source(), 0, "{camera:?}");
        let pinhole = correction.camera();
        let ratio = |camera: &Camera| camera.focal_px().0 / camera.focal_px().1;
        assert!((ratio(pinhole) - ratio(&camera)).abs() < 1e-12);
        // The same view enlarged by 5 % contains directions outside the camera's view.
        let middle = (31.5, 23.5);
        let principal = pinhole.principal_px();
        let focal = (pinhole.focal_px().0 / 1.05, pinhole.focal_px().1 / 1.05);
        let wider_principal =
            (middle.0 + (principal.0 - middle.0) / 1.05, middle.1 + (principal.1 - middle.1) / 1.05);
        let wider = Camera::new(SIZE, focal, wider_principal, Distortion::None).unwrap();
        assert!(edge_pixels(&wider).any(|p| source_pixel(&camera, &wider, p).is_none()), "{camera:?}");
    }
}

#[test]
fn whole_view_contains_all_source_pixels_and_touches_the_border() {
    for camera in cameras() {
        let correction = ImageCorrection::new(&camera, FieldOfViewKept::AllPixels).unwrap();
        let (mut left, mut right, mut top, mut bottom) = (f64::MAX, f64::MIN, f64::MAX, f64::MIN);
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let at = corrected_pixel(&camera, &correction, Pixel::new(x as f64, y as f64));
                (left, right) = (left.min(at.x), right.max(at.x));
                (top, bottom) = (top.min(at.y), bottom.max(at.y));
            }
        }
        let inside = left > -1e-6 && top > -1e-6 && right < 63.0 + 1e-6 && bottom < 47.0 + 1e-6;
        let touching = left < 1e-6 || top < 1e-6;
        assert!(inside && touching, "{camera:?}: {left} {right} {top} {bottom}");
    }
}

#[test]
fn a_lens_that_folds_inside_the_image_keeps_valid_pixels() {
    // 1 − 1.5 r² = 0 at r = 0.82: distortion is not monotonic beyond, and the image corners lie
    // there.
    let lens = Distortion::from_opencv(&[-0.5, 0.0, 0.0, 0.0]).unwrap();
    let camera = Camera::new(SIZE, (50.0, 50.0), (31.5, 23.5), lens).unwrap();
    assert!(camera.ray_from_pixel(Pixel::new(0.0, 0.0)).is_none());
    let error = ImageCorrection::new(&camera, FieldOfViewKept::AllPixels).unwrap_err();
    assert!(error.to_string().contains("does not reach the edge"), "{error}");
    let valid = ImageCorrection::new(&camera, FieldOfViewKept::ValidPixels).unwrap();
    assert_eq!(valid.pixels_without_source(), 0);
    let same = ImageCorrection::new(&camera, FieldOfViewKept::SameFocalLength).unwrap();
    assert!(same.apply(&GrayImage::new(SIZE.0, SIZE.1)).is_ok());
}

#[test]
fn thin_images_are_corrected_too() {
    for (width, height) in [(1, 1), (1, 5), (5, 1), (2, 2)] {
        let lens = Distortion::from_opencv(&[-0.1, 0.0, 0.0, 0.0]).unwrap();
        let middle = ((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
        let camera = Camera::new((width, height), (9.0, 9.0), middle, lens).unwrap();
        let image = GrayImage::from_samples(width, height, vec![77; width * height]).unwrap();
        for kept in every_way() {
            let corrected = ImageCorrection::new(&camera, kept).unwrap().apply(&image).unwrap();
            assert!(corrected.samples().iter().all(|&s| s == 77), "{width}x{height} {kept:?}");
        }
    }
}

#[test]
fn images_of_another_size_are_rejected() {
    let correction = ImageCorrection::new(&cameras()[1], FieldOfViewKept::SameFocalLength).unwrap();
    let error = correction.apply(&GrayImage::new(10, 10)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "an image of 10x10 pixels cannot be corrected by a camera calibrated for 64x48"
    );
}

#[test]
fn a_global_shutter_stays_one_and_a_rolling_one_becomes_unknown() {
    for camera in cameras() {
        for (given, kept_s) in [(Some(0.0), Some(0.0)), (Some(0.02), None), (None, None)] {
            let camera = camera.clone().with_readout_s(given).unwrap();
            for way in every_way() {
                let corrected = ImageCorrection::new(&camera, way).unwrap();
                assert_eq!(corrected.camera().readout_s(), kept_s, "{given:?} {way:?}");
            }
        }
    }
}
