//! Quality and cost of a mosaic: `mosaic seams` and `mosaic growth`.
//!
//! `seams`: three lanes over each texture, rendered with vignetting, an exposure that changes from
//! frame to frame, and pose errors as in a good map (0.4 mm, 0.03°). The mosaic is compared with
//! the true texture in small windows: displacement of each window (registered by Gauss–Newton with
//! gain and offset), brightness step to its neighbour, and fraction of the texture's contrast that
//! remains. Compared are the mosaic accumulated frame by frame and the one rendered from the map.
//!
//! `growth`: lanes of a given number of keyframes: time, peak memory of the process and file size.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // an example prints its results

use nalgebra::{Matrix4, Matrix6, Vector4};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::geometry::{GroundPoint, GroundPose};
use odograph::ground_map::{KeyframeImage, MapKeyframe};
use odograph::image::GrayImage;
use odograph::keyframe::KeyframeId;
use odograph::mosaic::{Mosaic, MosaicOptions, MosaicPicture};
use odograph::place_recognition::Signature;
use odograph_map::MapFile;
use odograph_simulation::{Ground, Renderer, Texture};
use std::time::Instant;

const FOOTPRINT_M: f64 = 0.5 / 260.0;

fn main() {
    match std::env::args().nth(1).as_deref() {
        Some("seams") => seams(),
        Some("growth") => growth(std::env::args().nth(2).and_then(|text| text.parse().ok()).unwrap_or(100)),
        _ => println!("give `seams`, or `growth` and a number of keyframes"),
    }
}

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.2, 0.05, 0.0002, -0.0003]).unwrap();
    Camera::new((320, 240), (260.0, 261.0), (158.0, 121.0), distortion).unwrap()
}

fn random(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 40) as f64 / (1 << 24) as f64
}

/// Three lanes of eight views. Consecutive views overlap by half, adjacent lanes by a third.
fn lanes() -> Vec<GroundPose> {
    let pose = |k: usize| {
        let (lane, step) = (k / 8, if (k / 8).is_multiple_of(2) { k % 8 } else { 7 - k % 8 });
        let heading_rad = if lane.is_multiple_of(2_usize) { 0.02 } else { std::f64::consts::PI - 0.03 };
        GroundPose {
            x_m: 0.22 * step as f64,
            y_m: 0.4 * lane as f64,
            heading_rad,
            roll_rad: 0.01,
            pitch_rad: -0.02,
            ..GroundPose::level(0.5)
        }
    };
    (0..24).map(pose).collect()
}

/// Applies vignetting and the given exposure to a rendered image.
fn exposed(clean: &GrayImage, exposure: f64) -> GrayImage {
    let (width, height) = (clean.width(), clean.height());
    let half = 0.25 * (width * width + height * height) as f64;
    let samples = clean.samples().iter().enumerate().map(|(k, &gray)| {
        let (x, y) = ((k % width) as f64 - 0.5 * width as f64, (k / width) as f64 - 0.5 * height as f64);
        (f64::from(gray) * exposure * (1.0 - 0.25 * (x * x + y * y) / half)).round().clamp(0.0, 255.0) as u8
    });
    GrayImage::from_samples(width, height, samples.collect()).unwrap()
}

fn keyframe(number: usize, pose: GroundPose) -> MapKeyframe {
    let (covariance, signature) = (Matrix6::zeros(), Signature::default());
    let id = KeyframeId(number as u64);
    MapKeyframe {
        id,
        session: 0,
        segment: 0,
        frame: id.0,
        time_s: id.0 as f64,
        odometry_pose: pose,
        pose,
        covariance,
        signature,
    }
}

fn seams() {
    let (camera, poses) = (camera(), lanes());
    println!(
        "texture, mosaic       shift px: median  90 %   step between neighbours %: median  90 %   contrast left"
    );
    for name in ["asphalt", "carpet", "tiles", "bricks", "grass", "concrete"] {
        let texture = Texture::named(name).unwrap();
        let ground = Ground::new(texture.clone(), FOOTPRINT_M, false, 3).unwrap();
        let renderer = Renderer::new(&camera);
        let folder = tempfile::tempdir().unwrap();
        let mut map = MapFile::create(&folder.path().join("map.gpkg"), &camera, &Rig::level(0.5)).unwrap();
        let mut rendered = Mosaic::new(MosaicOptions::default());
        let mut state = 17;
        let mut off =
            |most: f64| most * (random(&mut state) + random(&mut state) + random(&mut state) - 1.5) * 2.0;
        for (number, pose) in poses.iter().enumerate() {
            let image = exposed(&renderer.gray_view(&ground, pose), 1.0 + off(0.1));
            let turn = off(0.03_f64.to_radians());
            let known = GroundPose {
                x_m: pose.x_m + off(4e-4),
                y_m: pose.y_m + off(4e-4),
                heading_rad: pose.heading_rad + turn,
                ..*pose
            };
            rendered.add(&image, &camera, &known);
            map.add_keyframe(&keyframe(number, known), &KeyframeImage { gray: image, color: None }, &[])
                .unwrap();
        }
        map.render_mosaic(None, &mut |_| true).unwrap();
        let pictures = [
            ("as it came", rendered.picture().unwrap()),
            ("of the map", map.mosaic_picture(usize::MAX).unwrap().unwrap()),
        ];
        for (kind, picture) in &pictures {
            let [shift, step, contrast] = judged(picture, &texture);
            println!(
                "{name:9} {kind}             {:.2}  {:.2}                              {:.2}  {:.2}            {:.2}",
                quantile(&shift, 0.5),
                quantile(&shift, 0.9),
                quantile(&step, 0.5),
                quantile(&step, 0.9),
                quantile(&contrast, 0.5),
            );
            if let Some(to) = std::env::args().nth(2) {
                let mut encoder = png::Encoder::new(
                    std::fs::File::create(format!("{to}/{name} {kind}.png")).unwrap(),
                    picture.width as u32,
                    picture.height as u32,
                );
                encoder.set_color(png::ColorType::Rgba);
                encoder.write_header().unwrap().write_image_data(&picture.rgba).unwrap();
            }
        }
    }
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(((sorted.len().max(1) - 1) as f64 * share) as usize).copied().unwrap_or(f64::NAN)
}

