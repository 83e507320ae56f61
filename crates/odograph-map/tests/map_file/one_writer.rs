//! Exclusive write access to a map, and recovery from a program that died while creating it.

use crate::ground;
use odograph::camera::Rig;
use odograph::error::{ErrorKind, Result};
use odograph_map::{MapClaim, MapFile};
use std::fs;
use std::path::Path;

fn create(path: &Path) -> Result<MapFile> {
    MapFile::create(path, &ground::camera(), &Rig::level(0.5))
}

fn assert_refused<T>(result: Result<T>) {
    let Err(error) = result else { panic!("a second writer was let in") };
    assert_eq!(error.kind(), ErrorKind::Input);
    let message = error.to_string();
    let holder = format!("being written by another program (process {})", std::process::id());
    assert!(message.contains(&holder) && message.contains("wait until"), "{message}");
}

#[test]
fn a_map_has_one_writer_at_a_time() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let map = ground::map_of(&path, 1);
    assert_refused(MapFile::open(&path));
    assert_refused(MapClaim::on(&path));
    assert_refused(MapFile::remove(&path));
    // Read-only access is allowed, and sees the current state.
    assert_eq!(MapFile::open_read_only(&path).unwrap().map().unwrap().keyframes.len(), 1);
    map.close().unwrap();
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "the lock goes with its holder");
    MapFile::open(&path).unwrap();
}

#[test]
fn a_map_being_created_cannot_be_created_again_or_deleted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let claim = MapClaim::on(&path).unwrap();
    assert_refused(create(&path));
    let map = MapFile::create_claimed(claim, &ground::camera(), &Rig::level(0.5)).unwrap();
    assert!(create(&path).is_err() && path.exists());
    drop(map);
    assert!(create(&path).unwrap_err().to_string().contains("already"));
}

#[test]
#[cfg(unix)]
fn links_to_a_map_share_its_lock() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let map = create(&path).unwrap();
    let link = folder.path().join("link.gpkg");
    std::os::unix::fs::symlink(&path, &link).unwrap();
    assert_refused(MapFile::open(&link));
    drop(map);
    MapFile::open(&link).unwrap();
}

#[test]
fn unfinished_maps_of_dead_programs_are_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    // Killed before the first byte, and killed before the tables were created: an empty database.
    let empty_database = {
        let database = rusqlite::Connection::open(folder.path().join("empty.gpkg")).unwrap();
        database.query_row("PRAGMA journal_mode = WAL", [], |_| Ok(())).unwrap();
        database.close().unwrap();
        fs::read(folder.path().join("empty.gpkg")).unwrap()
    };
    assert!(!empty_database.is_empty());
    for left in [&[][..], &empty_database] {
        fs::write(&path, left).unwrap();
        fs::write(folder.path().join("map.gpkg.lock"), "4194304\n").unwrap();
        assert!(!MapFile::is_there(&path));
        create(&path).unwrap().close().unwrap();
        assert!(MapFile::is_there(&path));
        MapFile::open(&path).unwrap().close().unwrap();
        fs::remove_file(&path).unwrap();
    }
    // Any other file is not overwritten.
    fs::write(&path, "a letter").unwrap();
    assert!(MapFile::is_there(&path) && create(&path).is_err());
}

#[test]
fn a_map_can_be_closed_while_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.gpkg");
    let map = ground::map_of(&path, 1);
    let looking = rusqlite::Connection::open(&path).unwrap();
    looking.execute_batch("BEGIN; SELECT count(*) FROM keyframes;").unwrap();
    map.close().unwrap();
    drop(looking);
    assert_eq!(MapFile::open(&path).unwrap().map().unwrap().keyframes.len(), 1);
}

#[test]
fn a_replaced_map_keeps_nothing_of_the_log_of_a_killed_writer() {
    let folder = tempfile::tempdir().unwrap();
    let (path, new) = (folder.path().join("map.gpkg"), folder.path().join("map.gpkg.part"));
    // The files of a program that was killed: the keyframes are in the log.
    let writing = ground::map_of(&path, 4);
    let left = ["map.gpkg", "map.gpkg-wal"].map(|name| (name, fs::read(folder.path().join(name)).unwrap()));
    drop(writing);
    left.iter().for_each(|(name, bytes)| fs::write(folder.path().join(name), bytes).unwrap());
    ground::map_of(&new, 2).close().unwrap();
    let claim = MapClaim::on(&path).unwrap();
    // Before anything else the old map gets what its log has.
    assert!(MapFile::replace(&claim, &folder.path().join("none.part")).is_err());
    assert!(!folder.path().join("map.gpkg-wal").exists());
    assert_eq!(MapFile::open_read_only(&path).unwrap().map().unwrap().keyframes.len(), 4);
    MapFile::replace(&claim, &new).unwrap();
    drop(claim);
    let mut map = MapFile::open(&path).unwrap();
    map.check().unwrap();
    assert_eq!(map.map().unwrap().keyframes.len(), 2);
    map.close().unwrap();
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn a_creation_that_was_killed_in_a_write_is_no_map() {
    let folder = tempfile::tempdir().unwrap();
    let (path, killed) = (folder.path().join("map.gpkg"), folder.path().join("killed.gpkg"));
    let connection = rusqlite::Connection::open(&path).unwrap();
    // A page on disk, then a transaction that has written its journal and the file, and no more.
    connection.execute_batch("PRAGMA user_version = 1; PRAGMA cache_size = 1; BEGIN").unwrap();
    connection.execute_batch("CREATE TABLE filler (bytes BLOB)").unwrap();
    connection.execute_batch("INSERT INTO filler VALUES (zeroblob(1000000))").unwrap();
    std::fs::copy(&path, &killed).unwrap();
    std::fs::copy(folder.path().join("map.gpkg-journal"), folder.path().join("killed.gpkg-journal")).unwrap();
    drop(connection);
    assert!(!MapFile::is_there(&killed));
}
