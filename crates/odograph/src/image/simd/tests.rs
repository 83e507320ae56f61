//! The kernels are bit-identical to their scalar references. Without AVX2 and NEON these tests
//! compare the references with themselves.

use super::*;
use proptest::prelude::*;

fn random(seed: u32) -> impl Iterator<Item = u8> {
    let mut state = seed;
    std::iter::repeat_with(move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    })
}

fn random_image(width: usize, height: usize, seed: u32) -> GrayImage {
    GrayImage::from_samples(width, height, random(seed).take(width * height).collect()).unwrap()
}

fn random_patch(seed: u32) -> Patch {
    let mut values = random(seed);
    [(); 256].map(|()| f32::from(values.next().unwrap_or(0)) * 0.37 - 40.0)
}

fn appearance(seed: u32) -> TemplateSamples {
    TemplateSamples {
        contrast: random_patch(seed ^ 1),
        gradient_x: random_patch(seed ^ 2),
        gradient_y: random_patch(seed ^ 3),
    }
}

fn orthogonal() -> Orthogonal {
    let plane = |mean, x, y| Plane { mean, slope: [x, y] };
    let planes = [plane(97.3, 0.4, -1.2), plane(0.7, 0.02, 0.1), plane(-1.3, -0.07, 0.03)];
    Orthogonal { planes, shares: [0.02, -0.01] }
}

