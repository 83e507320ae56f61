//! Files that a person gives beside a recording: camera, times, masks, trajectories. They are read
//! whole, up to a limit of bytes.

use std::fs::{self, File, FileType};
use std::io::{self, ErrorKind, Read};
use std::path::Path;

/// The bytes of a regular file of at most `most` bytes.
///
/// # Errors
/// As [`check_regular_file`]; if the file cannot be read, or is larger
/// ([`ErrorKind::FileTooLarge`]). The error does not name the file.
pub fn read_regular_file(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let too_large = || io::Error::new(ErrorKind::FileTooLarge, format!("it has more than {most} bytes"));
    if check_regular_file(path)? > most {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    // The length of files that the system makes up, as in /proc, is 0.
    File::open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most { Err(too_large()) } else { Ok(bytes) }
}

/// The length of a regular file, bytes. Does not open it: opening a pipe waits for its writer.
///
/// # Errors
/// If it is not there, or is a folder, or a pipe, socket or device, which may never end
/// ([`ErrorKind::InvalidInput`]).
pub fn check_regular_file(path: &Path) -> io::Result<u64> {
    let metadata = fs::metadata(path).map_err(|error| match error.kind() {
        ErrorKind::NotFound => io::Error::new(ErrorKind::NotFound, "there is no such file"),
        _ => error,
    })?;
    if metadata.is_file() {
        return Ok(metadata.len());
    }
    Err(io::Error::new(ErrorKind::InvalidInput, refusal(metadata.file_type())))
}

/// Why something that is not a file is not read.
fn refusal(kind: FileType) -> String {
    if kind.is_dir() {
        return "it is a folder; give a file".to_owned();
    }
    format!("it is {}; save its content to a file and give that", name_of_kind(kind))
}

/// What something that is neither a file nor a folder is.
#[cfg(unix)]
fn name_of_kind(kind: FileType) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    match kind {
        kind if kind.is_fifo() => "a pipe",
        kind if kind.is_socket() => "a socket",
        _ => "a device",
    }
}

#[cfg(not(unix))]
fn name_of_kind(_: FileType) -> &'static str {
    "a device"
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    #[test]
    fn files_are_read_up_to_the_limit() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "12345").unwrap();
        assert_eq!(read_regular_file(file.path(), 5).unwrap(), b"12345");
        assert_eq!(read_regular_file(file.path(), 4).unwrap_err().kind(), ErrorKind::FileTooLarge);
    }

    #[test]
    fn a_file_that_is_too_large_is_not_read() {
        let file = tempfile::NamedTempFile::new().unwrap();
        file.as_file().set_len(1 << 40).unwrap();
        assert_eq!(read_regular_file(file.path(), 1 << 30).unwrap_err().kind(), ErrorKind::FileTooLarge);
    }

    #[test]
    #[cfg(unix)]
    fn what_is_not_a_file_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("socket");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        for (path, what) in
            [(folder.path(), "a folder"), (Path::new("/dev/zero"), "a device"), (&socket, "a socket")]
        {
            let error = read_regular_file(path, 1 << 40).unwrap_err();
            assert!(error.to_string().contains(what), "{error}");
        }
    }
}
