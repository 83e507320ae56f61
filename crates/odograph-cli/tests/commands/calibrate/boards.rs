//! Recordings of a calibration board, rendered by the test.

use nalgebra::Isometry3;
use odograph::camera::{Camera, Distortion};
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