/// A grid of any orientation inside the image; moved to the nearest border where `touching`.
fn grid(width: usize, height: usize, linear: [f64; 4], place: [f64; 2], touching: bool) -> Option<Grid> {
    let [xx, xy, yx, yy] = linear;
    let reach = [7.5 * (xx.abs() + xy.abs()), 7.5 * (yx.abs() + yy.abs())];
    let mut first = [0.0; 2];
    for (axis, size) in [width, height].into_iter().enumerate() {
        let room = size as f64 - 1.0 - 2.0 * reach[axis];
        if room <= 0.01 {
            return None;
        }
        // The largest value below `room` keeps the last sample inside.
        let part = if touching { place[axis].round() * 0.999_999 } else { place[axis] };
        first[axis] = reach[axis] + part * room;
    }
    Some(Grid {
        first: [first[0] - 7.5 * (xx + xy), first[1] - 7.5 * (yx + yy)],
        along_row: [xx, yx],
        along_column: [xy, yy],
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn patches_are_sampled_as_the_reference_samples_them(
        width in 17usize..70, height in 17usize..70, seed in any::<u32>(),
        linear in prop::array::uniform4(-1.5..1.5f64), place in prop::array::uniform2(0.0..1.0f64), touching in any::<bool>(),
    ) {
        let Some(grid) = grid(width, height, linear, place, touching) else { return Ok(()) };
        let image = random_image(width, height, seed);
        let appearance = appearance(seed);
        let (mut expected, mut found, mut sampled) = ([0.0; 256], [0.0; 256], [0.0; 256]);
        let products = scalar::sample_and_multiply(&image, &grid, &appearance, &mut expected);
        prop_assert_eq!(sample_and_multiply(&image, &grid, &appearance, &mut found), products);
        sample_patch(&image, &grid, &mut sampled);
        prop_assert_eq!(found, expected);
        prop_assert_eq!(sampled, expected);
        // The AVX2 kernel, also where `sample_patch` chose a wider one.
        #[cfg(target_arch = "x86_64")]
        if samples_wide(&image) {
            // SAFETY: the processor has AVX2.
            prop_assert_eq!(unsafe { avx2::sample_and_multiply(&image, &grid, &appearance, &mut found) }, products);
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn slightly_rotated_patches_are_sampled_as_by_the_reference(
        width in 40usize..90, height in 40usize..90, seed in any::<u32>(), along in prop::array::uniform2(0.7..1.4f64),
        across in prop::array::uniform2(-0.3..0.3f64), turned in any::<bool>(), place in prop::array::uniform2(0.0..1.0f64),
        touching in any::<bool>(),
    ) {
        let sign = if turned { -1.0 } else { 1.0 };
        let linear = [sign * along[0], across[0], across[1], sign * along[1]];
        let Some(grid) = grid(width, height, linear, place, touching) else { return Ok(()) };
        let image = random_image(width, height, seed);
        let appearance = appearance(seed);
        let (mut expected, mut found, mut sampled) = ([0.0; 256], [0.0; 256], [0.0; 256]);
        let products = scalar::sample_and_multiply(&image, &grid, &appearance, &mut expected);
        prop_assert_eq!(sample_and_multiply(&image, &grid, &appearance, &mut found), products);
        sample_patch(&image, &grid, &mut sampled);
        prop_assert_eq!(found, expected);
        prop_assert_eq!(sampled, expected);
        #[cfg(target_arch = "x86_64")]
        if samples_wide(&image) {
            // SAFETY: the processor has AVX2.
            unsafe { avx2::sample_patch(&image, &grid, &mut sampled) };
            prop_assert_eq!(sampled, expected);
        }
    }

    #[test]
    fn patches_that_are_only_moved_are_sampled_as_any_others(
        width in 17usize..70, height in 17usize..70, seed in any::<u32>(), place in prop::array::uniform2(0.0..1.0f64),
        touching in any::<bool>(),
    ) {
        let Some(grid) = grid(width, height, [1.0, 0.0, 0.0, 1.0], place, touching) else { return Ok(()) };
        let image = random_image(width, height, seed);
        let appearance = appearance(seed);
        let (mut general, mut found, mut sampled) = ([0.0; 256], [0.0; 256], [0.0; 256]);
        scalar::sample_patch(&image, &grid, &mut general);
        let products = sample_and_multiply(&image, &grid, &appearance, &mut found);
        sample_patch(&image, &grid, &mut sampled);
        prop_assert_eq!(found, sampled);
        // Positions are rounded once instead of one by one: an error of 70 · 2⁻¹⁸ pixels, times 255
        // gray levels.
        prop_assert!(general.iter().zip(found).all(|(a, b)| (a - b).abs() < 0.01));
        let shift = Shift::of(&image, &grid).unwrap();
        let expected = scalar::multiply_shifted(&image, &shift, &appearance, &mut sampled);
        prop_assert_eq!((products, found), (expected, sampled));
        // The kernel that runs where `sample_and_multiply` chose a wider one.
        prop_assert_eq!(multiply_shifted(&image, &shift, &appearance, &mut found), products);
        prop_assert_eq!(found, sampled);
    }

    #[test]
    fn sums_over_patches_are_those_of_the_reference(seed in any::<u32>()) {
        let (a, b) = (random_patch(seed), random_patch(seed ^ 1));
        prop_assert_eq!(dot(&a, &b), scalar::dot(&a, &b));
        prop_assert_eq!(plane_and_energy(&a), scalar::plane_and_energy(&a));
        let less = orthogonal();
        prop_assert_eq!(moments(&appearance(seed), &less), scalar::moments(&appearance(seed), &less));
    }

    #[test]
    fn squared_differences_are_the_references(width in 0usize..9000, seed in any::<u32>()) {
        let [a, b] = [0, 1].map(|i| random(seed ^ i).take(width).collect::<Vec<u8>>());
        prop_assert_eq!(squared_differences(&a, &b), scalar::squared_differences(&a, &b));
        let exact: i64 = a.iter().zip(&b).map(|(&a, &b)| (i64::from(a) - i64::from(b)).pow(2)).sum();
        prop_assert_eq!(squared_differences(&a, &b), exact as u64);
    }

    #[test]
    fn rows_are_blurred_as_the_reference_blurs_them(half in 1usize..80, spare in 0usize..3, seed in any::<u32>()) {
        let width = 2 * half + 3 + spare;
        let rows: Vec<Vec<u8>> = (0..5).map(|i| random(seed ^ i).take(width).collect()).collect();
        let (mut found, mut expected) = (vec![0; width], vec![0; width]);
        blur_rows(&rows[0], &rows[1], &rows[2], &rows[3], &rows[4], &mut found);
        scalar::blur_rows(&rows[0], &rows[1], &rows[2], &rows[3], &rows[4], &mut expected);
        prop_assert_eq!(&found, &expected);
        let (mut halved, mut expected) = (vec![0; half], vec![0; half]);
        blur_and_halve(&found, &mut halved);
        scalar::blur_and_halve(&found, &mut expected);
        prop_assert_eq!(halved, expected);
    }

    #[test]
    fn corner_strengths_are_those_of_the_reference(width in 7usize..90, radius in 1usize..3, seed in any::<u32>()) {
        let rows: Vec<Vec<u8>> = (0..3).map(|i| random(seed ^ i).take(width).collect()).collect();
        let (mut x, mut y) = (vec![3i16; width], vec![-4i16; width]);
        let (old_x, old_y) = (y.clone(), x.clone());
        let (mut expected_x, mut expected_y) = (x.clone(), y.clone());
        scharr_gradients(&rows[0], &rows[1], &rows[2], &mut x, &mut y);
        scalar::scharr_gradients(&rows[0], &rows[1], &rows[2], &mut expected_x, &mut expected_y);
        prop_assert_eq!((&x, &y), (&expected_x, &expected_y));
        let mut found: Vec<Vec<i32>> = (0..3).map(|i| vec![40 + i; width]).collect();
        let mut expected = found.clone();
        if let [xx, xy, yy] = found.as_mut_slice() {
            roll_products(&x, &y, &old_x, &old_y, xx, xy, yy);
        }
        if let [xx, xy, yy] = expected.as_mut_slice() {
            scalar::roll_products(&x, &y, &old_x, &old_y, xx, xy, yy);
        }
        prop_assert_eq!(&found, &expected);
        let window = 2 * radius + 1;
        let (mut strengths, mut expected) = (vec![0.0; width - 2 * radius], vec![0.0; width - 2 * radius]);
        smaller_eigenvalues_of_sums(&found[0], &found[1], &found[2], window, 0.01, &mut strengths);
        scalar::smaller_eigenvalues_of_sums(&found[0], &found[1], &found[2], window, 0.01, &mut expected);
        prop_assert_eq!(&strengths, &expected);
        let mut columns: Vec<Vec<f32>> = (0..3).map(|_| vec![0.5; width]).collect();
        let mut expected = columns.clone();
        if let [xx, xy, yy] = columns.as_mut_slice() {
            add_weighted_products(&x, &y, 0.01, xx, xy, yy);
        }
        if let [xx, xy, yy] = expected.as_mut_slice() {
            scalar::add_weighted_products(&x, &y, 0.01, xx, xy, yy);
        }
        prop_assert_eq!(&columns, &expected);
        let weights = vec![0.2; 2 * radius + 1];
        let (mut strengths, mut expected) = (vec![0.0; width - 2 * radius], vec![0.0; width - 2 * radius]);
        smaller_eigenvalues(&columns[0], &columns[1], &columns[2], &weights, &mut strengths);
        scalar::smaller_eigenvalues(&columns[0], &columns[1], &columns[2], &weights, &mut expected);
        prop_assert_eq!(&strengths, &expected);
        let (mut marks, mut expected) = (vec![9; strengths.len()], vec![9; strengths.len()]);
        let shifted: Vec<f32> = strengths.iter().rev().copied().collect();
        mark_local_maxima(&shifted, &strengths, &shifted, 0.02, &mut marks);
        scalar::mark_local_maxima(&shifted, &strengths, &shifted, 0.02, &mut expected);
        prop_assert_eq!(marks, expected);
    }

    #[test]
    fn appearances_are_those_of_the_reference(left in 1usize..10, top in 1usize..10, seed in any::<u32>()) {
        let image = random_image(28, 28, seed);
        prop_assert_eq!(patch_sums(&image, left, top), scalar::patch_sums(&image, left, top));
        prop_assert_eq!(weighted_sums(&image, left, top), scalar::weighted_sums(&image, left, top));
        let less = orthogonal();
        let (mut found, mut expected) = (TemplateSamples::ZERO, TemplateSamples::ZERO);
        write_appearance(&image, left, top, &less, &mut found);
        scalar::write_appearance(&image, left, top, &less, &mut expected);
        prop_assert_eq!(found.contrast, expected.contrast);
        prop_assert_eq!(found.gradient_x, expected.gradient_x);
        prop_assert_eq!(found.gradient_y, expected.gradient_y);
    }
}

#[test]
fn sums_over_black_and_white_match_the_reference() {
    for period in [1, 2, 3, 300] {
        let white = |i: usize| if (i % 30 / period).is_multiple_of(2) { 255 } else { 0 };
        let image = GrayImage::from_samples(30, 30, (0..900).map(white).collect()).unwrap();
        assert_eq!(patch_sums(&image, 5, 6), scalar::patch_sums(&image, 5, 6));
        assert_eq!(weighted_sums(&image, 5, 6), scalar::weighted_sums(&image, 5, 6));
    }
}

#[test]
fn invalid_positions_read_nothing_outside_the_image() {
    let image = random_image(40, 30, 3);
    let mut samples = [0.0; 256];
    for value in [f64::NAN, f64::INFINITY, -1e30, 1e30, -5.0, 1e9] {
        let grid = Grid { first: [value, 5.0], along_row: [1.0, value], along_column: [0.0, 1.0] };
        sample_patch(&image, &grid, &mut samples);
    }
}

#[test]
fn hamming_distances_match_a_count_bit_by_bit() {
    let mut values = random(3);
    let mut word = || u64::from_le_bytes([(); 8].map(|()| values.next().unwrap_or(0)));
    let pairs: Vec<[[u64; 4]; 2]> =
        (0..37).map(|_| [[(); 4].map(|()| word()), [(); 4].map(|()| word())]).collect();
    let mut of_pairs = vec![0; pairs.len()];
    differing_bits_of_pairs(&pairs, &mut of_pairs);
    // Bit by bit, independent of the kernel's algorithm.
    let differ = |a: &[u64; 4], b: &[u64; 4]| {
        (0..256).filter(|bit| (a[bit / 64] ^ b[bit / 64]) >> (bit % 64) & 1 == 1).count()
    };
    for ([a, b], bits) in pairs.iter().zip(of_pairs) {
        assert_eq!(bits as usize, differ(a, b));
        let mut to_many = [0; 2];
        differing_bits(a, &[*b, *a], &mut to_many);
        assert_eq!(to_many, [bits, 0]);
    }
    let mut extremes = [0];
    differing_bits(&[0; 4], &[[u64::MAX; 4]], &mut extremes);
    assert_eq!(extremes, [256]);
}
