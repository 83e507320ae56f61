//! Workers, and whether they live: each renews a lease as long as its process runs.

use super::manifest::new_file;
use crate::files;
use odograph::error::{Error, Result};
use std::collections::HashMap;
use std::fs::{self, File, TryLockError};
use std::io::{Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// From one renewal of a lease to the next.
const RENEWAL: Duration = Duration::from_secs(15);

/// A lease that was not renewed for this long has ended: eight renewals, so that a busy network
/// drive does not end one.
const LEASE: Duration = Duration::from_secs(120);

/// This process as a worker: its lease is a file that it renews and has locked.
#[derive(Debug)]
pub(super) struct Worker {
    name: String,
    lease: PathBuf,
    /// Dropped to end the renewal.
    stop: Option<Sender<()>>,
    renewal: Option<JoinHandle<()>>,
}

impl Worker {
    /// A new worker with a lease in this folder, which is made.
    pub fn in_folder(folder: &Path) -> Result<Self> {
        files::make_folder(folder)?;
        let cannot = |error| Error::not_written(folder.display(), error);
        let (mut file, lease) =
            new_file(folder, "worker-").and_then(|file| Ok(file.keep()?)).map_err(cannot)?;
        // A file system without locks offers only the renewal.
        let _ = file.try_lock();
        renew(&mut file, 0).map_err(cannot)?;
        let name = lease.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let (stop, stopped) = channel();
        let renewal = thread::spawn(move || keep_renewing(&mut file, &stopped));
        Ok(Self { name, lease, stop: Some(stop), renewal: Some(renewal) })
    }

    /// Its name, unlike that of any other.
    pub fn name(&self) -> &str {
        &self.name
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.stop = None;
        let _ = self.renewal.take().map(JoinHandle::join);
        let _ = fs::remove_file(&self.lease);
    }
}

fn keep_renewing(lease: &mut File, stopped: &Receiver<()>) {
    for count in 1.. {
        if stopped.recv_timeout(RENEWAL) != Err(RecvTimeoutError::Timeout) {
            return;
        }
        // A renewal that fails is tried again before the lease ends.
        let _ = renew(lease, count);
    }
}

/// Writes the system and a count of constant length, so that a reader never sees a half of it.
fn renew(lease: &mut File, count: u64) -> std::io::Result<()> {
    let text = format!("{} {count:020}\n", running_system().unwrap_or_default());
    lease.rewind()?;
    lease.write_all(text.as_bytes())
}

/// What the running operating system calls itself, which is different after each start.
fn running_system() -> Option<String> {
    let id = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    Some(id.trim().to_owned()).filter(|id| !id.is_empty())
}

/// Watches the leases of other workers.
#[derive(Debug)]
pub(super) struct Watch {
    folder: PathBuf,
    system: Option<String>,
    /// What a lease was last, and since when.
    seen: HashMap<String, (Option<Vec<u8>>, Instant)>,
}

impl Watch {
    /// Watches those in this folder.
    pub fn over(folder: PathBuf) -> Self {
        Self { folder, system: running_system(), seen: HashMap::new() }
    }

    /// Whether the lease of a worker has ended: at once if the worker was on this machine, else if
    /// the lease is not renewed. No clocks of different machines are compared.
    pub fn has_ended(&mut self, worker: &str) -> bool {
        let lease = self.folder.join(worker);
        let now = (!worker.is_empty()).then(|| fs::read(&lease).ok()).flatten();
        let is_here = self.system.as_ref().is_some_and(|system| {
            now.as_ref().is_some_and(|lease| lease.starts_with(format!("{system} ").as_bytes()))
        });
        if is_here {
            match File::open(&lease).map(|lease| lease.try_lock_shared()) {
                Ok(Ok(())) => return true,
                Ok(Err(TryLockError::WouldBlock)) => return false,
                _ => {}
            }
        }
        let (last, since) =
            self.seen.entry(worker.to_owned()).or_insert_with(|| (now.clone(), Instant::now()));
        if *last != now {
            (*last, *since) = (now, Instant::now());
        }
        since.elapsed() > LEASE
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn a_lease_ends_with_its_process_or_if_it_is_not_renewed() {
        let place = tempfile::tempdir().unwrap();
        let (worker, other) =
            (Worker::in_folder(place.path()).unwrap(), Worker::in_folder(place.path()).unwrap());
        assert_ne!(worker.name(), other.name());
        let mut watch = Watch::over(place.path().to_owned());
        assert!(!watch.has_ended(worker.name()));

        // What a killed process on this machine leaves is a lease without a lock.
        if let Some(system) = running_system() {
            fs::write(place.path().join("killed"), format!("{system} {:020}\n", 7)).unwrap();
            assert!(watch.has_ended("killed"));
        }

        // Whether a process of another machine is alive cannot be determined here.
        let mut away = |count: u64, earlier: Duration| {
            fs::write(place.path().join("away"), format!("elsewhere {count:020}\n")).unwrap();
            if let Some((_, since)) = watch.seen.get_mut("away") {
                *since -= earlier;
            }
            watch.has_ended("away")
        };
        assert!(!away(0, Duration::ZERO) && !away(0, LEASE / 2));
        assert!(!away(1, LEASE), "renewed");
        assert!(away(1, LEASE));
    }
}
