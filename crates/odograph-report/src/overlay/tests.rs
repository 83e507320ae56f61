#![allow(clippy::unwrap_used)] // a test fails by panicking

use super::*;
use odograph::camera::Distortion;

fn painter(size: (usize, usize)) -> OverlayPainter {
    let middle = (0.5 * size.0 as f64, 0.5 * size.1 as f64);
    OverlayPainter::new(&Camera::new(size, (500.0, 500.0), middle, Distortion::None).unwrap()).unwrap()
}

#[test]
fn the_video_is_wide_enough_for_letters_and_not_wider_than_a_screen() {
    assert_eq!(painter((640, 480)).size(), (640, 480));
    assert_eq!(painter((320, 240)).size(), (640, 480));
    assert_eq!(painter((1920, 1080)).size(), (960, 540));
    assert_eq!(painter((3840, 2160)).size(), (1280, 720));
    // A corner stays where it is in the image.
    assert_eq!(Zoom::of(320).place(Pixel::new(10.0, 0.0)), (20.5, 0.5));
    assert_eq!(Zoom::of(1920).place(Pixel::new(10.5, 0.5)), (5.0, 0.0));
}

#[test]
fn digits_have_one_width_and_every_word_of_a_reason_can_be_written() {
    let letters = Lettering::new(16).unwrap();
    assert_eq!(letters.width_px("111.1"), letters.width_px("888.8"));
    assert!(letters.width_px("speed") > letters.width_px("ill"));
    let mut canvas = Canvas::new(200, 30);
    letters.write(&mut canvas, (2, 2), "height −1.250 m", [255; 3]);
    let inked = canvas.image().samples().iter().filter(|sample| **sample > 128).count();
    assert!(inked > 300, "{inked}");
}

#[test]
fn angles_have_a_sign_and_zero_none_of_its_own() {
    assert_eq!([12.34, -0.01, -90.0].map(degrees), ["+12.3°", "+0.0°", "−90.0°"]);
}
