//! Recordings of a calibration board, rendered by the test.

use nalgebra::{Isometry3, Point3, Vector3};
use odograph::camera::{Camera, Distortion};
use odograph::geometry::{Pixel, Ray};
use odograph::image::GrayImage;
use odograph_calibration::Board;
use odograph_simulation::{BoardEffects, BoardScene, Framing};
use std::fs;
use std::path::Path;

pub const BOARD: &str = "chessboard:7x5:30mm";

/// The camera: 320x240, mild barrel distortion.
pub fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.15, 0.03, 0.0, 0.0]).unwrap();
    Camera::new((320, 240), (300.0, 300.0), (162.0, 118.0), distortion).unwrap()
}

pub fn scene() -> BoardScene {
    scene_of(BOARD, &camera())
}

pub fn scene_of(board: &str, camera: &Camera) -> BoardScene {
    let board: Board = board.parse().unwrap();
    BoardScene::new(&board, camera, 5)
}

/// Images of the board from `count` poses.
pub fn pictures(scene: &BoardScene, count: usize) -> Vec<GrayImage> {
    scene.poses(count, Framing::Whole, 3).iter().map(|pose| picture(scene, pose)).collect()
}

pub fn picture(scene: &BoardScene, camera_from_board: &Isometry3<f64>) -> GrayImage {
    scene.render(camera_from_board, &BoardEffects::default())
}

/// The board bent towards the camera by so much at 9 cm from its left end: each pixel is the one
/// that the flat board has where the bent one has this point.
pub fn bent(scene: &BoardScene, camera: &Camera, pose: &Isometry3<f64>, depth_m: f64) -> GrayImage {
    let flat = picture(scene, pose);
    let (width, height) = (flat.width(), flat.height());
    let board_from_camera = pose.inverse();
    let origin = board_from_camera * Point3::origin();
    let sample = |pixel: Pixel| {
        let (x, y) = (pixel.x.clamp(0.0, width as f64 - 2.0), pixel.y.clamp(0.0, height as f64 - 2.0));
        let (i, j, s, t) = (x as usize, y as usize, x.fract(), y.fract());
        let at = |i: usize, j: usize| f64::from(flat.row(j)[i]);
        let above = (1.0 - s) * at(i, j) + s * at(i + 1, j);
        let below = (1.0 - s) * at(i, j + 1) + s * at(i + 1, j + 1);
        ((1.0 - t) * above + t * below).round() as u8
    };
    let bent = |x: usize, y: usize| {
        let ray = camera.ray_from_pixel(Pixel::new(x as f64, y as f64)).unwrap();
        let along = board_from_camera * Vector3::new(ray.x, ray.y, 1.0);
        let (mut place, mut z_m) = (origin, 0.0);
        for _ in 0..8 {
            place = origin + along * ((z_m - origin.z) / along.z);
            z_m = -depth_m * (place.x / 0.09).powi(2);
        }
        let seen = pose * Point3::new(place.x, place.y, 0.0);
        camera.pixel_from_ray(Ray::new(seen.x / seen.z, seen.y / seen.z)).map_or(128, sample)
    };
    let samples =
        (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| bent(x, y)).collect();
    GrayImage::from_samples(width, height, samples).unwrap()
}

/// A gray stream at 30 Hz.
pub fn y4m(frames: &[GrayImage]) -> Vec<u8> {
    let (width, height) = frames.first().map_or((320, 240), |frame| (frame.width(), frame.height()));
    let mut stream =
        format!("YUV4MPEG2 W{width} H{height} F30:1 Ip A1:1 Cmono XCOLORRANGE=FULL\n").into_bytes();
    for frame in frames {
        stream.extend_from_slice(b"FRAME\n");
        stream.extend(frame.samples());
    }
    stream
}

/// Repeats each image for some frames, like a person who holds the board still in each position.
pub fn held(pictures: &[GrayImage], frames: usize) -> Vec<GrayImage> {
    pictures.iter().flat_map(|picture| std::iter::repeat_n(picture.clone(), frames)).collect()
}

pub fn write_png(path: &Path, image: &GrayImage) {
    let file = fs::File::create(path).unwrap();
    let mut encoder = png::Encoder::new(file, image.width() as u32, image.height() as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header().unwrap().write_image_data(image.samples()).unwrap();
}

/// Writes a folder of numbered images.
pub fn folder(path: &Path, pictures: &[GrayImage]) {
    fs::create_dir(path).unwrap();
    for (number, picture) in pictures.iter().enumerate() {
        write_png(&path.join(format!("board{number:02}.png")), picture);
    }
}

pub fn mirrored(image: &GrayImage) -> GrayImage {
    let mut mirrored = image.clone();
    mirrored.samples_mut().chunks_exact_mut(image.width()).for_each(<[u8]>::reverse);
    mirrored
}
