//! Frames agree with their ground truth, are reproducible, and effects have the configured
//! strength.

use super::*;
use crate::*;
use nalgebra::{Matrix3, Vector3};
use odograph::camera::Distortion;
use odograph::geometry::{GroundPoint, Ray};

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.12, 0.02, 0.0004, -0.0003]).unwrap();
    Camera::new((160, 120), (125.0, 125.0), (80.5, 59.0), distortion).unwrap()
}

pub(super) fn config(kind: PathKind) -> SimulationConfig {
    SimulationConfig {
        camera: camera(),
        rig: Rig::level(0.5),
        texture: Texture::Asphalt,
        path: Path::new(kind, 0.4, 0.8, true).unwrap(),
        effects: Effects::default(),
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed: 5,
    }
}

pub(super) fn standing(effects: Effects) -> Simulation {
    Simulation::new(SimulationConfig { effects, ..config(PathKind::Still { duration_s: 10.0 }) }).unwrap()
}

fn mean(image: &GrayImage) -> f64 {
    image.samples().iter().map(|&s| f64::from(s)).sum::<f64>() / image.samples().len() as f64
}

/// Polynomial interpolation over 6 × 6 pixels of a float image; `None` near the border. The
/// interpolation bias of 4 × 4 alone looks like a shift by 0.01 pixels.
fn interpolated(view: &[f32], width: usize, pixel: Pixel) -> Option<f64> {
    let height = view.len() / width;
    let (left, top) = (pixel.x.floor(), pixel.y.floor());
    let inside = left >= 2.0 && top >= 2.0 && left + 4.0 < width as f64 && top + 4.0 < height as f64;
    // Lagrange weights for the nodes −2 … 3.
    let weights = |t: f64| -> [f64; 6] {
        std::array::from_fn(|i| {
            (0..6).filter(|j| *j != i).map(|j| (t + 2.0 - j as f64) / (i as f64 - j as f64)).product()
        })
    };
    let (across, down) = (weights(pixel.x - left), weights(pixel.y - top));
    inside.then(|| {
        let start = (top as usize - 2) * width + left as usize - 2;
        let row =
            |j: usize| -> f64 { (0..6).map(|i| across[i] * f64::from(view[start + j * width + i])).sum() };
        (0..6).map(|j| down[j] * row(j)).sum()
    })
}

/// Low-pass filter (binomial 1 2 1): removes content near the Nyquist frequency, which no
/// interpolation reproduces, as image registration commonly does.
fn smoothed(view: &[f32], width: usize) -> Vec<f32> {
    let pass = |view: &[f32], step: usize| -> Vec<f32> {
        let at = |i: usize| view.get(i).copied().unwrap_or(0.0);
        (0..view.len())
            .map(|i| 0.25 * at(i.wrapping_sub(step)) + 0.5 * view[i] + 0.25 * at(i + step))
            .collect()
    };
    pass(&pass(view, 1), width)
}

/// Pose of the second view by dense photometric least squares over (x, y, heading), started near
/// the truth.
fn registered(
    first: &[f32],
    second: &[f32],
    camera: &Camera,
    from: &GroundPose,
    start: GroundPose,
) -> GroundPose {
    let width = camera.width();
    let points: Vec<(GroundPoint, f64)> = (0..first.len())
        .filter_map(|i| {
            let pixel = Pixel::new((i % width) as f64, (i / width) as f64);
            let ray = camera.ray_from_pixel(pixel)?;
            camera.contains(pixel, 8.0).then_some((from.ground_from_ray(ray)?, f64::from(first[i])))
        })
        .collect();
    let seen = |pose: &GroundPose, point: GroundPoint| {
        let pixel = camera.pixel_from_ray(pose.ray_from_ground(point)?)?;
        interpolated(second, width, pixel)
    };
    let moved = |pose: &GroundPose, axis: usize, step: f64| {
        let mut pose = *pose;
        match axis {
            0 => pose.x_m += step,
            1 => pose.y_m += step,
            _ => pose.heading_rad += step,
        }
        pose
    };
    let mut pose = start;
    for _ in 0..12 {
        let (mut normal, mut right) = (Matrix3::<f64>::zeros(), Vector3::<f64>::zeros());
        for (point, value) in &points {
            let step = 1e-4;
            let slope = |axis: usize| {
                Some(
                    (seen(&moved(&pose, axis, step), *point)? - seen(&moved(&pose, axis, -step), *point)?)
                        / (2.0 * step),
                )
            };
            let Some((here, jacobian)) = seen(&pose, *point)
                .and_then(|here| Some((here, Vector3::new(slope(0)?, slope(1)?, slope(2)?))))
            else {
                continue;
            };
            normal += jacobian * jacobian.transpose();
            right += jacobian * (value - here);
        }
        let change = normal.try_inverse().unwrap() * right;
        pose.x_m += change.x;
        pose.y_m += change.y;
        pose.heading_rad += change.z;
    }
    pose
}