/// Half the side of a window, pixels.
const HALF: i64 = 12;

/// Displacement (pixels), brightness step to the window on the right (per cent) and remaining
/// contrast of windows all over a picture.
fn judged(picture: &MosaicPicture, texture: &Texture) -> [Vec<f64>; 3] {
    let (mut shifts, mut steps, mut contrasts) = (vec![], vec![], vec![]);
    let side = 2 * HALF as usize + 1;
    for row in (side..picture.height - side).step_by(side) {
        let mut before: Option<f64> = None;
        for column in (side..picture.width - side).step_by(side) {
            let Some(found) = registered(picture, texture, column as i64, row as i64) else {
                before = None;
                continue;
            };
            shifts.push(found[0].hypot(found[1]));
            contrasts.push(found[3]);
            if let Some(before) = before {
                steps.push(100.0 * (found[2] / before - 1.0).abs());
            }
            before = Some(found[2]);
        }
    }
    [shifts, steps, contrasts]
}

/// Displacement (x, y) of a window, its brightness relative to the true one, and the fraction of
/// its contrast that remains.
fn registered(picture: &MosaicPicture, texture: &Texture, column: i64, row: i64) -> Option<[f64; 4]> {
    let pixel = |x: i64, y: i64| picture.rgba[4 * (y as usize * picture.width + x as usize)..][..4].to_vec();
    let window = || (-HALF..=HALF).flat_map(|y| (-HALF..=HALF).map(move |x| (x, y)));
    if window().any(|(x, y)| pixel(column + x, row + y)[3] == 0) {
        return None;
    }
    let metres = picture.placement.metres_per_pixel;
    let at = |x: f64, y: f64| {
        let ground = picture.placement.ground_from_pixel(x, y);
        let [r, g, b] = texture.color(GroundPoint::new(ground.x_m, ground.y_m), metres, 3);
        f64::from(0.299 * r + 0.587 * g + 0.114 * b)
    };
    let mut shift = [0.0, 0.0];
    let (mut gain, mut offset) = (1.0, 0.0);
    for _ in 0..6 {
        let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for (x, y) in window() {
            let (u, v) = ((column + x) as f64 + shift[0], (row + y) as f64 + shift[1]);
            let truth = at(u, v);
            let slope = (0.5 * (at(u + 1.0, v) - at(u - 1.0, v)), 0.5 * (at(u, v + 1.0) - at(u, v - 1.0)));
            let j = Vector4::new(gain * slope.0, gain * slope.1, truth, 1.0);
            normal += j * j.transpose();
            right += j * (f64::from(pixel(column + x, row + y)[0]) - gain * truth - offset);
        }
        let step = normal.cholesky()?.solve(&right);
        shift = [shift[0] + step[0], shift[1] + step[1]];
        (gain, offset) = (gain + step[2], offset + step[3]);
    }
    let (mut seen, mut truth) = (0.0, 0.0);
    for (x, y) in window() {
        seen += f64::from(pixel(column + x, row + y)[0]);
        truth += at((column + x) as f64 + shift[0], (row + y) as f64 + shift[1]);
    }
    let far = shift[0].hypot(shift[1]) > 6.0;
    (!far).then_some([shift[0], shift[1], seen / truth, gain / (seen / truth)])
}

/// Long lanes from a few images, used repeatedly.
fn growth(keyframes: usize) {
    let camera = camera();
    let ground = Ground::new(Texture::named("asphalt").unwrap(), FOOTPRINT_M, false, 3).unwrap();
    let renderer = Renderer::new(&camera);
    let images: Vec<GrayImage> = (0..8)
        .map(|k| {
            renderer.gray_view(&ground, &GroundPose { x_m: 0.22 * f64::from(k), ..GroundPose::level(0.5) })
        })
        .collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let mut map = MapFile::create(&path, &camera, &Rig::level(0.5)).unwrap();
    let started = Instant::now();
    for number in 0..keyframes {
        // Lanes of a hundred keyframes.
        let (lane, step) = (number / 100, number % 100);
        let pose = GroundPose { x_m: 0.22 * step as f64, y_m: 0.4 * lane as f64, ..GroundPose::level(0.5) };
        let image = KeyframeImage { gray: images[number % 8].clone(), color: None };
        map.add_keyframe(&keyframe(number, pose), &image, &[]).unwrap();
    }
    let (added_s, started) = (started.elapsed().as_secs_f64(), Instant::now());
    map.render_mosaic(None, &mut |_| true).unwrap();
    let rendered_s = started.elapsed().as_secs_f64();
    let layer = map.mosaic().unwrap().unwrap();
    let (width, height, _) = layer.picture_at(layer.finest);
    map.close().unwrap();
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak =
        status.lines().find(|line| line.starts_with("VmHWM")).unwrap_or("VmHWM: not known here").to_owned();
    println!(
        "{keyframes} keyframes added in {added_s:.1} s, mosaic of {width}x{height} px rendered in {rendered_s:.1} s, file {:.1} MB, {peak}",
        std::fs::metadata(&path).unwrap().len() as f64 / 1e6
    );
}
