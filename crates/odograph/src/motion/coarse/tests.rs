use super::*;
use crate::camera::{Distortion, Rig};
use crate::geometry::{Pixel, wrap_angle};
use crate::image::GrayImage;
use crate::motion::Random;
use crate::simulation::{Ground, Renderer, Texture, shared_ground};
use std::f64::consts::PI;
use std::sync::Arc;

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap();
    Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), distortion).unwrap()
}

/// Numbers from 0 to 1.
fn uniform(random: &mut Random) -> f64 {
    (random.bits() >> 11) as f64 / (1u64 << 53) as f64
}

/// Fraction of one camera's image that shows ground the other one sees.
fn overlap(camera: &Camera, from: &GroundPose, to: &GroundPose) -> f64 {
    let pixels = (0..16).flat_map(|j| (0..16).map(move |i| (i, j)));
    let seen = pixels.filter(|&(i, j)| {
        let pixel = Pixel::new(f64::from(i) * 40.0 + 20.0, f64::from(j) * 30.0 + 15.0);
        camera
            .ray_from_pixel(pixel)
            .and_then(|ray| from.ground_from_ray(ray))
            .and_then(|ground| to.ray_from_ground(ground))
            .and_then(|ray| camera.pixel_from_ray(ray))
            .is_some_and(|pixel| camera.contains(pixel, 0.0))
    });
    seen.count() as f64 / 256.0
}

/// An image with gain, noise, and blur over `smear` pixels of a row.
fn degraded(image: GrayImage, gain: f64, noise: f64, smear: usize, random: &mut Random) -> GrayImage {
    let (width, height) = (image.width(), image.height());
    let mut samples = Vec::with_capacity(width * height);
    for y in 0..height {
        let row = image.row(y);
        for x in 0..width {
            let around = &row[x.saturating_sub(smear / 2)..(x + smear / 2 + 1).min(width)];
            let mean = around.iter().map(|&s| f64::from(s)).sum::<f64>() / around.len() as f64;
            let gaussian: f64 = (0..4).map(|_| uniform(random) - 0.5).sum::<f64>() * 1.73;
            samples.push((gain * mean + noise * gaussian).round().clamp(0.0, 255.0) as u8);
        }
    }
    GrayImage::from_samples(width, height, samples).unwrap()
}

/// A camera and the ground below it, shared by many cases because making the ground is slow.
struct CoarseWorld {
    name: &'static str,
    camera: Camera,
    renderer: Renderer,
    ground: Arc<Ground>,
}

impl CoarseWorld {
    fn new(name: &'static str) -> Self {
        let camera = camera();
        let renderer = Renderer::new(&camera);
        let ground = shared_ground(name, renderer.footprint_m(0.75), 11);
        Self { name, camera, renderer, ground }
    }
}

struct Case {
    world: Arc<CoarseWorld>,
    overlaps: (f64, f64),
    rig: Rig,
    height: f64,
    smear: usize,
    number: u64,
}

/// Whether the best hypothesis is right, whether any is (within 12 pixels, 1.5°, 2 % of scale), and
/// the best score.
fn found(case: &Case) -> (bool, bool, f64) {
    let CoarseWorld { camera, renderer, ground, .. } = &*case.world;
    let mut random = Random::new(case.number);
    let offset = |random: &mut Random| 0.5 * uniform(random);
    let keyframe = GroundPose {
        x_m: offset(&mut random),
        y_m: offset(&mut random),
        heading_rad: 2.0 * PI * uniform(&mut random),
        ..case.rig.first_pose()
    };
    let footprint_m = ground.footprint_m();
    let truth = loop {
        let direction = 2.0 * PI * uniform(&mut random);
        let reach = 1.2 * case.rig.height_m * uniform(&mut random);
        let pose = GroundPose {
            x_m: keyframe.x_m + reach * direction.cos(),
            y_m: keyframe.y_m + reach * direction.sin(),
            heading_rad: keyframe.heading_rad + 2.0 * PI * uniform(&mut random),
            height_m: case.height * keyframe.height_m,
            ..keyframe
        };
        let part = overlap(camera, &keyframe, &pose);
        if part >= case.overlaps.0 && part <= case.overlaps.1 {
            break pose;
        }
    };
    let gain = 0.6 + 0.6 * uniform(&mut random);
    let first = degraded(renderer.gray_view(ground, &keyframe), 1.0, 2.0, 1, &mut random);
    let second = degraded(renderer.gray_view(ground, &truth), gain, 2.0, case.smear, &mut random);
    let registration = CoarseRegistration::new(camera);
    let assumed = case.rig.first_pose();
    let before = registration.view(&Pyramid::new(first, 4), None, &assumed).unwrap();
    let now = registration.view(&Pyramid::new(second, 4), None, &assumed).unwrap();
    let options = CoarseOptions { scale_free: case.height != 1.0, ..Default::default() };
    let hypotheses = registration.register(&before, &now, &options);
    let right = |hypothesis: &Hypothesis| {
        let pose = hypothesis.pose(&keyframe, &assumed);
        (pose.x_m - truth.x_m).hypot(pose.y_m - truth.y_m) < 12.0 * footprint_m
            && wrap_angle(pose.heading_rad - truth.heading_rad).abs() < 1.5f64.to_radians()
            && (pose.height_m / truth.height_m - 1.0).abs() < 0.02
    };
    let score = hypotheses.first().map_or(0.0, |h| h.score);
    (hypotheses.first().is_some_and(right), hypotheses.iter().any(right), score)
}