#[test]
fn dense_registration_recovers_the_truth_to_0_003_px() {
    let camera = camera();
    let renderer = Renderer::new(&camera);
    // Tilted and distorted; sub-pixel shifts, and one with a rotation.
    let from = GroundPose { roll_rad: 0.04, pitch_rad: -0.07, x_m: 3.2, y_m: -1.7, ..GroundPose::level(0.5) };
    for texture in [Texture::Asphalt, Texture::Carpet, Texture::Grass, Texture::Concrete, Texture::Bare] {
        let ground = Ground::new(texture.clone(), renderer.footprint_m(0.5), false, 9).unwrap();
        let view = |pose: &GroundPose| {
            let mut image = vec![0.0; camera.width() * camera.height()];
            renderer.add_view(&ground, pose, 1.0, &mut image);
            smoothed(&image, camera.width())
        };
        let pixel_m = ground.footprint_m();
        for (dx, dy, turn_rad) in [(0.37, -0.21, 0.0), (-0.5, 0.5, 0.0), (1.3, 0.8, 0.02)] {
            let to = GroundPose {
                x_m: from.x_m + dx * pixel_m,
                y_m: from.y_m + dy * pixel_m,
                heading_rad: turn_rad,
                ..from
            };
            let start = GroundPose { x_m: to.x_m + 0.3 * pixel_m, heading_rad: turn_rad + 0.002, ..to };
            let found = registered(&view(&from), &view(&to), &camera, &from, start);
            let off_px = (found.x_m - to.x_m).hypot(found.y_m - to.y_m) / pixel_m;
            // at the image corner
            let turned_px = (found.heading_rad - to.heading_rad).abs() * 100.0;
            assert!(off_px < 0.003 && turned_px < 0.003, "{texture:?}: {off_px:.4} px, {turned_px:.4} px");
        }
    }
}

#[test]
fn every_frame_is_reproducible_in_any_order() {
    let effects = Effects {
        noise_gray: 3.0,
        exposure_s: 0.01,
        vibration: Some(Vibration { shift_m: 0.002, turn_rad: 0.01, frequency_hz: 8.0 }),
        object: Some(MovingObject { radius_m: 0.1, speed_m_s: 0.3, every_s: 1.0 }),
        timing: Timing { dropped: 0.2, jitter_s: 0.003 },
        ..Effects::default()
    };
    let make = |seed: u64| {
        let config = SimulationConfig {
            effects: effects.clone(),
            seed,
            ..config(PathKind::Straight { length_m: 0.5 })
        };
        Simulation::new(config).unwrap()
    };
    let (one, other) = (make(5), make(5));
    let in_order: Vec<_> = one.frames().map(|frame| frame.image).collect();
    assert_eq!(one.times_s(), other.times_s());
    for number in (0..other.len()).rev() {
        assert_eq!(other.frame(number).unwrap().image, in_order[number], "frame {number}");
    }
    assert!(other.frame(other.len()).is_none());
    assert_ne!(make(6).frame(3).unwrap().image, in_order[3], "another seed is another recording");
}

#[test]
fn the_truth_starts_at_the_origin_with_any_vibration() {
    let effects = Effects {
        vibration: Some(Vibration { shift_m: 0.01, turn_rad: 0.05, frequency_hz: 8.0 }),
        height_change: Some(SlowVariation { amplitude: 0.1, period_s: 3.0 }),
        tilt_change: Some(SlowVariation { amplitude: 0.05, period_s: 3.0 }),
        ..Effects::default()
    };
    let simulation = standing(effects);
    assert_eq!(simulation.frame(0).unwrap().truth, GroundPose::level(0.5));
    let (mut lowest, mut highest, mut tilt) = (f64::INFINITY, 0.0f64, 0.0f64);
    for &time_s in simulation.times_s() {
        let truth = simulation.truth(time_s);
        assert!(truth.x_m.abs() <= 0.01 && truth.heading_rad.abs() <= 0.05);
        lowest = lowest.min(truth.height_m);
        highest = highest.max(truth.height_m);
        tilt = tilt.max(truth.roll_rad.abs());
    }
    assert!(highest - lowest > 0.02 && highest - lowest <= 0.12 && tilt > 0.01 && tilt <= 0.1);
}

