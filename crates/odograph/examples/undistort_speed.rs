//! Time to undistort whole images: `undistort_speed camera.yaml picture.ppm corrected.ppm
//! repetitions`.
//!
//! Input and output are binary PGM or PPM. Prints the time of each repetition in milliseconds, one
//! a line, on one thread. `bench/undistort.py` compares them with OpenCV's.

#![allow(clippy::print_stdout)] // prints times

use odograph::correction::{FieldOfViewKept, ImageCorrection};
use odograph::formats::camera_file;
use odograph::image::{GrayImage, RgbImage};
use std::error::Error;
use std::time::Instant;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [camera, picture, corrected, repetitions] = arguments.as_slice() else {
        return Err("undistort_speed camera.yaml picture.ppm corrected.ppm repetitions".into());
    };
    let bytes = std::fs::read(picture)?;
    // The header as OpenCV writes it: magic number, width, height and maximum, each followed by one
    // whitespace character.
    let mut fields = bytes.splitn(5, u8::is_ascii_whitespace);
    let mut field = || fields.next().ok_or("a short header");
    let kind = field()?.to_owned();
    let width: usize = std::str::from_utf8(field()?)?.parse()?;
    let height: usize = std::str::from_utf8(field()?)?.parse()?;
    field()?;
    let samples = field()?.to_owned();
    let camera = camera_file::parse(&std::fs::read_to_string(camera)?, Some((width, height)))?;
    let correction = ImageCorrection::new(&camera, FieldOfViewKept::SameFocalLength)?;
    let mut times_ms = Vec::new();
    let mut result = Vec::new();
    for _ in 0..repetitions.parse()? {
        if kind == b"P5" {
            let image = GrayImage::from_samples(width, height, samples.clone()).ok_or("a short picture")?;
            let mut into = GrayImage::new(width, height);
            let start = Instant::now();
            correction.apply_into(&image, &mut into)?;
            times_ms.push(start.elapsed().as_secs_f64() * 1e3);
            result = into.into_samples();
        } else {
            let image = RgbImage::from_samples(width, height, samples.clone()).ok_or("a short picture")?;
            let mut into = RgbImage::new(width, height);
            let start = Instant::now();
            correction.apply_rgb_into(&image, &mut into)?;
            times_ms.push(start.elapsed().as_secs_f64() * 1e3);
            result = into.samples().to_vec();
        }
    }
    let mut written = format!("{} {width} {height} 255\n", String::from_utf8_lossy(&kind)).into_bytes();
    written.extend(result);
    std::fs::write(corrected, written)?;
    times_ms.iter().for_each(|time_ms| println!("{time_ms}"));
    Ok(())
}
