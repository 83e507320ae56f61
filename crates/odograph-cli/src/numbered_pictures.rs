//! A folder of numbered pictures, which gets its name only when it is complete.

use std::fs;
use std::io;
use std::path::Path;

/// The name of a picture.
pub fn name(number: u64) -> String {
    format!("{number:06}.png")
}

/// Makes an empty folder `part`, in place of what a killed run has left.
pub fn begin(part: &Path) -> io::Result<()> {
    if part.exists() {
        fs::remove_dir_all(part)?;
    }
    fs::create_dir(part)
}

/// Brings finished pictures from `part` to `place`, instead of those of an earlier run; other files
/// there stay.
pub fn place(part: &Path, place: &Path) -> io::Result<()> {
    if !place.exists() {
        return fs::rename(part, place);
    }
    remove_pictures(place)?;
    for entry in fs::read_dir(part)? {
        let entry = entry?;
        fs::rename(entry.path(), place.join(entry.file_name()))?;
    }
    fs::remove_dir(part)
}

/// Removes the pictures of an earlier run, and their folder if nothing else is in it.
pub fn remove(folder: &Path) -> io::Result<()> {
    if folder.is_dir() {
        remove_pictures(folder)?;
        // May fail if other files are in it.
        let _ = fs::remove_dir(folder);
    }
    Ok(())
}

fn remove_pictures(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if is_name(&entry.file_name().to_string_lossy()) {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

fn is_name(name: &str) -> bool {
    name.strip_suffix(".png").is_some_and(|stem| stem.len() >= 6 && stem.bytes().all(|b| b.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_our_own_pictures_are_ours() {
        assert!(is_name("000012.png") && is_name("1000000.png"));
        assert!(!is_name("holiday.png") && !is_name("12.png") && !is_name("000012.jpg"));
    }
}
