//! Whether a stated field of view makes the pixels square.

/// Ratio of a pixel's sides up to which they are taken for square: a tape measure at a slanted edge
/// of the view is wrong by a few per cent.
const SQUARE_WITHIN: f64 = 1.15;

/// What is doubtful about a field of view of this width and height, metres, of frames of this size,
/// pixels; `None` where it makes the pixels about square, as those of nearly all cameras are.
pub fn doubt(size: (usize, usize), field_m: (f64, f64)) -> Option<String> {
    let high = |field_m: (f64, f64)| (field_m.1 / size.1 as f64) / (field_m.0 / size.0 as f64);
    let is_square = |high: f64| high.max(1.0 / high) <= SQUARE_WITHIN;
    let ratio = high(field_m);
    if is_square(ratio) {
        return None;
    }
    let shape = match ratio > 1.0 {
        true => format!("{ratio:.2} times as high as wide"),
        false => format!("{:.2} times as wide as high", 1.0 / ratio),
    };
    let (width_m, height_m) = field_m;
    let what_to_do = match is_square(high((height_m, width_m))) {
        true => format!("width and height are probably exchanged: {height_m}x{width_m} makes them square"),
        false => "measure width and height of the whole image on the ground again".to_owned(),
    };
    Some(format!(
        "by the field of view {width_m}x{height_m} m the pixels of {}x{} are {shape}, and those of nearly all cameras \
         are square; {what_to_do}",
        size.0, size.1
    ))
}

#[cfg(test)]
mod tests {
    use super::doubt;

    #[test]
    fn pixels_that_are_not_square_are_questioned() {
        assert_eq!(doubt((640, 480), (0.96, 0.72)), None);
        assert_eq!(doubt((640, 480), (1.0, 0.70)), None);
        let exchanged = doubt((640, 480), (0.72, 0.96)).unwrap();
        for part in ["1.78 times as high as wide", "probably exchanged: 0.96x0.72 makes them square"] {
            assert!(exchanged.contains(part), "{exchanged}");
        }
        let wide = doubt((640, 480), (1.2, 0.6)).unwrap();
        assert!(wide.contains("1.50 times as wide as high") && wide.contains("measure"), "{wide}");
    }
}