#[test]
fn noise_has_the_configured_standard_deviation() {
    let noisy = standing(Effects { noise_gray: 4.0, ..Effects::default() });
    let clean = standing(Effects::default()).frame(0).unwrap().image;
    let differences: Vec<f64> = (0..4)
        .flat_map(|number| {
            let image = noisy.frame(number).unwrap().image;
            let pairs = image.samples().iter().zip(clean.samples());
            pairs.map(|(&a, &b)| f64::from(a) - f64::from(b)).collect::<Vec<_>>()
        })
        .collect();
    let deviation = (differences.iter().map(|d| d * d).sum::<f64>() / differences.len() as f64).sqrt();
    // Quantisation adds a little; this texture does not saturate.
    assert!((deviation - 4.0).abs() < 0.15, "{deviation}");
}

#[test]
fn blur_is_along_the_motion_and_centred_on_the_truth() {
    let make = |exposure_s: f64| {
        let effects = Effects { exposure_s, ..Effects::default() };
        let path = Path::new(PathKind::Straight { length_m: 2.0 }, 1.0, 0.8, false).unwrap();
        let config = config(PathKind::Still { duration_s: 1.0 });
        Simulation::new(SimulationConfig { effects, path, ..config }).unwrap()
    };
    let (sharp, blurred) = (make(0.0).frame(30).unwrap(), make(0.02).frame(30).unwrap());
    assert_eq!(sharp.truth, blurred.truth);
    let roughness = |image: &GrayImage, step: usize| {
        let s = image.samples();
        (step..s.len()).map(|i| (f64::from(s[i]) - f64::from(s[i - step])).abs()).sum::<f64>()
    };
    // The motion is along the image columns: blur mixes rows, hardly columns.
    let across = roughness(&blurred.image, 1) / roughness(&sharp.image, 1);
    let along = roughness(&blurred.image, 160) / roughness(&sharp.image, 160);
    assert!(along < 0.85 * across, "{along} along, {across} across");
    // The sharp image fits the blurred one best without a shift by a row.
    let misfit = |shift: i64| {
        (10..110)
            .flat_map(|y: i64| (10..150).map(move |x: i64| (x, y)))
            .map(|(x, y)| {
                let a = f64::from(blurred.image.row(y as usize)[x as usize]);
                (a - f64::from(sharp.image.row((y + shift) as usize)[x as usize])).powi(2)
            })
            .sum::<f64>()
    };
    assert!(misfit(0) < misfit(1) && misfit(0) < misfit(-1));
    assert!((misfit(1) / misfit(-1) - 1.0).abs() < 0.1, "{} and {}", misfit(1), misfit(-1));
}

#[test]
fn a_blackout_darkens_only_its_own_frames() {
    let simulation = standing(Effects {
        blackouts: vec![Blackout { from_s: 1.0, to_s: 2.0 }],
        noise_gray: 1.0,
        ..Effects::default()
    });
    for (number, covered) in [(29, false), (30, true), (59, true), (60, false)] {
        let image = simulation.frame(number).unwrap().image;
        assert_eq!(mean(&image) < 12.0, covered, "frame {number}");
    }
}

#[test]
fn light_and_shadow_change_brightness_only() {
    let plain = standing(Effects::default()).frame(10).unwrap();
    let vignetted = standing(Effects { vignetting: 0.5, ..Effects::default() }).frame(10).unwrap();
    let corner = |image: &GrayImage| mean_of(image, 0..12, 0..12);
    let center = |image: &GrayImage| mean_of(image, 74..86, 54..66);
    assert!((center(&vignetted.image) / center(&plain.image) - 1.0).abs() < 0.02);
    assert!((corner(&vignetted.image) / corner(&plain.image) - 0.55).abs() < 0.06);
    let shadow = Shadow { darkness: 0.6, center: (0.5, 0.5), radius: 0.3 };
    let shaded = standing(Effects { carrier_shadow: Some(shadow), ..Effects::default() }).frame(10).unwrap();
    assert!((center(&shaded.image) / center(&plain.image) - 0.4).abs() < 0.03);
    assert!((corner(&shaded.image) / corner(&plain.image) - 1.0).abs() < 0.01);
    let lighting = Lighting { drift: 0.3, offset_gray: 5.0, flicker: 0.05, flicker_hz: 100.0 };
    let jumps = ExposureJumps { amount: 0.3, every_s: 2.0 };
    let lit =
        standing(Effects { lighting: Some(lighting), exposure_jumps: Some(jumps), ..Effects::default() });
    let means: Vec<f64> = (0..300).step_by(10).map(|i| mean(&lit.frame(i).unwrap().image)).collect();
    let (darkest, brightest) = means.iter().fold((f64::INFINITY, 0.0f64), |(a, b), m| (a.min(*m), b.max(*m)));
    assert!(brightest / darkest > 1.2, "{darkest} to {brightest}");
    assert_eq!(lit.frame(10).unwrap().truth, plain.truth);
}