fn cases(textures: &[&'static str], overlaps: (f64, f64), each: u64) -> Vec<Case> {
    let worlds = textures.iter().map(|&name| Arc::new(CoarseWorld::new(name)));
    let make = |world: Arc<CoarseWorld>| {
        (0..each).map(move |number| Case {
            world: world.clone(),
            overlaps,
            rig: Rig::level(0.75),
            height: 1.0,
            smear: 1,
            number,
        })
    };
    worlds.flat_map(make).collect()
}

/// Number of cases with the right hypothesis first, and with it at all.
fn counts(cases: &[Case]) -> (usize, usize) {
    let outcomes: Vec<_> = cases.iter().map(found).collect();
    for (case, outcome) in cases.iter().zip(&outcomes) {
        if !outcome.0 {
            println!("{} {}: {outcome:?}", case.world.name, case.number);
        }
    }
    (outcomes.iter().filter(|o| o.0).count(), outcomes.iter().filter(|o| o.1).count())
}

#[test]
fn half_an_overlap_at_any_rotation_is_registered() {
    let cases = cases(&["asphalt", "carpet", "concrete", "grass", "bricks"], (0.45, 1.0), 12);
    let (first, any) = counts(&cases);
    println!("{first} first, {any} of {}", cases.len());
    assert!(first >= 58, "{first} of {}", cases.len());
}

#[test]
fn a_third_of_overlap_at_any_rotation_is_mostly_registered() {
    let cases = cases(&["asphalt", "carpet", "concrete", "grass", "bricks"], (0.27, 0.4), 6);
    let (first, any) = counts(&cases);
    println!("{first} first, {any} of {}", cases.len());
    assert!(first >= 27, "{first} of {}", cases.len());
}

#[test]
fn blurred_and_tilted_views_are_registered() {
    let rig = Rig { roll_rad: 0.12, pitch_rad: -0.2, ..Rig::level(0.75) };
    let cases: Vec<Case> = cases(&["asphalt", "carpet", "concrete", "grass"], (0.5, 1.0), 3)
        .into_iter()
        .map(|case| Case { rig, smear: 25, ..case })
        .collect();
    let (first, any) = counts(&cases);
    println!("{first} first, {any} of {}", cases.len());
    assert!(first >= 11, "{first} of {}", cases.len());
}

#[test]
fn an_unknown_height_is_estimated() {
    let cases: Vec<Case> = cases(&["asphalt", "concrete", "grass"], (0.45, 1.0), 3)
        .into_iter()
        .map(|case| Case { height: 0.72 + 0.27 * case.number as f64, ..case })
        .collect();
    let (first, any) = counts(&cases);
    println!("{first} first, {any} of {}", cases.len());
    assert!(first >= 8, "{first} of {}", cases.len());
}

#[test]
fn tiles_have_the_truth_among_the_hypotheses() {
    let cases = cases(&["tiles"], (0.5, 1.0), 10);
    let (first, any) = counts(&cases);
    println!("{first} first, {any} of {}", cases.len());
    assert!(any >= 8, "{any} of {}", cases.len());
}

#[test]
fn unrelated_ground_scores_low() {
    let camera = camera();
    let renderer = Renderer::new(&camera);
    let registration = CoarseRegistration::new(&camera);
    let pose = GroundPose::level(0.75);
    let view = |seed: u64| {
        let ground = Ground::new(Texture::Asphalt, renderer.footprint_m(0.75), false, seed).unwrap();
        registration.view(&Pyramid::new(renderer.gray_view(&ground, &pose), 4), None, &pose).unwrap()
    };
    let (a, b) = (view(1), view(2));
    let unrelated = registration.register(&a, &b, &CoarseOptions::default());
    let itself = registration.register(&a, &a, &CoarseOptions::default());
    println!("{} {}", unrelated[0].score, itself[0].score);
    assert!(unrelated[0].score < 10.0, "{}", unrelated[0].score);
    assert!(itself[0].score > 20.0 && itself[0].heading_rad.abs() < 0.01, "{:?}", itself[0]);
}

#[test]
fn an_image_without_ground_has_no_view() {
    let camera = camera();
    let registration = CoarseRegistration::new(&camera);
    let pose = GroundPose { pitch_rad: -1.55, ..GroundPose::level(1.0) };
    let up = GroundPose { pitch_rad: 3.0, ..GroundPose::level(1.0) };
    let black = Pyramid::new(GrayImage::new(640, 480), 4);
    assert!(registration.view(&black, None, &up).is_none());
    // Hardly any ground must not cause a panic.
    let _ = registration.view(&black, None, &pose);
    let flat = registration.view(&black, None, &GroundPose::level(1.0)).unwrap();
    let found = registration.register(&flat, &flat, &CoarseOptions::default());
    assert!(found.iter().all(|h| h.x_m.is_finite() && h.score.is_finite()), "{found:?}");
}
