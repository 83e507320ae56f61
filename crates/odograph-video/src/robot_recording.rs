//! Detects robot recordings (ROS bags, MCAP) by their content, so that no other reader mistakes one
//! for a video. A bag of JPEG images looks like a Motion JPEG stream, with the images of all its
//! cameras interleaved and without timestamps.

use odograph::error::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Bytes of a database that are searched for its tables: those are on its first page, which has at
/// most 64 KiB.
const DATABASE_HEAD: u64 = 1 << 16;

/// Format of a robot recording, or a database that is not a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Mcap,
    RosBag,
    Rosbag2,
    Database,
}

impl Kind {
    fn of(head: &[u8]) -> Option<Self> {
        if head.starts_with(b"\x89MCAP0\r\n") {
            Some(Self::Mcap)
        } else if head.starts_with(b"#ROSBAG V") {
            Some(Self::RosBag)
        } else if head.starts_with(b"SQLite format 3\0") {
            let text = head.to_ascii_lowercase();
            let has = |table: &[u8]| {
                [&b"create table "[..], b"create table \"", b"create table '", b"create table ["]
                    .iter()
                    .any(|begin| find(&text, &[begin, table].concat()))
            };
            Some(if has(b"topics") && has(b"messages") { Self::Rosbag2 } else { Self::Database })
        } else {
            None
        }
    }

    fn refusal(self) -> Error {
        let name = match self {
            Self::Mcap => "an MCAP recording",
            Self::RosBag => "a ROS 1 bag",
            Self::Rosbag2 => "a rosbag2 recording",
            Self::Database => {
                return Error::input(
                    "this is an SQLite database and not a recording (a map is given with --map)",
                );
            }
        };
        Error::input(format!(
            "this is {name}, which cannot be read yet; write the pictures of its camera into a folder and give that, with \
             their times as --timestamps"
        ))
    }
}

fn find(text: &[u8], part: &[u8]) -> bool {
    text.windows(part.len()).any(|window| window == part)
}

/// Fails if a file that begins with `magic` is a robot recording or a database.
pub(crate) fn refuse_file(path: &Path, magic: &[u8]) -> Result<()> {
    let Some(kind) = Kind::of(magic) else { return Ok(()) };
    let mut head = Vec::new();
    let read = File::open(path).and_then(|file| file.take(DATABASE_HEAD).read_to_end(&mut head));
    Err(read.ok().and_then(|_| Kind::of(&head)).unwrap_or(kind).refusal())
}

/// Fails if a folder is a rosbag2 recording, by its description or by a file in it.
pub(crate) fn refuse_folder(folder: &Path) -> Result<()> {
    let mut description = Vec::new();
    if let Ok(file) = File::open(folder.join("metadata.yaml")) {
        // A folder or pipe of that name is not a description.
        let _ = file.take(DATABASE_HEAD).read_to_end(&mut description);
    }
    if find(&description, b"rosbag2_bagfile_information") {
        return Err(Kind::Rosbag2.refusal());
    }
    let Ok(entries) = std::fs::read_dir(folder) else { return Ok(()) };
    for path in entries.flatten().map(|entry| entry.path()) {
        let ending = path.extension().map(|ending| ending.to_ascii_lowercase());
        if !ending.is_some_and(|ending| ["mcap", "db3", "bag"].iter().any(|bag| ending == *bag))
            || !path.is_file()
        {
            continue;
        }
        let mut magic = Vec::new();
        let read = File::open(&path).and_then(|file| file.take(64).read_to_end(&mut magic));
        if read.is_ok() {
            refuse_file(&path, &magic).map_err(|error| error.at(path.display()))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robot_recordings_are_detected_by_their_first_bytes() {
        assert_eq!(Kind::of(b"\x89MCAP0\r\n\x01"), Some(Kind::Mcap));
        assert_eq!(Kind::of(b"#ROSBAG V2.0\n"), Some(Kind::RosBag));
        assert_eq!(Kind::of(b"SQLite format 3\0 CREATE TABLE keyframes (id)"), Some(Kind::Database));
        let bag = b"SQLite format 3\0 CREATE TABLE messages(id) CREATE TABLE \"topics\"(id)";
        assert_eq!(Kind::of(bag), Some(Kind::Rosbag2));
        assert_eq!(Kind::of(b"\x89PNG\r\n"), None);
    }
}