fn mean_of(image: &GrayImage, columns: std::ops::Range<usize>, rows: std::ops::Range<usize>) -> f64 {
    let samples: Vec<f64> = rows
        .flat_map(|y| image.row(y)[columns.clone()].iter().map(|&s| f64::from(s)).collect::<Vec<_>>())
        .collect();
    samples.iter().sum::<f64>() / samples.len() as f64
}

#[test]
fn ground_shadows_move_with_the_ground() {
    let effects = Effects { ground_shadow: 0.6, ..Effects::default() };
    let make = |effects: Effects| {
        Simulation::new(SimulationConfig { effects, ..config(PathKind::Straight { length_m: 3.0 }) }).unwrap()
    };
    let (shaded, plain) = (make(effects), make(Effects::default()));
    let share = |number: usize| {
        mean(&shaded.frame(number).unwrap().image) / mean(&plain.frame(number).unwrap().image)
    };
    let shares: Vec<f64> = (0..plain.len()).step_by(20).map(share).collect();
    assert!(shares.iter().all(|s| (0.39..1.01).contains(s)), "{shares:?}");
    assert!(shares.iter().any(|s| *s < 0.9), "{shares:?}");
}

#[test]
fn an_object_covers_part_of_the_view_when_it_passes() {
    let object = MovingObject { radius_m: 0.08, speed_m_s: 0.4, every_s: 4.0 };
    let with = standing(Effects { object: Some(object), ..Effects::default() });
    let without = standing(Effects::default()).frame(0).unwrap().image;
    let covered = |number: usize| {
        let image = with.frame(number).unwrap().image;
        let differing = image.samples().iter().zip(without.samples()).filter(|(a, b)| a != b).count();
        differing as f64 / without.samples().len() as f64
    };
    assert_eq!(covered(0), 0.0);
    // At half its period it is in the middle of the view and covers π (0.08 / 0.5 · 125)² of 160 ·
    // 120 pixels.
    assert!((covered(60) - 0.065).abs() < 0.01, "{}", covered(60));
    assert!(covered(66) > 0.03);
}

#[test]
fn timestamps_of_dropped_and_late_frames_are_true() {
    let simulation =
        standing(Effects { timing: Timing { dropped: 0.25, jitter_s: 0.004 }, ..Effects::default() });
    let times = simulation.times_s();
    assert_eq!(times[0], 0.0);
    assert!((195..260).contains(&times.len()), "{} of 301 are left", times.len());
    assert!(times.windows(2).all(|pair| pair[1] > pair[0]));
    assert!(times.iter().any(|t| ((t * 30.0).round() / 30.0 - t).abs() > 0.002));
}

#[test]
fn gray_images_match_colour_images() {
    let make = |colored: bool| {
        let texture = Texture::Bricks;
        let config = SimulationConfig { colored, texture, ..config(PathKind::Straight { length_m: 1.0 }) };
        Simulation::new(config).unwrap().frame(20).unwrap()
    };
    let (gray, color) = (make(false), make(true));
    let rgb = color.color.unwrap();
    assert!(gray.color.is_none() && rgb.pixel(80, 60)[0] > rgb.pixel(80, 60)[2]);
    for (a, b) in gray.image.samples().iter().zip(color.image.samples()) {
        assert!(a.abs_diff(*b) <= 1);
    }
}

#[test]
fn a_camera_that_sees_the_horizon_is_rendered() {
    let rig = Rig { pitch_rad: -1.3, ..Rig::level(0.5) };
    let simulation =
        Simulation::new(SimulationConfig { rig, ..config(PathKind::Straight { length_m: 0.5 }) }).unwrap();
    let image = simulation.frame(3).unwrap().image;
    assert_eq!(image.row(0)[80], 150, "above the horizon there is no ground");
    assert!(simulation.truth(0.0).ground_from_ray(Ray::new(0.0, 0.4)).is_some());
}

#[test]
fn invalid_configurations_are_rejected_by_name() {
    let refused = |change: fn(&mut SimulationConfig)| {
        let mut config = config(PathKind::Straight { length_m: 1.0 });
        change(&mut config);
        Simulation::new(config).unwrap_err().to_string()
    };
    assert!(refused(|c| c.fps = 0.0).contains("frame rate is 0"));
    assert!(refused(|c| c.fps = f64::NAN).contains("frame rate is NaN"));
    assert!(refused(|c| c.rig.height_m = -1.0).contains("height is -1"));
    assert!(refused(|c| c.duration_s = Some(f64::INFINITY)).contains("inf s"));
    assert!(refused(|c| c.effects.noise_gray = -2.0).contains("noise is -2"));
    assert!(refused(|c| c.effects.timing.dropped = 1.0).contains("dropped"));
    assert!(refused(|c| c.effects.exposure_s = f64::NAN).contains("exposure"));
}
