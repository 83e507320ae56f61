//! Images of frames that are not keyframes, stored for the duration of a run in an unnamed
//! temporary file, which the operating system deletes when the program ends.

use crate::image::{self, StoredImage};
use odograph::error::{Error, Result};
use odograph::ground_map::KeyframeImage;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// On-disk store of images by frame index, encoded like the keyframe images of a map.
#[derive(Debug)]
pub struct FrameImages {
    folder: PathBuf,
    size: (usize, usize),
    /// Created with the first image.
    file: Option<File>,
    end: u64,
    kept: BTreeMap<u64, StoredFrame>,
}

/// Position and parameters of an image in the file.
#[derive(Debug)]
struct StoredFrame {
    start: u64,
    bytes: usize,
    colored: bool,
    luma_scale: f64,
    luma_offset: f64,
}

impl FrameImages {
    /// An empty store for images of this width and height, on the file system of `folder`. The file
    /// is created with the first image.
    pub fn new(folder: &Path, size: (usize, usize)) -> Self {
        Self { folder: folder.to_owned(), size, file: None, end: 0, kept: BTreeMap::new() }
    }

    /// Stores the image of a frame. Fails if it cannot be written or exceeds the maximum size of a
    /// JPEG.
    pub fn keep(&mut self, frame: u64, image: &KeyframeImage) -> Result<()> {
        let StoredImage { colored, luma_scale, luma_offset, jpeg } = image::encode(image)?;
        self.write(&jpeg).map_err(|error| self.failed("written", &error))?;
        let kept = StoredFrame { start: self.end, bytes: jpeg.len(), colored, luma_scale, luma_offset };
        self.end += jpeg.len() as u64;
        self.kept.insert(frame, kept);
        Ok(())
    }

    /// Indices of the frames with an image, in order.
    pub fn frames(&self) -> impl Iterator<Item = u64> {
        self.kept.keys().copied()
    }

    /// Reads the image of a frame. Fails if there is none or it cannot be read.
    pub fn load(&mut self, frame: u64) -> Result<KeyframeImage> {
        let none = || Error::usage(format!("no image was kept of frame {frame}"));
        let (kept, file) = self.kept.get(&frame).zip(self.file.as_mut()).ok_or_else(none)?;
        let mut jpeg = vec![0; kept.bytes];
        let read = file.seek(SeekFrom::Start(kept.start)).and_then(|_| file.read_exact(&mut jpeg));
        let stored = StoredImage {
            colored: kept.colored,
            luma_scale: kept.luma_scale,
            luma_offset: kept.luma_offset,
            jpeg,
        };
        read.map_err(|error| self.failed("read back", &error))?;
        stored.decode(self.size).map_err(|why| Error::output(format!("the image of frame {frame} {why}")))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile_in(&self.folder)?),
        };
        file.seek(SeekFrom::Start(self.end))?;
        file.write_all(bytes)
    }

    fn failed(&self, what: &str, error: &io::Error) -> Error {
        Error::output(format!("images for the mosaic cannot be {what} in {}: {error}", self.folder.display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::image::GrayImage;

    #[test]
    fn images_are_read_back_by_frame_index() {
        let folder = tempfile::tempdir().unwrap();
        let shade = |number: u8| {
            let gray = GrayImage::from_samples(40, 24, vec![20 * number; 960]).unwrap();
            KeyframeImage { gray, color: None }
        };
        let mut images = FrameImages::new(folder.path(), (40, 24));
        assert!(images.load(3).is_err());
        for number in [3, 1, 7] {
            images.keep(number, &shade(number as u8)).unwrap();
        }
        assert_eq!(images.frames().collect::<Vec<_>>(), [1, 3, 7]);
        for number in [7, 3, 1] {
            // A uniform image is unchanged by JPEG compression.
            assert_eq!(images.load(number).unwrap(), shade(number as u8));
        }
        assert!(images.load(2).is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
