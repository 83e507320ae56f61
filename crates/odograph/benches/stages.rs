//! Time of each stage of a frame: `cargo bench -p odograph`. The ground is rendered asphalt with
//! image noise of 2 gray levels.

use criterion::{BatchSize, BenchmarkId, Criterion, criterion_group, criterion_main};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::correction::{FieldOfViewKept, ImageCorrection};
use odograph::detection::{DetectionConfig, detect};
use odograph::flow::{FlowConfig, Template, Warp, track};
use odograph::geometry::Pixel;
use odograph::image::{GrayImage, Pyramid, RgbImage};
use odograph::odometry::{Odometry, OdometryConfig};
use odograph_simulation::{Effects, Path, PathKind, RenderedFrame, Simulation, SimulationConfig, Texture};
use std::hint::black_box;

const SIZES: [(usize, usize); 2] = [(640, 480), (1280, 720)];

/// Number of frames of a curved drive, enough for a few keyframes.
const FRAMES: usize = 60;

fn camera(size: (usize, usize)) -> Camera {
    let focal_px = 0.78 * size.0 as f64;
    let centre = (0.5 * size.0 as f64, 0.5 * size.1 as f64);
    Camera::new(size, (focal_px, focal_px), centre, Distortion::None).expect("a sound camera")
}

fn frames(size: (usize, usize), count: usize) -> Vec<RenderedFrame> {
    let path = Path::new(PathKind::FigureEight { length_m: 3.0, laps: 1.0 }, 0.6, 1.0, true);
    let simulation = Simulation::new(SimulationConfig {
        camera: camera(size),
        rig: Rig::level(0.75),
        texture: Texture::Asphalt,
        path: path.expect("a sound path"),
        effects: Effects { noise_gray: 2.0, ..Effects::default() },
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed: 5,
    });
    // From the middle of the drive, at full speed.
    let simulation = simulation.expect("a sound scene");
    (30..30 + count).filter_map(|number| simulation.frame(number)).collect()
}

fn stages(criterion: &mut Criterion) {
    for size in SIZES {
        let mut group = criterion.benchmark_group(format!("{}x{}", size.0, size.1));
        group.sample_size(20);
        let frames = frames(size, FRAMES);
        let image: &GrayImage = &frames[0].image;

        let lens = Distortion::from_opencv(&[-0.28, 0.07, 0.0002, -0.0003]).expect("four coefficients");
        let bent = Camera::new(size, camera(size).focal_px(), camera(size).principal_px(), lens);
        let correction = ImageCorrection::new(&bent.expect("a sound camera"), FieldOfViewKept::default());
        let correction = correction.expect("a lens that reaches the edge");
        let mut corrected = GrayImage::new(size.0, size.1);
        group.bench_function("correction of a gray image", |b| {
            b.iter(|| correction.apply_into(black_box(image), &mut corrected))
        });
        let samples = image.samples().iter().flat_map(|sample| [*sample; 3]).collect();
        let colored = RgbImage::from_samples(size.0, size.1, samples).expect("three samples a pixel");
        let mut corrected = RgbImage::new(size.0, size.1);
        group.bench_function("correction of a colour image", |b| {
            b.iter(|| correction.apply_rgb_into(black_box(&colored), &mut corrected))
        });

        let mut pyramid = Pyramid::new(image.clone(), 4);
        group.bench_function("pyramid of 4 levels", |b| {
            b.iter_batched(|| image.clone(), |image| pyramid.replace(image), BatchSize::LargeInput)
        });

        let detection = DetectionConfig { corners: 500, minimum_distance_px: 10.0, ..Default::default() };
        group.bench_function("detection of 500 corners", |b| {
            b.iter(|| detect(black_box(image), &detection, 9))
        });

        let corners = detect(image, &detection, 9);
        let templates = |pyramid: &Pyramid| -> Vec<Template> {
            corners.iter().filter_map(|corner| Template::new(pyramid, (corner.x, corner.y))).collect()
        };
        group.bench_function("templates of 500 corners", |b| b.iter(|| templates(black_box(&pyramid))));

        // Tracking into the next frame, from the corners' previous positions: a few pixels off.
        let templates = templates(&pyramid);
        let next = Pyramid::new(frames[1].image.clone(), 4);
        let config = FlowConfig::default();
        for (name, off_px) in [("4 levels", f64::INFINITY), ("2 levels", 2.0)] {
            group.bench_function(BenchmarkId::new("Lucas-Kanade of 500 corners", name), |b| {
                b.iter(|| {
                    let find = |template: &&Template| {
                        let Pixel { x, y } = template.centre();
                        track(template, &next, &Warp::translation(Pixel::new(x, y)), off_px, &config).is_ok()
                    };
                    templates.iter().filter(find).count()
                })
            });
        }

        group.bench_function(format!("process, {FRAMES} frames"), |b| {
            let start = || {
                let odometry = Odometry::new(camera(size), Rig::level(0.75), OdometryConfig::default());
                (odometry.expect("a sound rig"), frames.clone())
            };
            let follow = |(mut odometry, frames): (Odometry, Vec<RenderedFrame>)| {
                for frame in frames {
                    let _ = black_box(odometry.process(frame.image, frame.time_s));
                }
            };
            b.iter_batched(start, follow, BatchSize::LargeInput)
        });
        group.finish();
    }
}

criterion_group!(benches, stages);
criterion_main!(benches);
