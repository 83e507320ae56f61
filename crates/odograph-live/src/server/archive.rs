//! The files of a run as one ZIP archive (PKWARE, "APPNOTE.TXT", version 6.3.10, section 4.3),
//! written while it is sent. Nothing is compressed: pictures and map are already.

use super::http::safe_in_header;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// Larger archives need the 64-bit extension, which not every program reads.
const MAX_BYTES: u64 = u32::MAX as u64;
/// Name in UTF-8 (section 4.4.4).
const FLAGS: u16 = 1 << 11;
/// The first of January 1980: no file of this program contains a date.
const DATE: u16 = 0x21;
const VERSION: u16 = 20;
const LOCAL_HEADER: u64 = 30;
const CENTRAL_HEADER: u64 = 46;
const END: u64 = 22;

/// An archive of files that do not change any more.
pub struct Archive {
    name: String,
    entries: Vec<Entry>,
}

struct Entry {
    name: String,
    path: PathBuf,
    bytes: u32,
}

impl Archive {
    /// Of the files with these names in a folder, as far as they exist. `None` without any, or if
    /// they are 4 GiB or more.
    pub fn of(folder: &Path, names: &[String]) -> Option<Self> {
        let entry = |name: &String| {
            let path = folder.join(name);
            let file = path.metadata().ok().filter(|file| file.is_file())?;
            Some(u32::try_from(file.len()).ok().map(|bytes| Entry { name: name.clone(), path, bytes }))
        };
        let entries = names.iter().filter_map(entry).collect::<Option<Vec<Entry>>>()?;
        let folder = folder.canonicalize().ok()?;
        let name = folder.file_name().map_or_else(|| "run".into(), |name| name.to_string_lossy());
        let archive = Self { name: name.chars().map(safe_in_header).collect(), entries };
        (!archive.entries.is_empty() && archive.length() < MAX_BYTES).then_some(archive)
    }

    /// Its name without `.zip`, fit for a header.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its length, bytes.
    pub fn length(&self) -> u64 {
        let entry = |entry: &Entry| {
            LOCAL_HEADER + CENTRAL_HEADER + 2 * entry.name.len() as u64 + u64::from(entry.bytes)
        };
        self.entries.iter().map(entry).sum::<u64>() + END
    }

    /// Writes it in pieces.
    ///
    /// # Errors
    /// If a file cannot be read or has changed, or what `put` fails with.
    pub fn write(&self, put: &mut dyn FnMut(&[u8]) -> io::Result<()>) -> io::Result<()> {
        let (mut central, mut offset) = (Vec::new(), 0u32);
        for entry in &self.entries {
            let mut checksum = crc32fast::Hasher::new();
            entry.each_piece(&mut |piece| {
                checksum.update(piece);
                Ok(())
            })?;
            let checksum = checksum.finalize();
            let described = entry.description(checksum);
            put(&[&b"PK\x03\x04"[..], &VERSION.to_le_bytes(), &described, entry.name.as_bytes()].concat())?;
            let mut sent = crc32fast::Hasher::new();
            entry.each_piece(&mut |piece| {
                sent.update(piece);
                put(piece)
            })?;
            if sent.finalize() != checksum {
                return Err(changed(entry));
            }
            central.extend([&b"PK\x01\x02"[..], &VERSION.to_le_bytes(), &VERSION.to_le_bytes()].concat());
            central.extend(described);
            // No comment, first disk, attributes unknown.
            central.extend([0; 10]);
            central.extend(offset.to_le_bytes());
            central.extend(entry.name.as_bytes());
            offset += LOCAL_HEADER as u32 + entry.name.len() as u32 + entry.bytes;
        }
        put(&central)?;
        let count = (self.entries.len() as u16).to_le_bytes();
        let size = (central.len() as u32).to_le_bytes();
        put(&[&b"PK\x05\x06\0\0\0\0"[..], &count, &count, &size, &offset.to_le_bytes(), &[0, 0]].concat())
    }
}

impl Entry {
    /// What both headers say of a file, from the flags to the lengths of name and extra field.
    fn description(&self, checksum: u32) -> Vec<u8> {
        const STORED: u16 = 0;
        const MIDNIGHT: u16 = 0;
        let (bytes, name) = (self.bytes.to_le_bytes(), self.name.len() as u16);
        let shorts =
            |values: &[u16]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        [
            &shorts(&[FLAGS, STORED, MIDNIGHT, DATE])[..],
            &checksum.to_le_bytes(),
            &bytes,
            &bytes,
            &shorts(&[name, 0]),
        ]
        .concat()
    }

    fn each_piece(&self, take: &mut dyn FnMut(&[u8]) -> io::Result<()>) -> io::Result<()> {
        let mut file = File::open(&self.path)?;
        let (mut piece, mut left) = (vec![0; 64 << 10], self.bytes as usize);
        while left > 0 {
            let want = piece.len().min(left);
            file.read_exact(&mut piece[..want])?;
            take(&piece[..want])?;
            left -= want;
        }
        if file.read(&mut piece[..1])? > 0 { Err(changed(self)) } else { Ok(()) }
    }
}

fn changed(entry: &Entry) -> io::Error {
    io::Error::other(format!("{} has changed while it was sent", entry.name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_archive_has_the_announced_length_and_checksums() {
        let folder = std::env::temp_dir().join(format!("odograph-archive-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("r")).unwrap();
        std::fs::write(folder.join("a.csv"), "123456789").unwrap();
        std::fs::write(folder.join("r/größe.html"), vec![7; 200_000]).unwrap();
        let names = ["a.csv", "none.txt", "r/größe.html"].map(str::to_owned);
        let archive = Archive::of(&folder, &names).unwrap();
        let mut bytes = Vec::new();
        archive
            .write(&mut |piece| {
                bytes.extend_from_slice(piece);
                Ok(())
            })
            .unwrap();
        assert_eq!(bytes.len() as u64, archive.length());
        assert!(archive.name().starts_with("odograph-archive-"));
        // The check value of this CRC, and two entries.
        assert_eq!(bytes[14..18], 0xCBF4_3926_u32.to_le_bytes());
        assert_eq!(bytes[30..44], *b"a.csv123456789");
        let end = &bytes[bytes.len() - 22..];
        assert_eq!((&end[..4], u16::from_le_bytes([end[10], end[11]])), (&b"PK\x05\x06"[..], 2));
        let central = u32::from_le_bytes([end[16], end[17], end[18], end[19]]) as usize;
        assert_eq!(bytes[central..central + 4], *b"PK\x01\x02");
        // A file that grows meanwhile is not sent as if it were whole.
        std::fs::write(folder.join("a.csv"), "1234567890").unwrap();
        assert!(archive.write(&mut |_| Ok(())).is_err());
        assert!(Archive::of(&folder, &names[1..2]).is_none());
        std::fs::remove_dir_all(folder).unwrap();
    }
}
