//! Recordings, picture folders and streams as gray frames with timestamps.
