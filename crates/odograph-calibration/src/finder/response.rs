//! Chessboard corner detector: the ChESS response.
//!
//! S. Bennett and J. Lasenby, "ChESS – quick and robust detection of chess-board features", 2014,
//! equations 1 to 4: sixteen samples on a circle of radius 5. At a chessboard corner, opposite
//! samples are similar and samples a quarter turn apart differ. On an edge, opposite samples
//! differ. On a stripe, the mean of the circle differs from the mean at its centre.

use odograph::image::GrayImage;

/// Radius of the sampling circle, pixels. Pixels closer to the image border are skipped.
pub(super) const RADIUS: usize = 5;

/// A local maximum of the response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ResponsePeak {
    pub x: u32,
    pub y: u32,
    pub response: i16,
}

/// Minimum response; about that of a corner with a contrast of a dozen gray levels.
const MIN_RESPONSE: i16 = 60;
/// Radius of the square window for non-maximum suppression, pixels.
const APART: usize = 3;

/// The strongest local maxima, at most `most`, in descending order.
pub(super) fn peaks(image: &GrayImage, most: usize) -> Vec<ResponsePeak> {
    let (width, height) = (image.width(), image.height());
    if width <= 2 * (RADIUS + APART) || height <= 2 * (RADIUS + APART) {
        return Vec::new();
    }
    let mut responses = vec![0i16; width * height];
    for y in RADIUS..height - RADIUS {
        respond(image, y, &mut responses[y * width + RADIUS..(y + 1) * width - RADIUS]);
    }
    let mut peaks = Vec::new();
    for y in RADIUS..height - RADIUS {
        let row = &responses[y * width..(y + 1) * width];
        for x in RADIUS..width - RADIUS {
            let response = row[x];
            if response < MIN_RESPONSE || response < row[x - 1] || response <= row[x + 1] {
                continue;
            }
            // The first one in reading order wins ties.
            let largest = (y - APART..=y + APART).all(|v| {
                let others = &responses[v * width + x - APART..=v * width + x + APART];
                others.iter().enumerate().all(|(i, &other)| {
                    let before = (v, i) < (y, APART);
                    other < response || (other == response && !before)
                })
            });
            if largest {
                peaks.push(ResponsePeak { x: x as u32, y: y as u32, response });
            }
        }
    }
    // Ties are broken by position, so that the result does not depend on the sorting algorithm.
    let order = |peak: &ResponsePeak| (std::cmp::Reverse(peak.response), peak.y, peak.x);
    if peaks.len() > most {
        peaks.select_nth_unstable_by_key(most, order);
        peaks.truncate(most);
    }
    peaks.sort_unstable_by_key(order);
    peaks
}

/// The responses of one row from column [`RADIUS`] on. Written so that the compiler vectorises it.
fn respond(image: &GrayImage, y: usize, out: &mut [i16]) {
    let count = out.len();
    let from = |dx: isize, dy: isize| -> &[u8] {
        let row = image.row((y as isize + dy) as usize);
        &row[(RADIUS as isize + dx) as usize..][..count]
    };
    // Clockwise, starting at the right.
    let (r0, r1, r2, r3) = (from(5, 0), from(5, 2), from(4, 4), from(2, 5));
    let (r4, r5, r6, r7) = (from(0, 5), from(-2, 5), from(-4, 4), from(-5, 2));
    let (r8, r9, r10, r11) = (from(-5, 0), from(-5, -2), from(-4, -4), from(-2, -5));
    let (r12, r13, r14, r15) = (from(0, -5), from(2, -5), from(4, -4), from(5, -2));
    let (c, w, e, n, s) = (from(0, 0), from(-1, 0), from(1, 0), from(0, -1), from(0, 1));
    for i in 0..count {
        let at = |samples: &[u8]| i16::from(samples[i]);
        let mut sums = 0;
        let mut differences = 0;
        let mut total = 0;
        let mut quarter = |a: &[u8], b: &[u8], c: &[u8], d: &[u8]| {
            let (a, b, c, d) = (at(a), at(b), at(c), at(d));
            sums += (a + c - b - d).abs();
            differences += (a - c).abs() + (b - d).abs();
            total += a + b + c + d;
        };
        quarter(r0, r4, r8, r12);
        quarter(r1, r5, r9, r13);
        quarter(r2, r6, r10, r14);
        quarter(r3, r7, r11, r15);
        let middle = 4 * at(c) + 3 * (at(w) + at(e) + at(n) + at(s));
        out[i] = sums - differences - (total - middle).abs();
    }
}
