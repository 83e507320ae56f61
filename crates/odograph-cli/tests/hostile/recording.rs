//! Small recordings of a floor that slides by, made in the test.

use std::fs;
use std::path::Path;

/// A pinhole for frames of 320x240.
pub const CAMERA: &str = "%YAML:1.0\n---\nimage_width: 320\nimage_height: 240\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   \
data: [ 300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0 ]\n\
distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ 0.0, 0.0, 0.0, 0.0, 0.0 ]\n";

const WIDTH: usize = 320;
const HEIGHT: usize = 240;

/// A pixel of the floor: spots of several sizes, a number for each place.
fn floor(x: usize, y: usize) -> u8 {
    let mut level = 0.0;
    for (size, weight) in [(4, 90.0), (11, 90.0), (29, 60.0)] {
        let corner = |i: usize, j: usize| {
            let mut h =
                (i as u32).wrapping_mul(0x9e37_79b1) ^ (j as u32).wrapping_mul(0x85eb_ca77) ^ size as u32;
            h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
            h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
            f64::from(h >> 16) / 65_535.0
        };
        let (i, j) = (x / size, y / size);
        let (u, v) = ((x % size) as f64 / size as f64, (y % size) as f64 / size as f64);
        let upper = corner(i, j) * (1.0 - u) + corner(i + 1, j) * u;
        let lower = corner(i, j + 1) * (1.0 - u) + corner(i + 1, j + 1) * u;
        level += weight * (upper * (1.0 - v) + lower * v);
    }
    level as u8
}

/// What the camera sees at a frame: four pixels further each time.
fn view(number: usize) -> Vec<u8> {
    let place = |at: usize| floor(at % WIDTH + 4 * number, at / WIDTH + 1000);
    (0..WIDTH * HEIGHT).map(place).collect()
}

/// A gray stream of so many frames at 30 Hz.
pub fn y4m(frames: usize) -> Vec<u8> {
    let mut stream = b"YUV4MPEG2 W320 H240 F30:1 Ip A1:1 Cmono XCOLORRANGE=FULL\n".to_vec();
    for number in 0..frames {
        stream.extend_from_slice(b"FRAME\n");
        stream.extend(view(number));
    }
    stream
}

/// A picture to be written as PNG.
pub struct Picture {
    color: png::ColorType,
    depth: png::BitDepth,
    rows: usize,
    samples: Vec<u8>,
}

impl Picture {
    fn new(
        color: png::ColorType,
        depth: png::BitDepth,
        number: usize,
        pixel: impl Fn(u8) -> Vec<u8>,
    ) -> Self {
        let samples = view(number).into_iter().flat_map(pixel).collect();
        Self { color, depth, rows: HEIGHT, samples }
    }

    pub fn gray8(number: usize) -> Self {
        Self::new(png::ColorType::Grayscale, png::BitDepth::Eight, number, |level| vec![level])
    }

    pub fn gray16(number: usize) -> Self {
        Self::new(png::ColorType::Grayscale, png::BitDepth::Sixteen, number, |level| vec![level, level])
    }

    pub fn gray_alpha(number: usize) -> Self {
        Self::new(png::ColorType::GrayscaleAlpha, png::BitDepth::Eight, number, |level| vec![level, 255])
    }

    pub fn rgba16(number: usize) -> Self {
        let pixel = |level| vec![level, level, level, level, level, level, 255, 255];
        Self::new(png::ColorType::Rgba, png::BitDepth::Sixteen, number, pixel)
    }

    pub fn without_last_rows(mut self, rows: usize) -> Self {
        let row = self.samples.len() / self.rows;
        self.rows -= rows;
        self.samples.truncate(self.rows * row);
        self
    }

    fn write(&self, path: &Path) {
        let file = fs::File::create(path).unwrap();
        let mut encoder = png::Encoder::new(file, WIDTH as u32, self.rows as u32);
        encoder.set_color(self.color);
        encoder.set_depth(self.depth);
        encoder.write_header().unwrap().write_image_data(&self.samples).unwrap();
    }
}

/// A folder of numbered pictures.
pub fn picture_folder(folder: &Path, pictures: usize, picture: impl Fn(usize) -> Picture) {
    fs::create_dir(folder).unwrap();
    for number in 0..pictures {
        picture(number).write(&folder.join(format!("{number:06}.png")));
    }
}

/// The names in a folder, in order.
pub fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}
