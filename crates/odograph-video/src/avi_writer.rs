//! Writes an AVI file of JPEG pictures (Microsoft, "AVI RIFF File Reference": one video stream,
//! `00dc` chunks, `idx1` index).

use std::io::{self, Seek, SeekFrom, Write};

/// RIFF counts bytes in 32 bits; not all readers accept more than half of that.
const MAX_BYTES: u64 = 0x7FFF_0000;
/// Flag of an index entry: this picture can be shown without others.
const KEYFRAME: u32 = 0x10;

/// Writes a Motion JPEG video, picture after picture; [`AviWriter::finish`] completes the file.
#[derive(Debug)]
pub struct AviWriter<W> {
    file: W,
    index: Vec<u8>,
    /// Bytes in the list of pictures after its name.
    movie_bytes: u64,
    largest: u32,
}

/// Size and timing of a Motion JPEG video.
#[derive(Debug, Clone, Copy)]
pub struct AviFormat {
    /// Width and height, pixels.
    pub size: (usize, usize),
    /// Frames per second, as a fraction.
    pub fps: (u64, u64),
    /// Number of pictures.
    pub frames: usize,
    /// Bits a pixel: 24 in colour, 8 in gray.
    pub bits: u16,
}

impl<W: Write + Seek> AviWriter<W> {
    /// Begins a file. The frame rate and number of `format` may be provisional.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn new(mut file: W, format: AviFormat) -> io::Result<Self> {
        file.write_all(&header(format, 0, 0))?;
        Ok(Self { file, index: vec![], movie_bytes: 0, largest: 0 })
    }

    /// Whether a picture would make the file larger than readers accept.
    pub fn is_full_for(&self, jpeg: &[u8]) -> bool {
        self.movie_bytes + padded_bytes(jpeg) + self.index.len() as u64 > MAX_BYTES
    }

    /// Adds a picture; [`AviWriter::is_full_for`] it must be false.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn add(&mut self, jpeg: &[u8]) -> io::Result<()> {
        if self.is_full_for(jpeg) {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        let size = jpeg.len() as u32;
        // Offsets count from the name of the list, four bytes before its first chunk.
        let offset = self.movie_bytes as u32 + 4;
        self.index.extend_from_slice(b"00dc");
        for number in [KEYFRAME, offset, size] {
            self.index.extend_from_slice(&number.to_le_bytes());
        }
        self.movie_bytes += padded_bytes(jpeg);
        self.largest = self.largest.max(size);
        let padding: &[u8] = if size % 2 == 1 { &[0] } else { &[] };
        [b"00dc".as_slice(), &size.to_le_bytes(), jpeg, padding]
            .into_iter()
            .try_for_each(|part| self.file.write_all(part))
    }

    /// Writes the index, and the header with the final `format` and the sizes.
    ///
    /// # Errors
    /// If they cannot be written.
    pub fn finish(mut self, format: AviFormat) -> io::Result<W> {
        self.file.write_all(b"idx1")?;
        self.file.write_all(&(self.index.len() as u32).to_le_bytes())?;
        self.file.write_all(&self.index)?;
        let after_header = self.movie_bytes as u32 + 8 + self.index.len() as u32;
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(&header(format, after_header, self.largest))?;
        // The size of the list of pictures lies at the end of the header, before its name.
        self.file.seek(SeekFrom::Start(HEADER_BYTES - 8))?;
        self.file.write_all(&(self.movie_bytes as u32 + 4).to_le_bytes())?;
        self.file.seek(SeekFrom::End(0))?;
        self.file.flush()?;
        Ok(self.file)
    }
}

/// Bytes of a picture with its name, its size and its padding.
fn padded_bytes(jpeg: &[u8]) -> u64 {
    jpeg.len() as u64 + jpeg.len() as u64 % 2 + 8
}

/// Bytes before the first picture.
const HEADER_BYTES: u64 = 224;

