//! Images of frames that are no keyframes, for as long as a run lasts: in a file without a name, which goes with the program however that ends.

use crate::image::{self, StoredImage};
use odograph::error::{Error, Result};
use odograph::mapping::KeyframeImage;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Images by the numbers of their frames, encoded as a map encodes those of its keyframes, on disk.
#[derive(Debug)]
pub struct FrameImages {
    folder: PathBuf,
    size: (usize, usize),
    /// Made with the first image.
    file: Option<File>,
    end: u64,
    kept: BTreeMap<u64, Kept>,
}

/// Where an image is in the file, and what is to be known besides.
#[derive(Debug)]
struct Kept {
    start: u64,
    bytes: usize,
    colored: bool,
    luma_scale: f64,
    luma_offset: f64,
}

impl FrameImages {
    /// A place for images of this width and height, on the disk that has `folder`. Nothing is written yet.
    pub fn new(folder: &Path, size: (usize, usize)) -> Self {
        Self { folder: folder.to_owned(), size, file: None, end: 0, kept: BTreeMap::new() }
    }

    /// Keeps the image of a frame. Fails where it cannot be written or is larger than a JPEG can be.
    pub fn keep(&mut self, frame: u64, image: &KeyframeImage) -> Result<()> {
        let StoredImage { colored, luma_scale, luma_offset, jpeg } = image::encode(image)?;
        self.write(&jpeg).map_err(|error| self.failed("written", &error))?;
        let kept = Kept { start: self.end, bytes: jpeg.len(), colored, luma_scale, luma_offset };
        self.end += jpeg.len() as u64;
        self.kept.insert(frame, kept);
        Ok(())
    }

    /// The frames of which there are images, in order.
    pub fn frames(&self) -> impl Iterator<Item = u64> {
        self.kept.keys().copied()
    }

    /// The image of a frame. Fails where there is none, or where it cannot be read back.
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
        image::decode(&stored, self.size)
            .map_err(|why| Error::output(format!("the image of frame {frame} {why}")))
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
    fn images_come_back_by_the_numbers_of_their_frames() {
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
            // A plain shade survives a JPEG exactly.
            assert_eq!(images.load(number).unwrap(), shade(number as u8));
        }
        assert!(images.load(2).is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
