//! Rolling shutter, static image regions, uneven ground, swaying ground and focus breathing.

use super::tests::{config, standing};
use super::*;
use crate::*;
use odograph::geometry::Ray;

fn driving(effects: Effects) -> Simulation {
    let path = Path::new(PathKind::Straight { length_m: 2.0 }, 1.0, 0.8, false).unwrap();
    let config = config(PathKind::Still { duration_s: 1.0 });
    Simulation::new(SimulationConfig { effects, path, ..config }).unwrap()
}

fn shaking() -> Option<Vibration> {
    Some(Vibration { shift_m: 0.004, turn_rad: 0.03, frequency_hz: 9.0 })
}

/// Image of an ideal camera at a pose over the same ground, rendered as flat.
fn flat_view(simulation: &Simulation, pose: &GroundPose) -> GrayImage {
    simulation.renderer.gray_view(&simulation.ground, pose)
}

fn most_different(a: &[u8], b: &[u8]) -> u8 {
    a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn each_rolling_shutter_row_has_the_pose_of_its_time() {
    let simulation = driving(Effects { readout_s: 0.03, vibration: shaking(), ..Effects::default() });
    let frame = simulation.frame(7).unwrap();
    for row in [0, 17, 59, 60, 101, 119] {
        let time_s = frame.time_s + 0.03 * ((row as f64 + 0.5) / 120.0 - 0.5);
        assert_eq!(simulation.row_time_s(frame.time_s, row), time_s);
        let whole = flat_view(&simulation, &simulation.truth(time_s));
        assert!(most_different(frame.image.row(row), whole.row(row)) <= 1, "row {row}");
    }
    // The readout has a visible effect: the first row is 15 mm, 4 pixels, behind.
    let global = flat_view(&simulation, &frame.truth);
    assert!(most_different(frame.image.row(0), global.row(0)) > 20);
    assert_eq!(frame.truth, simulation.truth(frame.time_s));
}

#[test]
fn rolling_shutter_blur_is_centred_on_each_row_time() {
    let effects = Effects { vibration: shaking(), exposure_s: 0.01, ..Effects::default() };
    let rolling = driving(Effects { readout_s: 0.02, ..effects.clone() });
    let image = rolling.frame(5).unwrap().image;
    for row in [3, 60, 116] {
        // The same row of a global-shutter frame taken at the time of the row.
        let time_s = rolling.row_time_s(5.0 / 30.0, row);
        let mut mean = vec![0.0f64; 160];
        for step in 0..40 {
            let moment_s = time_s + 0.01 * ((f64::from(step) + 0.5) / 40.0 - 0.5);
            let view = flat_view(&rolling, &rolling.truth(moment_s));
            mean.iter_mut().zip(view.row(row)).for_each(|(sum, gray)| *sum += f64::from(*gray) / 40.0);
        }
        let off: f64 = mean.iter().zip(image.row(row)).map(|(m, g)| (m - f64::from(*g)).abs()).sum::<f64>();
        assert!(off / 160.0 < 1.0, "row {row}: {} gray levels", off / 160.0);
    }
}

#[test]
fn flicker_makes_bands_in_a_rolling_shutter() {
    let lighting = Some(Lighting { drift: 0.0, offset_gray: 0.0, flicker: 0.2, flicker_hz: 100.0 });
    let plain = standing(Effects::default()).frame(2).unwrap().image;
    let banded = standing(Effects { lighting, readout_s: 0.02, ..Effects::default() }).frame(2).unwrap();
    let gain = |row: usize| {
        let sum = |image: &GrayImage| image.row(row).iter().map(|gray| f64::from(*gray)).sum::<f64>();
        sum(&banded.image) / sum(&plain)
    };
    for row in [5, 40, 75, 110] {
        let turns = 100.0 * (2.0 / 30.0 + 0.02 * ((row as f64 + 0.5) / 120.0 - 0.5));
        let expected = 1.0 + 0.2 * (std::f64::consts::TAU * turns).sin();
        assert!((gain(row) - expected).abs() < 0.01, "row {row}: {}", gain(row));
    }
}

#[test]
fn ground_beyond_a_kerb_is_seen_from_lower_height() {
    let kerb = Some(Kerb { height_m: 0.1, at_m: 0.1 });
    let simulation =
        standing(Effects { terrain: Terrain { kerb, ..Terrain::default() }, ..Effects::default() });
    let frame = simulation.frame(0).unwrap();
    assert_eq!(frame.truth, GroundPose::level(0.5));
    let (before, beyond) =
        (flat_view(&simulation, &GroundPose::level(0.5)), flat_view(&simulation, &GroundPose::level(0.4)));
    let mut seen = [0, 0];
    for row in 0..120 {
        for column in 0..160 {
            let ray = simulation.config.camera.ray_from_pixel(Pixel::new(column as f64, row as f64)).unwrap();
            let gray = frame.image.row(row)[column];
            // Forward is up in the image: at −y.
            if -0.4 * ray.y > 0.11 {
                assert!(gray.abs_diff(beyond.row(row)[column]) <= 1, "({column}, {row}) is beyond");
                seen[1] += 1;
            } else if -0.5 * ray.y < 0.09 {
                assert!(gray.abs_diff(before.row(row)[column]) <= 1, "({column}, {row}) is before");
                seen[0] += 1;
            }
        }
    }
    assert!(seen[0] > 5000 && seen[1] > 3000, "{seen:?}");
}

#[test]
fn a_step_down_occludes_the_ground_behind_its_edge() {
    // Looking over the edge from the top of the kerb, the ground between the edge and its occlusion
    // boundary is hidden.
    let kerb = Some(Kerb { height_m: -0.2, at_m: 0.1 });
    let simulation =
        standing(Effects { terrain: Terrain { kerb, ..Terrain::default() }, ..Effects::default() });
    let ray = |y: f64| Ray::new(0.0, y);
    let surface = simulation.surface.as_ref().unwrap();
    let met = |ray: Ray| {
        let per_drop = [-ray.y, -ray.x];
        let z = surface.meet([0.0, 0.0, 0.5], per_drop, surface.bounds((-1.0, 1.0), (-1.0, 1.0)));
        (per_drop[0] * (0.5 - z), z)
    };
    let (top, bottom) = (met(ray(-0.185)), met(ray(-0.215)));
    assert!((top.0 - 0.0925).abs() < 1e-6 && top.1.abs() < 1e-6, "{top:?}");
    assert!((bottom.0 - 0.1505).abs() < 1e-6 && (bottom.1 + 0.2).abs() < 1e-6, "{bottom:?}");
}

#[test]
fn stones_are_displaced_by_their_parallax() {
    let relief = Some(Relief { amplitude_m: 0.01, scale_m: 0.05 });
    let terrain = Terrain { relief, ..Terrain::default() };
    let simulation = standing(Effects { terrain, ..Effects::default() });
    let image = simulation.frame(0).unwrap().image;
    let flat = standing(Effects::default()).frame(0).unwrap().image;
    assert!(most_different(image.samples(), flat.samples()) > 30);
    let camera = &simulation.config.camera;
    let surface = simulation.surface.as_ref().unwrap();
    let mut compared = 0;
    for (row, column) in (6..114).step_by(9).flat_map(|row| (6..154).step_by(9).map(move |c| (row, c))) {
        let ray = camera.ray_from_pixel(Pixel::new(column as f64, row as f64)).unwrap();
        // Reference: march along the ray in steps of 10 µm until it is below the ground.
        let at = |z: f64| GroundPoint::new(-(0.5 - z) * ray.y, -(0.5 - z) * ray.x);
        let is_below = |z: f64| z <= surface.height_m(at(z).x_m, at(z).y_m);
        let z = (0..2200).map(|i| 0.011 - 1e-5 * f64::from(i)).find(|z| is_below(*z));
        let point = at(z.unwrap());
        // A camera whose middle pixel looks straight down at that point must see the same gray
        // level.
        let shade = surface.shade(point.x_m, point.y_m);
        let center = camera.ray_from_pixel(Pixel::new(80.0, 59.0)).unwrap();
        let above = GroundPose {
            x_m: point.x_m + 0.5 * center.y,
            y_m: point.y_m + 0.5 * center.x,
            ..GroundPose::level(0.5)
        };
        let expected = shade * f32::from(flat_view(&simulation, &above).row(59)[80]);
        let gray = f32::from(image.row(row)[column]);
        assert!((gray - expected).abs() < 3.0, "({column}, {row}): {gray}, not {expected}");
        compared += 1;
    }
    assert!(compared > 150);
}

#[test]
fn a_riding_camera_keeps_its_height_above_the_ground() {
    let terrain = Terrain {
        undulation: Some(Undulation { amplitude_m: 0.04, wavelength_m: 2.0 }),
        kerb: Some(Kerb { height_m: 0.08, at_m: 1.0 }),
        ..Terrain::default()
    };
    let level = driving(Effects { terrain, ..Effects::default() });
    let riding = driving(Effects { terrain: Terrain { ride: true, ..terrain }, ..Effects::default() });
    let mut lean = 0.0f64;
    for &time_s in level.times_s() {
        assert_eq!(level.truth(time_s).height_m, 0.5);
        let truth = riding.truth(time_s);
        let ground_m = riding.ground_level_m(GroundPoint::new(truth.x_m, truth.y_m));
        // The wheels are up to 25 cm from the centre.
        assert!((truth.height_m - ground_m - 0.5).abs() < 0.08, "{time_s} s: {}", truth.height_m - ground_m);
        lean = lean.max(truth.pitch_rad.abs());
    }
    let first = riding.truth(0.0);
    let mast_m = first.height_m.hypot(first.x_m.hypot(first.y_m));
    assert!((mast_m - 0.5).abs() < 1e-12, "upright on the wheels: {mast_m}");
    assert!(lean > 0.08, "{lean}");
}

#[test]
fn a_bumper_is_static_in_the_image() {
    let effects = Effects {
        bumper: Some(Bumper { share: 0.2 }),
        vibration: shaking(),
        exposure_s: 0.01,
        readout_s: 0.02,
        ..Effects::default()
    };
    let simulation = driving(effects);
    let images: Vec<GrayImage> = [3, 20, 40].map(|number| simulation.frame(number).unwrap().image).to_vec();
    let same =
        (0..160 * 120).filter(|i| images.iter().all(|image| image.samples()[*i] == images[0].samples()[*i]));
    let (same, bottom): (Vec<usize>, _) = (same.collect(), 112 * 160);
    assert!((bottom..160 * 120).all(|i| same.contains(&i)), "the last rows are all bumper");
    let share = same.len() as f64 / 19_200.0;
    assert!((share - 0.2).abs() < 0.03, "{share}");
    let contrast = images[0].samples()[bottom..].iter();
    assert!(contrast.clone().max().unwrap() - contrast.min().unwrap() > 120);
}

#[test]
fn dirt_and_lamp_are_static_in_the_image() {
    let plain = driving(Effects::default());
    let lit =
        driving(Effects { lamp: Some(Lamp::default()), dirt: Some(Dirt { count: 5 }), ..Effects::default() });
    let saturated = |number: usize| -> Vec<usize> {
        let image = lit.frame(number).unwrap().image;
        (0..19_200).filter(|i| image.samples()[*i] == 255).collect()
    };
    let (a, b) = (saturated(3), saturated(30));
    let both = a.iter().filter(|i| b.contains(i)).count();
    assert!(both > 50 && both as f64 > 0.4 * a.len() as f64, "{both} of {}", a.len());
    let corner = |simulation: &Simulation| f64::from(simulation.frame(3).unwrap().image.row(0)[159]);
    assert!(corner(&lit) < 0.7 * corner(&plain));
    assert_eq!(lit.truth(0.7), plain.truth(0.7));
}

#[test]
fn only_swaying_patches_move() {
    let sway = Some(Sway { amplitude_m: 0.012, share: 0.4, period_s: 1.0 });
    let simulation = standing(Effects { sway, ..Effects::default() });
    let images: Vec<GrayImage> = (0..30).step_by(4).map(|n| simulation.frame(n).unwrap().image).collect();
    let still = (0..19_200)
        .filter(|i| images.iter().all(|image| image.samples()[*i] == images[0].samples()[*i]))
        .count() as f64
        / 19_200.0;
    // One view contains few patches, so its swaying fraction varies widely about the configured
    // one.
    assert!((0.1..0.9).contains(&still), "{still}");
    let flat = flat_view(&simulation, &GroundPose::level(0.5));
    let moved = most_different(images[3].samples(), flat.samples());
    assert!(moved > 30, "{moved}");
}

#[test]
fn focus_breathing_matches_the_camera_model_of_that_time() {
    let breathing = Some(Breathing { share: 0.03, period_s: 4.0 });
    let simulation = standing(Effects { breathing, ..Effects::default() });
    assert_eq!(simulation.camera(0.0).unwrap(), simulation.config.camera);
    for number in [15, 30, 80] {
        let frame = simulation.frame(number).unwrap();
        let camera = simulation.camera(frame.time_s).unwrap();
        let expected = 125.0 * (1.0 + 0.03 * (std::f64::consts::TAU * frame.time_s / 4.0).sin());
        assert!((camera.focal_px().0 - expected).abs() < 1e-9);
        let view = Renderer::new(&camera).gray_view(&simulation.ground, &frame.truth);
        assert!(most_different(frame.image.samples(), view.samples()) <= 2, "frame {number}");
    }
}

#[test]
fn invalid_effects_are_rejected_by_name() {
    let refused = |effects: Effects| {
        let config = config(PathKind::Straight { length_m: 1.0 });
        Simulation::new(SimulationConfig { effects, ..config }).unwrap_err().to_string()
    };
    let none = Effects::default;
    let text = refused(Effects { readout_s: 0.04, ..none() });
    assert!(text.contains("readout time of 0.04 s is longer than the time between frames"), "{text}");
    assert!(refused(Effects { readout_s: -0.01, ..none() }).contains("readout time is -0.01"));
    assert!(refused(Effects { readout_s: f64::NAN, ..none() }).contains("readout time is NaN"));
    assert!(
        refused(Effects { bumper: Some(Bumper { share: 1.2 }), ..none() })
            .contains("share of the image is 1.2")
    );
    let sway = Some(Sway { amplitude_m: 0.01, share: 2.0, period_s: 1.0 });
    assert!(refused(Effects { sway, ..none() }).contains("ground that sways is 2"));
    let lamp = Some(Lamp { strength: -1.0, ..Lamp::default() });
    assert!(refused(Effects { lamp, ..none() }).contains("lamp's strength is -1"));
    let breathing = Some(Breathing { share: 0.5, period_s: 1.0 });
    assert!(refused(Effects { breathing, ..none() }).contains("focal length is 0.5"));
    let ramp = Some(Ramp { slope: 0.9, at_m: 0.1 });
    let terrain = Terrain { ramp, ..Terrain::default() };
    assert!(refused(Effects { terrain, ..none() }).contains("above the ground"));
}
