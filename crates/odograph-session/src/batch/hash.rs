//! SHA-256 of bytes, files and folders, as text.

use sha2::{Digest, Sha256};
use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// Bytes that are read at a time.
const BLOCK: usize = 1 << 20;

/// The hash of bytes.
pub fn of_bytes(bytes: &[u8]) -> String {
    text(Sha256::digest(bytes).as_slice())
}

/// The hash of a file, as `sha256sum` prints it; of a folder, that of the list of its files.
pub fn of_path(path: &Path) -> io::Result<String> {
    if !path.is_dir() {
        return of_file(path);
    }
    let mut list = String::new();
    for file in files_in(path)? {
        let name = file.strip_prefix(path).unwrap_or(&file);
        list.push_str(&format!("{}  {}\n", of_file(&file)?, name.display()));
    }
    Ok(of_bytes(list.as_bytes()))
}

/// Size of a file or of all files of a folder, bytes, and their last change, nanoseconds since
/// 1970.
pub fn size_and_change(path: &Path) -> io::Result<(u64, u64)> {
    let files = if path.is_dir() { files_in(path)? } else { vec![path.to_owned()] };
    let mut all = (0, 0);
    for file in files {
        let metadata = file.metadata()?;
        all = (all.0 + metadata.len(), all.1.max(changed(&metadata)));
    }
    Ok(all)
}

fn changed(metadata: &Metadata) -> u64 {
    let since = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    since.and_then(|since| u64::try_from(since.as_nanos()).ok()).unwrap_or(0)
}

fn of_file(path: &Path) -> io::Result<String> {
    let mut file = File::open(path)?;
    let mut hasher = Sha256::new();
    let mut block = vec![0; BLOCK];
    loop {
        match file.read(&mut block)? {
            0 => return Ok(text(hasher.finalize().as_slice())),
            read => hasher.update(&block[..read]),
        }
    }
}

/// The files of a folder and of its folders, in the order of their names.
fn files_in(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut paths = fs::read_dir(folder)?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<io::Result<Vec<PathBuf>>>()?;
    paths.sort();
    let mut files = Vec::new();
    for path in paths {
        let kind = path.symlink_metadata()?.file_type();
        match kind.is_dir() {
            true => files.append(&mut files_in(&path)?),
            // Links are followed to files only: they may lead back to the folder.
            false if path.is_file() => files.push(path),
            false => {}
        }
    }
    Ok(files)
}

fn text(hash: &[u8]) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_sha_256() {
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"; // FIPS 180-2, B.1
        assert_eq!(of_bytes(b"abc"), abc);
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("a");
        fs::write(&file, "abc").unwrap();
        assert_eq!(of_path(&file).unwrap(), abc);
        assert_eq!(of_path(place.path()).unwrap(), of_bytes(format!("{abc}  a\n").as_bytes()));
        assert_eq!(size_and_change(place.path()).unwrap().0, 3);
    }
}