/// Everything before the first picture; `after_header` bytes follow it.
fn header(format: AviFormat, after_header: u32, largest: u32) -> Vec<u8> {
    let (width, height) = (format.size.0 as u32, format.size.1 as u32);
    let (rate, scale) = (format.fps.0 as u32, format.fps.1 as u32);
    let frames = format.frames as u32;
    let microseconds = (1e6 * f64::from(scale) / f64::from(rate)).round() as u32;
    let mut main = vec![];
    // Microseconds a frame, bytes a second, padding, flags (has an index), frames, initial,
    // streams, buffer, size, reserved.
    let numbers = [microseconds, 0, 0, 0x10, frames, 0, 1, largest, width, height, 0, 0, 0, 0];
    numbers.iter().for_each(|n: &u32| main.extend_from_slice(&n.to_le_bytes()));
    let mut stream = b"vidsMJPG".to_vec();
    // Flags, priority and language, initial, scale, rate, start, length, buffer, quality (default),
    // sample size.
    let numbers = [0, 0, 0, scale, rate, 0, frames, largest, u32::MAX, 0];
    numbers.iter().for_each(|n: &u32| stream.extend_from_slice(&n.to_le_bytes()));
    [0, 0, width as u16, height as u16].iter().for_each(|n| stream.extend_from_slice(&n.to_le_bytes()));
    let mut picture = vec![];
    [40, width, height].iter().for_each(|n: &u32| picture.extend_from_slice(&n.to_le_bytes()));
    [1, format.bits].iter().for_each(|n: &u16| picture.extend_from_slice(&n.to_le_bytes()));
    picture.extend_from_slice(b"MJPG");
    [width * height * 3, 0, 0, 0, 0].iter().for_each(|n: &u32| picture.extend_from_slice(&n.to_le_bytes()));

    let streams = list(b"strl", &[chunk(b"strh", &stream), chunk(b"strf", &picture)].concat());
    let headers = list(b"hdrl", &[chunk(b"avih", &main), streams].concat());
    let mut bytes = b"RIFF".to_vec();
    // The name of the file's form, the headers, and the twelve bytes before the first picture.
    bytes.extend_from_slice(&(4 + headers.len() as u32 + 12 + after_header).to_le_bytes());
    bytes.extend_from_slice(b"AVI ");
    bytes.extend_from_slice(&headers);
    bytes.extend_from_slice(b"LIST\0\0\0\0movi");
    bytes
}

fn chunk(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
    [name.as_slice(), &(content.len() as u32).to_le_bytes(), content].concat()
}

fn list(name: &[u8; 4], content: &[u8]) -> Vec<u8> {
    chunk(b"LIST", &[name.as_slice(), content].concat())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use std::io::Cursor;

    #[test]
    fn every_index_entry_points_to_its_picture() {
        let format = AviFormat { size: (64, 48), fps: (30, 1), frames: 3, bits: 24 };
        let mut writer = AviWriter::new(Cursor::new(vec![]), format).unwrap();
        let pictures = [vec![1u8; 10], vec![2u8; 11], vec![3u8; 12]];
        pictures.iter().for_each(|picture| writer.add(picture).unwrap());
        let bytes = writer.finish(format).unwrap().into_inner();
        let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!(header(format, 0, 0).len() as u64, HEADER_BYTES);
        assert_eq!(number(4), bytes.len() - 8);
        let movie = HEADER_BYTES as usize - 4;
        assert_eq!(&bytes[movie..movie + 4], b"movi");
        let index = movie + number(movie - 4);
        assert_eq!(&bytes[index..index + 4], b"idx1");
        assert_eq!(number(index + 4), 3 * 16);
        for (i, picture) in pictures.iter().enumerate() {
            let entry = index + 8 + 16 * i;
            let (offset, size) = (number(entry + 8), number(entry + 12));
            assert_eq!(&bytes[movie + offset..movie + offset + 4], b"00dc");
            assert_eq!(&bytes[movie + offset + 8..][..size], picture.as_slice());
        }
    }
}
