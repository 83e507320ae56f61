//! A small map over rendered ground, for the tests in this folder.

use nalgebra::{Matrix4, Matrix6, Vector4};
use odograph::camera::{Camera, Distortion, Rig};
use odograph::geometry::GroundPose;
use odograph::ground_map::{KeyframeImage, MapKeyframe};
use odograph::image::{GrayImage, RgbImage};
use odograph::keyframe::{EdgeKind, KeyframeId, MapEdge};
use odograph::place_recognition::{GroundFeature, Signature};
use odograph_map::MapFile;
use odograph_simulation::{Ground, Renderer, Texture};
use std::path::Path;

/// A small camera with lens distortion.
pub fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0002, -0.0003]).unwrap();
    Camera::new((160, 120), (130.0, 131.0), (79.0, 60.5), distortion).unwrap()
}

/// Ground texture with fine and coarse structure.
pub fn ground() -> Ground {
    Ground::new(Texture::named("asphalt").unwrap(), 0.004, false, 5).unwrap()
}

/// Keyframes in lanes: six along x, then the next lane 0.3 m to the left, and so on.
pub fn pose(number: u64) -> GroundPose {
    let (lane, step) = (number / 6, number % 6);
    let along = if lane.is_multiple_of(2) { step } else { 5 - step };
    GroundPose {
        x_m: 0.2 * along as f64,
        y_m: 0.3 * lane as f64,
        heading_rad: 0.02 * number as f64,
        height_m: 0.5,
        roll_rad: 0.01,
        pitch_rad: -0.02,
    }
}

pub fn covariance() -> Matrix6<f64> {
    Matrix6::from_diagonal(&[1e-6, 2e-6, 3e-8, 4e-9, 0.0, 5e-10].into())
}

pub fn keyframe(number: u64, session: u32) -> MapKeyframe {
    let feature = |k: u64| GroundFeature {
        descriptor: [number, k, number << 40 | k, u64::MAX - k],
        position_m: [0.01 * k as f32, -0.02 * k as f32],
        direction_rad: 0.1 * k as f32,
    };
    MapKeyframe {
        id: KeyframeId(number),
        session,
        segment: (number / 12) as usize,
        frame: 10 * number,
        time_s: 0.1 + 0.333 * number as f64,
        odometry_pose: GroundPose { x_m: pose(number).x_m + 0.01 * number as f64, ..pose(number) },
        pose: pose(number),
        covariance: covariance(),
        signature: Signature { features: (0..20).map(feature).collect() },
    }
}

/// The edge from the previous keyframe.
pub fn edge_to(number: u64) -> MapEdge {
    MapEdge {
        from: KeyframeId(number - 1),
        to: KeyframeId(number),
        kind: if number.is_multiple_of(5) { EdgeKind::Gap } else { EdgeKind::Odometry },
        motion: Vector4::new(0.2, 0.001 * number as f64, 0.02, 1e-3),
        covariance: Matrix4::from_diagonal(&[1e-8, 1e-8, 1e-9, 0.0].into()),
    }
}

/// The rendered image of the ground.
pub fn gray(pose: &GroundPose) -> GrayImage {
    Renderer::new(&camera()).gray_view(&ground(), pose)
}

pub fn image(number: u64) -> KeyframeImage {
    KeyframeImage { gray: gray(&pose(number)), color: None }
}

/// A new map of one session, with its first keyframes and the edges between them.
pub fn map_of(path: &Path, keyframes: u64) -> MapFile {
    let mut map = MapFile::create(path, &camera(), &Rig::level(0.5)).unwrap();
    let session = map.begin_session("drive.mp4").unwrap();
    for number in 0..keyframes {
        let edges = if number > 0 { vec![edge_to(number)] } else { vec![] };
        map.add_keyframe(&keyframe(number, session), &image(number), &edges).unwrap();
    }
    map
}

/// A colour image whose gray is in limited video range: 16 to 235 for black to white.
pub fn color_image() -> KeyframeImage {
    let (width, height) = (160, 120);
    let mut color = RgbImage::new(width, height);
    for (k, pixel) in color.samples_mut().chunks_exact_mut(3).enumerate() {
        let (x, y) = ((k % width) as f64, (k / width) as f64);
        let wave = |a: f64, b: f64| (128.0 + 90.0 * (x / a).sin() * (y / b).cos()) as u8;
        pixel.copy_from_slice(&[wave(23.0, 31.0), wave(40.0, 19.0), wave(35.0, 50.0)]);
    }
    let luma = |p: &[u8]| 0.299 * f64::from(p[0]) + 0.587 * f64::from(p[1]) + 0.114 * f64::from(p[2]);
    let gray =
        color.samples().chunks_exact(3).map(|p| (16.0 + luma(p) * 219.0 / 255.0 + 0.5) as u8).collect();
    KeyframeImage { gray: GrayImage::from_samples(width, height, gray).unwrap(), color: Some(color) }
}
