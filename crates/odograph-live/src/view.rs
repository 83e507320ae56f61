//! The camera image in the form in which the page displays it.

use crate::hub::View;
use odograph::image::GrayImage;
use odograph::odometry::TrackView;
use odograph_video::jpeg_from_gray;

/// Images wider than this are displayed at half size: no page shows more detail, and encoding would
/// take time from the tracking.
const WIDEST_PX: usize = 960;
/// JPEG quality (1 to 100): higher shows more detail and takes more of the network.
const QUALITY: u8 = 72;

impl View {
    /// Encodes the image of a record with its tracks. `None` if the image exceeds the size limits
    /// of JPEG.
    pub fn new(record: usize, gray: &GrayImage, tracks: &[TrackView]) -> Option<Self> {
        let (jpeg, _) = encode(gray)?;
        let quarter = |pixels: f64| (4.0 * pixels).clamp(-32_768.0, 32_767.0) as i16;
        let track = |track: &TrackView| {
            let (at, corner) = (track.pixel, track.corner);
            [quarter(at.x), quarter(at.y), quarter(corner.x), quarter(corner.y), i16::from(track.inlier)]
        };
        // The message format stores the number of tracks in two bytes.
        let tracks = tracks.iter().take(usize::from(u16::MAX)).map(track).collect();
        Some(Self { record, jpeg, tracks })
    }
}

/// Encodes an image as JPEG, and returns its scale relative to the input: 1 or 0.5. `None` if the
/// image exceeds the size limits of JPEG.
pub(crate) fn encode(gray: &GrayImage) -> Option<(Vec<u8>, f64)> {
    let halved;
    let (shown, scale) = if gray.width() > WIDEST_PX {
        halved = half(gray)?;
        (&halved, 0.5)
    } else {
        (gray, 1.0)
    };
    Some((jpeg_from_gray(shown, QUALITY).ok()?, scale))
}

/// Downsamples by two with a 2×2 box filter.
fn half(gray: &GrayImage) -> Option<GrayImage> {
    let (width, height) = (gray.width() / 2, gray.height() / 2);
    let mut samples = Vec::with_capacity(width * height);
    for y in 0..height {
        let (above, below) = (gray.row(2 * y), gray.row(2 * y + 1));
        samples.extend(above.chunks_exact(2).zip(below.chunks_exact(2)).map(|(a, b)| {
            ((u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]) + 2) / 4) as u8
        }));
    }
    GrayImage::from_samples(width, height, samples)
}
