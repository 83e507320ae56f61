use super::*;

/// White squares on black; the only corners are theirs.
fn squares() -> GrayImage {
    let mut image = GrayImage::new(200, 150);
    for (x0, y0) in [(40, 40), (120, 40), (40, 90), (120, 90)] {
        for y in y0..y0 + 25 {
            for x in x0..x0 + 25 {
                image.samples_mut()[y * 200 + x] = 200;
            }
        }
    }
    image
}

#[test]
fn only_the_corners_of_squares_are_found() {
    for window in [Window::Rectangular, Window::Gaussian] {
        let config = DetectionConfig { window, quality: 0.3, ..Default::default() };
        let corners = detect(&squares(), &config, 10);
        assert_eq!(corners.len(), 16, "{window:?}");
        for corner in corners {
            let near = |v: usize, edges: [usize; 4]| edges.iter().any(|&e| v.abs_diff(e) <= 2);
            assert!(near(corner.x, [40, 64, 120, 144]) && near(corner.y, [40, 64, 90, 114]), "{corner:?}");
        }
    }
}

#[test]
fn strength_is_the_smaller_eigenvalue_of_the_mean_gradient_matrix() {
    let mut state = 7u32;
    let samples = (0..40 * 40)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    let image = GrayImage::from_samples(40, 40, samples).unwrap();
    let config = DetectionConfig::default();
    let mut by_row = Strengths::new((40, 40), &config);
    let strengths: Vec<f32> = (0..40).flat_map(|y| by_row.row(&image, y).to_vec()).collect();
    for (cx, cy) in [(10usize, 12usize), (20, 5), (33, 30)] {
        let mut m = nalgebra::Matrix2::<f64>::zeros();
        for y in cy - 2..=cy + 2 {
            for x in cx - 2..=cx + 2 {
                let v = |x: usize, y: usize| f64::from(image.row(y)[x]);
                let gx = (3.0 * (v(x + 1, y - 1) - v(x - 1, y - 1) + v(x + 1, y + 1) - v(x - 1, y + 1))
                    + 10.0 * (v(x + 1, y) - v(x - 1, y)))
                    / 32.0;
                let gy = (3.0 * (v(x - 1, y + 1) - v(x - 1, y - 1) + v(x + 1, y + 1) - v(x + 1, y - 1))
                    + 10.0 * (v(x, y + 1) - v(x, y - 1)))
                    / 32.0;
                m += nalgebra::Matrix2::new(gx * gx, gx * gy, gx * gy, gy * gy) / 25.0;
            }
        }
        let expected = m.symmetric_eigenvalues().min();
        let found = f64::from(strengths[cy * 40 + cx]);
        assert!((found - expected).abs() < 1e-3 * expected.abs().max(1.0), "{found} {expected}");
    }
}

#[test]
fn corners_keep_their_minimum_distance_and_maximum_count() {
    let mut state = 1u32;
    let samples = (0..320 * 240)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    let image = GrayImage::from_samples(320, 240, samples).unwrap();
    let config = DetectionConfig { corners: 100, ..Default::default() };
    let corners = detect(&image, &config, 10);
    assert_eq!(corners.len(), 100);
    for (i, a) in corners.iter().enumerate() {
        assert!(a.x >= 10 && a.y >= 10 && a.x < 310 && a.y < 230);
        for b in &corners[..i] {
            let d = (a.x as f64 - b.x as f64).hypot(a.y as f64 - b.y as f64);
            assert!(d >= config.minimum_distance_px);
        }
    }
    // Corners are spread: every quarter of the image has at least 15.
    let quarter = |c: &Corner| usize::from(c.x >= 160) + 2 * usize::from(c.y >= 120);
    for q in 0..4 {
        let count = corners.iter().filter(|c| quarter(c) == q).count();
        assert!(count >= 15, "quarter {q} has {count}");
    }
}

#[test]
fn a_blank_image_has_no_corners() {
    assert!(detect(&GrayImage::new(100, 100), &DetectionConfig::default(), 5).is_empty());
    assert!(detect(&GrayImage::new(3, 3), &DetectionConfig::default(), 5).is_empty());
}

/// Uniform noise over all gray levels.
fn noise(seed: u32, size: (usize, usize)) -> GrayImage {
    let mut state = seed;
    let samples = (0..size.0 * size.1)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    GrayImage::from_samples(size.0, size.1, samples).unwrap()
}

#[test]
fn incremental_detection_is_identical_and_its_guaranteed_count_holds() {
    for (image, corners) in [(noise(3, (331, 200)), 400), (noise(4, (331, 200)), 20), (squares(), 400)] {
        let config = DetectionConfig { corners, ..Default::default() };
        let whole = detect(&image, &config, 9);
        for until in [0, 3, 60, 100, 1000] {
            let mut detection = Detection::new((image.width(), image.height()), &config, 9);
            detection.look(&image, until);
            let sure = (0..=corners + 1).take_while(|&count| detection.will_find(count)).count() - 1;
            assert!(sure <= whole.len(), "{sure} of {} after {until} rows", whole.len());
            if until == 100 && image.width() == 331 {
                assert!(sure >= 20, "{sure} after {until} rows");
            }
            assert_eq!(detection.corners(&image), whole, "in two parts, {until} rows first");
        }
    }
}

#[test]
fn no_corner_exceeds_the_upper_bound_of_strength() {
    // A sum of squares of linear functions (convex) attains its maximum at a vertex of the domain:
    // each neighbour is 0 or 255.
    let greatest = (0..256u32).map(|bits| {
        let v = |at: u32| if bits >> at & 1 == 1 { 255.0f32 } else { 0.0 };
        let gx = (3.0 * (v(2) - v(0) + v(7) - v(5)) + 10.0 * (v(4) - v(3))) / 32.0;
        let gy = (3.0 * (v(5) - v(0) + v(7) - v(2)) + 10.0 * (v(6) - v(1))) / 32.0;
        0.5 * (gx * gx + gy * gy)
    });
    let greatest = greatest.fold(0.0, f32::max);
    assert!(greatest <= GREATEST_STRENGTH && greatest > GREATEST_STRENGTH - 1.0, "{greatest}");
}
