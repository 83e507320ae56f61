//! Effect of storing keyframe images as JPEG instead of PNG: size, time, and displacement of
//! corners.
//!
//! A view is rendered over each texture, with camera noise. Its corners are tracked in the image
//! read back from the map file: their displacement is the measurement error due to compression. For
//! comparison, the same corners are tracked in a second frame with different noise.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // an example prints its results

use nalgebra::Matrix6;
use odograph::camera::{Camera, Rig};
use odograph::detection::{DetectionConfig, detect};
use odograph::flow::{FlowConfig, Template, Warp, track};
use odograph::geometry::GroundPose;
use odograph::ground_map::{KeyframeImage, KeyframeImages, MapKeyframe};
use odograph::image::{GrayImage, Pyramid};
use odograph::keyframe::KeyframeId;
use odograph::place_recognition::Signature;
use odograph_map::MapFile;
use odograph_simulation::{Ground, Renderer, Texture};
use std::time::Instant;

fn main() {
    let camera = Camera::from_field_of_view((640, 480), (0.8, 0.6), 0.5).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut map = MapFile::create(&folder.path().join("map.gpkg"), &camera, &Rig::level(0.5)).unwrap();
    println!(
        "texture    PNG kB  ms  JPEG kB  ms in, out   corners moved by the file, by noise of 2 gray levels (px, root mean square)"
    );
    for (number, name) in Texture::names().enumerate() {
        let id = KeyframeId(number as u64);
        let ground = Ground::new(Texture::named(name).unwrap(), 0.8 / 640.0, false, 3).unwrap();
        let clean = Renderer::new(&camera).gray_view(&ground, &GroundPose::level(0.5));
        let (first, second) = (noisy(&clean, 1), noisy(&clean, 2));
        let bytes_before = map.image_bytes().unwrap().1;
        let started = Instant::now();
        map.add_keyframe(&keyframe(id), &KeyframeImage { gray: first.clone(), color: None }, &[]).unwrap();
        let (in_ms, started) = (1e3 * started.elapsed().as_secs_f64(), Instant::now());
        let back = map.load(id).unwrap().gray;
        let out_ms = 1e3 * started.elapsed().as_secs_f64();
        let started = Instant::now();
        let png = png_bytes(&first);
        let png_ms = 1e3 * started.elapsed().as_secs_f64();
        println!(
            "{name:10} {:6.0} {png_ms:3.0} {:8.0} {in_ms:3.0} {out_ms:3.0}         {:.4}  {:.4}",
            png as f64 / 1e3,
            (map.image_bytes().unwrap().1 - bytes_before) as f64 / 1e3,
            moved_px(&first, back),
            moved_px(&first, second),
        );
    }
}

fn keyframe(id: KeyframeId) -> MapKeyframe {
    let pose = GroundPose::level(0.5);
    let (covariance, signature) = (Matrix6::zeros(), Signature::default());
    MapKeyframe {
        id,
        session: 0,
        segment: 0,
        frame: 0,
        time_s: 0.0,
        odometry_pose: pose,
        pose,
        covariance,
        signature,
    }
}

/// Adds Gaussian noise of two gray levels, approximated by the sum of twelve uniform random
/// numbers.
fn noisy(clean: &GrayImage, seed: u64) -> GrayImage {
    let mut state = seed;
    let mut even = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / (1 << 24) as f64
    };
    let samples = clean.samples().iter().map(|&gray| {
        let normal = (0..12).map(|_| even()).sum::<f64>() - 6.0;
        (f64::from(gray) + 2.0 * normal).round().clamp(0.0, 255.0) as u8
    });
    GrayImage::from_samples(clean.width(), clean.height(), samples.collect()).unwrap()
}

fn moved_px(from: &GrayImage, to: GrayImage) -> f64 {
    let (from, to) = (Pyramid::new(from.clone(), 4), Pyramid::new(to, 4));
    let corners = detect(from.base(), &DetectionConfig::default(), 16);
    let moved = corners.iter().filter_map(|corner| {
        let template = Template::new(&from, (corner.x, corner.y))?;
        let at = template.centre();
        let found = track(&template, &to, &Warp::translation(at), 1.0, &FlowConfig::default()).ok()?;
        Some(found.position.distance(at).powi(2))
    });
    let squares: Vec<f64> = moved.collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

fn png_bytes(image: &GrayImage) -> usize {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width() as u32, image.height() as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_compression(png::Compression::Fast);
    encoder.write_header().unwrap().write_image_data(image.samples()).unwrap();
    bytes.len()
}
