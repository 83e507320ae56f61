//! Decompression of chunks, messages and files, bounded in size.

use crate::guard::guarded;
use odograph::error::{Error, Result};
use std::io::{self, BufRead, Read, Write};

/// Magic number of a Zstandard frame.
pub(crate) const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

/// Compression of a part of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Compression {
    None,
    Zstd,
    Lz4,
    Bzip2,
}

impl Compression {
    /// From the name in an MCAP chunk or in a chunk of a ROS 1 bag.
    pub fn named(name: &str) -> Result<Self> {
        match name {
            "" | "none" => Ok(Self::None),
            "zstd" => Ok(Self::Zstd),
            "lz4" => Ok(Self::Lz4),
            "bz2" => Ok(Self::Bzip2),
            other => Err(Error::input(format!(
                "its chunks are compressed with {other:?}, which is not known; zstd, lz4 and bz2 are"
            ))),
        }
    }

    /// Decompresses into `out` up to `most` bytes. False if the data is damaged or cut off; what
    /// could be decompressed before that is in `out`.
    pub fn decompress(self, bytes: &[u8], most: u64, out: &mut Vec<u8>) -> bool {
        out.clear();
        let outcome = guarded("chunk", || match self {
            Self::None => bytes.take(most).read_to_end(out).map(|_| ()),
            Self::Zstd => {
                let mut decoder = ruzstd::decoding::StreamingDecoder::new(bytes).map_err(io::Error::other)?;
                decoder.by_ref().take(most).read_to_end(out).map(|_| ())
            }
            Self::Lz4 => lz4_flex::frame::FrameDecoder::new(bytes).take(most).read_to_end(out).map(|_| ()),
            Self::Bzip2 => bzip2::read::BzDecoder::new(bytes).take(most).read_to_end(out).map(|_| ()),
        });
        matches!(outcome, Ok(Ok(())))
    }
}

/// Decompresses all Zstandard frames of a file into another one of at most `most` bytes.
///
/// Fails if there are more bytes, or the output cannot be written. False if the data is damaged or
/// cut off; what could be decompressed before that has been written.
pub(super) fn unpack_zstd(
    mut from: impl BufRead,
    most: u64,
    to: &mut impl Write,
    failed: impl Fn(io::Error) -> Error,
) -> Result<bool> {
    let mut block = vec![0; 1 << 18];
    let mut written = 0;
    loop {
        match from.fill_buf() {
            Ok([]) => return Ok(true),
            Ok(_) => {}
            Err(_) => return Ok(false),
        }
        let Ok(Ok(mut decoder)) = guarded("file", || ruzstd::decoding::StreamingDecoder::new(&mut from))
        else {
            return Ok(false);
        };
        loop {
            let read = match guarded("file", || decoder.read(&mut block)) {
                Ok(Ok(0)) => break,
                Ok(Ok(read)) => read,
                _ => return Ok(false),
            };
            written += read as u64;
            if written > most {
                return Err(Error::input(format!(
                    "the file unpacks to more than {} GB; unpack it with zstd -d",
                    most >> 30
                )));
            }
            to.write_all(&block[..read]).map_err(&failed)?;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_that_is_not_compressed_is_an_error() {
        let mut out = Vec::new();
        for compression in [Compression::Zstd, Compression::Lz4, Compression::Bzip2] {
            assert!(!compression.decompress(b"no compressed data", 100, &mut out));
            assert!(out.is_empty());
        }
        assert!(Compression::None.decompress(b"plain", 3, &mut out));
        assert_eq!(out, b"pla");
        assert!(Compression::named("zip").is_err());
        let failed = |error| Error::not_written("out", error);
        assert!(!unpack_zstd(&b"no compressed data"[..], 100, &mut out, failed).unwrap());
    }
}
