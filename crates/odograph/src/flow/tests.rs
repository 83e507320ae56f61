use super::*;
use crate::image::{GrayImage, Pyramid};
use proptest::prelude::*;

/// Value noise in four octaves: smooth, known everywhere and without repetition. Its renderings are
/// exact up to rounding to gray levels.
fn pattern(x: f64, y: f64) -> f64 {
    let lattice = |i: i64, j: i64, octave: u64| {
        let mut h = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ (j as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
            ^ octave;
        h = (h ^ (h >> 31)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        h = (h ^ (h >> 29)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((h >> 40) as f64 / (1u64 << 24) as f64) - 0.5
    };
    // Quintic blending: twice differentiable.
    let blend = |t: f64| t * t * t * (t * (6.0 * t - 15.0) + 10.0);
    [(5.0, 70.0), (11.0, 70.0), (23.0, 60.0), (51.0, 60.0)]
        .iter()
        .enumerate()
        .map(|(octave, &(wavelength, amplitude))| {
            let (u, v) = (x / wavelength, y / wavelength);
            let (i, j) = (u.floor() as i64, v.floor() as i64);
            let (s, t) = (blend(u - u.floor()), blend(v - v.floor()));
            let at = |di: i64, dj: i64| lattice(i + di, j + dj, octave as u64);
            let upper = at(0, 0) + s * (at(1, 0) - at(0, 0));
            let lower = at(0, 1) + s * (at(1, 1) - at(0, 1));
            amplitude * (upper + t * (lower - upper))
        })
        .sum::<f64>()
        + 128.0
}

/// Renders the pattern so that keyframe point `centre + d` is at `warp(d)`, with gain and offset.
fn rendered(centre: Pixel, warp: &Warp, gain: f64, offset: f64) -> GrayImage {
    let inverse = warp.linear.try_inverse().unwrap();
    let mut image = GrayImage::new(200, 200);
    for y in 0..200 {
        for x in 0..200 {
            let d = inverse * Vector2::new(x as f64 - warp.position.x, y as f64 - warp.position.y);
            let v = gain * (pattern(centre.x + d.x, centre.y + d.y) - 128.0) + 128.0 + offset;
            image.samples_mut()[y * 200 + x] = v.round().clamp(0.0, 255.0) as u8;
        }
    }
    image
}

fn keyframe() -> (Pyramid, Template) {
    let identity = Warp::translation(Pixel::new(0.0, 0.0));
    let pyramid = Pyramid::new(rendered(Pixel::new(0.0, 0.0), &identity, 1.0, 0.0), 4);
    let template = Template::new(&pyramid, (100, 95)).unwrap();
    (pyramid, template)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_translated_and_rotated_patch_is_tracked(
        dx in -6.0..6.0f64, dy in -6.0..6.0f64, angle in -3.0..3.0f64, gain in 0.8..1.2f64, offset in -15.0..15.0f64,
    ) {
        let (_, template) = keyframe();
        let centre = template.centre();
        let linear = Matrix2::new(angle.cos(), -angle.sin(), angle.sin(), angle.cos());
        let truth = Warp { position: Pixel::new(centre.x + dx, centre.y + dy), linear };
        let image = Pyramid::new(rendered(centre, &truth, gain, offset), 4);
        let prediction = Warp { position: centre, linear };
        let found = track(&template, &image, &prediction, f64::INFINITY, &FlowConfig::default()).expect("found");
        // Rounding to gray levels allows about 0.29 / (gradient · √256) px; bilinear interpolation
        // of this pattern a little more.
        prop_assert!(found.position.distance(truth.position) < 0.03, "{found:?} {truth:?}");
        prop_assert!(found.dissimilarity < 0.1);
    }

    #[test]
    fn an_affine_deformation_is_registered(xx in -0.1..0.1f64, xy in -0.1..0.1f64, yx in -0.1..0.1f64, yy in -0.1..0.1f64) {
        let (_, template) = keyframe();
        let centre = template.centre();
        let truth = Warp { position: Pixel::new(centre.x + 0.4, centre.y - 0.3), linear: Matrix2::new(1.0 + xx, xy, yx, 1.0 + yy) };
        let image = Pyramid::new(rendered(centre, &truth, 1.1, 3.0), 1);
        let (warp, found) = dissimilarity(&template, &image, &Warp::translation(centre)).expect("found");
        prop_assert!(found.position.distance(truth.position) < 0.05);
        prop_assert!((warp.linear - truth.linear).norm() < 0.02, "{} {}", warp.linear, truth.linear);
        prop_assert!(found.dissimilarity < 0.1);
    }
}

#[test]
fn another_surface_is_dissimilar() {
    let (_, template) = keyframe();
    let mut state = 5u32;
    let noise = (0..200 * 200)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    let image = Pyramid::new(GrayImage::from_samples(200, 200, noise).unwrap(), 4);
    let prediction = Warp::translation(template.centre());
    let found = track(&template, &image, &prediction, f64::INFINITY, &FlowConfig::default());
    assert!(found.is_err() || found.is_ok_and(|found| found.dissimilarity > 0.8));
    let judged = dissimilarity(&template, &image, &prediction);
    assert!(judged.is_none_or(|(_, found)| found.dissimilarity > 0.8));
}

#[test]
fn a_patch_outside_the_image_fails_as_outside() {
    let (pyramid, template) = keyframe();
    let gone = Warp::translation(Pixel::new(-20.0, 50.0));
    assert_eq!(
        track(&template, &pyramid, &gone, f64::INFINITY, &FlowConfig::default()),
        Err(TrackFailure::Outside)
    );
}

#[test]
fn a_blank_patch_makes_no_template() {
    let blank = Pyramid::new(GrayImage::new(100, 100), 3);
    assert!(Template::new(&blank, (50, 50)).is_none());
    let (pyramid, _) = keyframe();
    assert!(Template::new(&pyramid, (3, 50)).is_none());
}

#[test]
fn the_forward_backward_error_is_that_of_the_match() {
    let (keyframe, template) = keyframe();
    let centre = template.centre();
    let moved = Warp::translation(Pixel::new(centre.x + 7.3, centre.y - 4.6));
    let image = Pyramid::new(rendered(centre, &moved, 1.0, 0.0), 4);
    let config = FlowConfig::default();
    let right = forward_backward_px(&template, &keyframe, &image, &moved, &config).expect("comes back");
    assert!(right < 0.05, "{right}");
    let wrong = Warp::translation(Pixel::new(moved.position.x + 2.0, moved.position.y));
    let off = forward_backward_px(&template, &keyframe, &image, &wrong, &config).expect("comes back");
    assert!((off - 2.0).abs() < 0.3, "{off}");
}
