//! Files that are not recordings, recognised by their first bytes: a refusal says what was given,
//! and a decoder is not asked.

use odograph::error::{Error, Result};

/// Bytes at the start of a file from which it is recognised.
pub(crate) const START_BYTES: u64 = 4096;

/// What to give, where a file is something else.
pub(crate) const WHAT_TO_GIVE: &str =
    "give a video, a folder of pictures or a robot recording (MCAP, ROS bag)";

/// Fails if a file with these first bytes, [`START_BYTES`] of them or all, is not a recording.
pub(crate) fn check(start: &[u8]) -> Result<()> {
    let Some((what, remedy)) = kind(start) else { return Ok(()) };
    Err(Error::input(format!("this is {what}, not a recording; {}", remedy.unwrap_or(WHAT_TO_GIVE))))
}

/// What a file with these first bytes is, where that is known and it is not a recording.
pub(crate) fn name(start: &[u8]) -> Option<&'static str> {
    kind(start).map(|(what, _)| what)
}

/// What the file is, and what to do unless that is [`WHAT_TO_GIVE`]. `None`: it may be a recording.
fn kind(start: &[u8]) -> Option<(&'static str, Option<&'static str>)> {
    let unpack = Some("unpack it and give what is in it");
    Some(match start {
        [b'%', b'P', b'D', b'F', b'-', ..] => ("a PDF document", None),
        [b'P', b'K', 3 | 5, 4 | 6, ..] => ("a ZIP archive or an office document", unpack),
        [0x1f, 0x8b, ..]
        | [b'B', b'Z', b'h', ..]
        | [0xfd, b'7', b'z', b'X', b'Z', 0, ..]
        | [0x28, 0xb5, 0x2f, 0xfd, ..]
        | [b'7', b'z', 0xbc, 0xaf, ..]
        | [b'R', b'a', b'r', b'!', ..] => ("a compressed file", unpack),
        tar if tar.get(257..262) == Some(b"ustar") => ("a tar archive", unpack),
        [b'S', b'Q', b'L', b'i', b't', b'e', b' ', ..] => ("a database, such as a map", None),
        [0x7f, b'E', b'L', b'F', ..] | [b'M', b'Z', ..] => ("a program", None),
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'A', b'V', b'E', ..]
        | [b'I', b'D', b'3', ..]
        | [b'f', b'L', b'a', b'C', ..] => ("a sound file", None),
        [_, _, _, _, b'f', b't', b'y', b'p', brand @ ..]
            if [b"heic", b"heix", b"mif1", b"avif"].iter().any(|still| brand.starts_with(*still)) =>
        {
            ("a HEIC or AVIF picture", Some("convert it to JPEG or PNG"))
        }
        _ if start.len() >= 64 && start.iter().all(|&byte| byte == 0) => {
            ("a file that begins with zeros only", Some("copying it has failed: copy it again"))
        }
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => ("a text file", None),
        _ if is_text(start) => {
            let begins = String::from_utf8_lossy(start).trim_start().to_ascii_lowercase();
            match begins.starts_with("<!doctype html") || begins.starts_with("<html") {
                true => ("a web page", Some("download the recording itself")),
                false => ("a text file", None),
            }
        }
        _ => return None,
    })
}

/// Whether these are the first bytes of UTF-8 text, which may end inside a character.
fn is_text(start: &[u8]) -> bool {
    let whole = match std::str::from_utf8(start) {
        Ok(text) => text,
        Err(error) if error.error_len().is_none() => {
            std::str::from_utf8(&start[..error.valid_up_to()]).unwrap_or_default()
        }
        Err(_) => return false,
    };
    !whole.is_empty() && !whole.chars().any(|c| c.is_control() && !c.is_whitespace())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_are_no_recordings_are_named() {
        let zeros = [0; 64];
        let mut tar = [b'a'; 300];
        tar[257..262].copy_from_slice(b"ustar");
        for (start, what) in [
            (&b"%PDF-1.7\n%\xe2\xe3"[..], "a PDF document"),
            (b"PK\x03\x04\x14\0", "a ZIP archive or an office document"),
            (b"\x1f\x8b\x08\0", "a compressed file"),
            (&tar, "a tar archive"),
            (b"SQLite format 3\0", "a database, such as a map"),
            (b"\x7fELF\x02", "a program"),
            (b"RIFF\x24\0\0\0WAVEfmt ", "a sound file"),
            (b"\0\0\0\x18ftypheic", "a HEIC or AVIF picture"),
            (&zeros, "a file that begins with zeros only"),
            (b"\xff\xfeh\0i\0", "a text file"),
            (b"time,x,y\r\n0,1,2\r\n", "a text file"),
            ("grüße, cut inside ü".as_bytes(), "a text file"),
            (&"ü".as_bytes()[..1], ""),
            (&"aü".as_bytes()[..2], "a text file"),
            (b"\n<!DOCTYPE html><title>404", "a web page"),
            (b"\0\0\0\x18ftypmp42", ""),
            (b"\x1a\x45\xdf\xa3", ""),
            (b"RIFF\0\0\0\0AVI ", ""),
            (b"G\x40\x11\x10\0", ""),
        ] {
            let said = check(start).err().map(|error| error.to_string()).unwrap_or_default();
            let expected = if what.is_empty() { String::new() } else { format!("this is {what}, not a ") };
            assert!(said.starts_with(&expected) && said.is_empty() == what.is_empty(), "{what}: {said}");
        }
    }
}
