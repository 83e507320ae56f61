//! H.264 compression of clips.

use crate::clip::Clip;
use odograph::error::{Error, Result};
use odograph_video::SourceOptions;
use rusty_h264::{Encoder, EncoderConfig, YuvFrame};
use std::io::Write;

/// Replaces the frames by their lossy versions: encoded with a constant quantiser, and decoded by
/// `odograph-video`.
pub fn compress(clip: &mut Clip, qp: u8) -> Result<()> {
    let (width, height) = (clip.camera.width(), clip.camera.height());
    // The baseline profile has no B-frames, as in most cameras.
    let config = EncoderConfig { qp, gop_size: 60, ..EncoderConfig::baseline(width, height) };
    let failed = |error: &dyn std::fmt::Debug| Error::output(format!("H.264 cannot be encoded: {error:?}"));
    let mut encoder = Encoder::new(config).map_err(|error| failed(&error))?;
    let mut file = tempfile::Builder::new().suffix(".h264").tempfile().map_err(|error| failed(&error))?;
    let gray = vec![128; width / 2 * (height / 2)];
    for (_, image) in &clip.frames {
        let (y, u, v) = (image.samples().to_vec(), gray.clone(), gray.clone());
        let unit = encoder.encode(&YuvFrame { width, height, y, u, v });
        file.write_all(&unit).map_err(|error| failed(&error))?;
    }
    file.write_all(&encoder.flush()).map_err(|error| failed(&error))?;
    let options = SourceOptions { fps: Some(clip.fps), ..SourceOptions::default() };
    let mut source = odograph_video::open(file.path(), &options)?;
    let mut decoded = 0;
    while let Some(frame) = source.next_frame()? {
        if let Some((_, image)) = clip.frames.get_mut(decoded) {
            *image = frame.gray;
        }
        decoded += 1;
    }
    if decoded != clip.frames.len() {
        let encoded = clip.frames.len();
        return Err(Error::input(format!("{encoded} frames were encoded and {decoded} decoded")));
    }
    Ok(())
}
