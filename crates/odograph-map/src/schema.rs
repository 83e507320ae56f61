//! Database schema: creates the tables, and validates those of a file when it is opened.

use crate::complaint::{Complaint, WithContext};
use crate::geopackage::{self, APPLICATION_ID, USER_VERSION};
use odograph::error::Result;
use rusqlite::{Connection, OpenFlags, OptionalExtension, params};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Schema version. It increases with every change that a program for the previous version cannot
/// read.
const SCHEMA_VERSION: i64 = 1;

/// Schema version of maps with sessions of several cameras.
const VERSION_OF_SEVERAL_CAMERAS: i64 = 2;

/// Tables of a GeoPackage with features and tiles (clauses 1.1, 2.1, 2.2, 2.3).
const GEOPACKAGE_TABLES: [&str; 6] = [
    "CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL, \
     organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT)",
    "CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, \
     description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')), min_x DOUBLE, \
     min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER, \
     CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id))",
    "CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, \
     srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL, \
     CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name), \
     CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name), \
     CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id))",
    "CREATE TABLE gpkg_tile_matrix_set (table_name TEXT NOT NULL PRIMARY KEY, srs_id INTEGER NOT NULL, min_x DOUBLE NOT NULL, \
     min_y DOUBLE NOT NULL, max_x DOUBLE NOT NULL, max_y DOUBLE NOT NULL, \
     CONSTRAINT fk_gtms_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name), \
     CONSTRAINT fk_gtms_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id))",
    "CREATE TABLE gpkg_tile_matrix (table_name TEXT NOT NULL, zoom_level INTEGER NOT NULL, matrix_width INTEGER NOT NULL, \
     matrix_height INTEGER NOT NULL, tile_width INTEGER NOT NULL, tile_height INTEGER NOT NULL, pixel_x_size DOUBLE NOT NULL, \
     pixel_y_size DOUBLE NOT NULL, CONSTRAINT pk_ttm PRIMARY KEY (table_name, zoom_level), \
     CONSTRAINT fk_tmm_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name))",
    "CREATE TABLE gpkg_extensions (table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL, definition TEXT NOT NULL, \
     scope TEXT NOT NULL, CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name))",
];

/// Our own tables. The first three are layers for other programs; everything else is in separate
/// tables.
const MAP_TABLES: [(&str, &str); 11] = [
    (
        "keyframes",
        "CREATE TABLE keyframes (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT NOT NULL, session INTEGER NOT NULL, \
         segment INTEGER NOT NULL, frame INTEGER NOT NULL, time_s DOUBLE NOT NULL, x_m DOUBLE NOT NULL, y_m DOUBLE NOT NULL, \
         heading_rad DOUBLE NOT NULL, height_m DOUBLE NOT NULL, roll_rad DOUBLE NOT NULL, pitch_rad DOUBLE NOT NULL, \
         sd_x_m DOUBLE NOT NULL, sd_y_m DOUBLE NOT NULL, sd_heading_rad DOUBLE NOT NULL, sd_height_m DOUBLE NOT NULL, \
         sd_roll_rad DOUBLE NOT NULL, sd_pitch_rad DOUBLE NOT NULL, odometry_x_m DOUBLE NOT NULL, odometry_y_m DOUBLE NOT NULL, \
         odometry_heading_rad DOUBLE NOT NULL, odometry_height_m DOUBLE NOT NULL, odometry_roll_rad DOUBLE NOT NULL, \
         odometry_pitch_rad DOUBLE NOT NULL, covariance BLOB NOT NULL)",
    ),
    (
        "paths",
        "CREATE TABLE paths (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom LINESTRING NOT NULL, session INTEGER NOT NULL, \
         segment INTEGER NOT NULL, frames INTEGER NOT NULL, start_s DOUBLE NOT NULL, end_s DOUBLE NOT NULL, length_m DOUBLE NOT NULL)",
    ),
    (
        "mosaic",
        "CREATE TABLE mosaic (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, zoom_level INTEGER NOT NULL, \
         tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL, tile_data BLOB NOT NULL, \
         UNIQUE (zoom_level, tile_column, tile_row))",
    ),
    (
        "odograph_map",
        "CREATE TABLE odograph_map (id INTEGER PRIMARY KEY CHECK (id = 1), schema_version INTEGER NOT NULL, program TEXT NOT NULL)",
    ),
    (
        "odograph_camera",
        "CREATE TABLE odograph_camera (id INTEGER PRIMARY KEY CHECK (id = 1), width INTEGER NOT NULL, height INTEGER NOT NULL, \
         fx_px DOUBLE NOT NULL, fy_px DOUBLE NOT NULL, cx_px DOUBLE NOT NULL, cy_px DOUBLE NOT NULL, distortion TEXT NOT NULL, \
         coefficients BLOB NOT NULL)",
    ),
    (
        "odograph_rig",
        "CREATE TABLE odograph_rig (id INTEGER PRIMARY KEY CHECK (id = 1), height_m DOUBLE NOT NULL, roll_rad DOUBLE NOT NULL, \
         pitch_rad DOUBLE NOT NULL, yaw_rad DOUBLE NOT NULL)",
    ),
    (
        "odograph_session",
        "CREATE TABLE odograph_session (id INTEGER PRIMARY KEY NOT NULL, source TEXT NOT NULL)",
    ),
    (
        "odograph_edge",
        "CREATE TABLE odograph_edge (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, from_keyframe INTEGER NOT NULL, \
         to_keyframe INTEGER NOT NULL, kind TEXT NOT NULL, x_m DOUBLE NOT NULL, y_m DOUBLE NOT NULL, heading_rad DOUBLE NOT NULL, \
         log_height_ratio DOUBLE NOT NULL, covariance BLOB NOT NULL)",
    ),
    (
        "odograph_signature",
        "CREATE TABLE odograph_signature (keyframe INTEGER PRIMARY KEY NOT NULL, bytes BLOB NOT NULL)",
    ),
    (
        "odograph_image",
        "CREATE TABLE odograph_image (keyframe INTEGER PRIMARY KEY NOT NULL, colored INTEGER NOT NULL, luma_scale DOUBLE NOT NULL, \
         luma_offset DOUBLE NOT NULL, jpeg BLOB NOT NULL)",
    ),
    (
        "odograph_frame",
        "CREATE TABLE odograph_frame (session INTEGER NOT NULL, frame INTEGER NOT NULL, segment INTEGER NOT NULL, \
         time_s DOUBLE NOT NULL, x_m DOUBLE NOT NULL, y_m DOUBLE NOT NULL, heading_rad DOUBLE NOT NULL, height_m DOUBLE NOT NULL, \
         roll_rad DOUBLE NOT NULL, pitch_rad DOUBLE NOT NULL, PRIMARY KEY (session, frame)) WITHOUT ROWID",
    ),
];

/// Creates all tables in an empty database.
pub(crate) fn make(connection: &Connection) -> rusqlite::Result<()> {
    for sql in GEOPACKAGE_TABLES.iter().copied().chain(MAP_TABLES.iter().map(|(_, sql)| *sql)) {
        connection.execute(sql, [])?;
    }
    geopackage::write_reference_systems(connection)?;
    geopackage::list_layer(connection, "keyframes", "features", "where the ground was remembered")?;
    geopackage::list_geometry(connection, "keyframes", "POINT")?;
    geopackage::list_layer(connection, "paths", "features", "the way of the camera")?;
    geopackage::list_geometry(connection, "paths", "LINESTRING")?;
    geopackage::list_layer(connection, "mosaic", "tiles", "what the ground looks like")?;
    // If an attributes table is among the layers, other programs ignore tables that are not
    // registered.
    geopackage::list_layer(connection, "odograph_session", "attributes", "the runs that made the map")?;
    for (table, _) in MAP_TABLES.iter().filter(|(table, _)| table.starts_with("odograph_")) {
        list_extension(connection, table)?;
    }
    connection.execute(
        "INSERT INTO odograph_map VALUES (1, ?1, ?2)",
        params![SCHEMA_VERSION, concat!("odograph ", env!("CARGO_PKG_VERSION"))],
    )?;
    // Written last, because they assert that the schema is complete.
    connection.pragma_update(None, "application_id", APPLICATION_ID)?;
    connection.pragma_update(None, "user_version", USER_VERSION)
}

/// Checks, before SQLite opens it, that the file is a database and not truncated.
pub(crate) fn check_bytes(path: &Path) -> Result<()> {
    let complaint = Complaint::about(path);
    let (head, bytes) = check_is_database(path)?;
    let page = match u16::from_be_bytes([head[16], head[17]]) {
        1 => 65_536,
        size => u64::from(size),
    };
    let pages = u64::from(u32::from_be_bytes([head[28], head[29], head[30], head[31]]));
    // With a log beside it, the file itself may be shorter than its header states.
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    let logged = std::fs::metadata(&log).is_ok_and(|log| log.len() > 0);
    if !logged && pages * page > bytes {
        return Err(complaint.input(format!(
            "the file is cut off: it should have {} bytes and has {}; copy it again from where it came, or save the \
             rest with odograph map repair",
            pages * page,
            bytes
        )));
    }
    Ok(())
}

/// Checks that the file begins as a database does; returns its header and its length.
pub(crate) fn check_is_database(path: &Path) -> Result<(Vec<u8>, u64)> {
    let complaint = Complaint::about(path);
    let cannot = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::NotFound => complaint.input("the map cannot be read: there is no such file"),
        _ => complaint.input(format!("the map cannot be read: {error}")),
    };
    let mut head = Vec::new();
    // Before it is opened: a pipe would wait for its writer.
    let metadata = std::fs::metadata(path).map_err(cannot)?;
    let inside = path.join("map.gpkg");
    if inside.is_file() {
        return Err(complaint.input(format!("this is the folder of a run; its map is {}", inside.display())));
    }
    if !metadata.is_file() {
        return Err(complaint.input("this is not a file; a map is one file, written by odograph run"));
    }
    File::open(path).and_then(|file| file.take(100).read_to_end(&mut head)).map_err(cannot)?;
    if head.len() < 100 || !head.starts_with(b"SQLite format 3\0") {
        return Err(
            complaint.input("this is not a map file; give the map.gpkg that odograph run has written")
        );
    }
    Ok((head, metadata.len()))
}

/// Whether this is an unfinished map of a program that was killed while creating it: an empty file,
/// or a database without tables.
pub(crate) fn is_unfinished(path: &Path) -> bool {
    let Ok(metadata) = path.metadata() else { return false };
    if !metadata.is_file() || metadata.len() == 0 {
        return metadata.is_file();
    }
    // The write-ahead log may have the tables. A reader cannot roll back what a killed program has
    // begun.
    let number = |sql: &str| -> rusqlite::Result<i64> {
        let by = |access| {
            let flags = access | OpenFlags::SQLITE_OPEN_NO_MUTEX;
            Connection::open_with_flags(path, flags)?.query_row(sql, [], |row| row.get(0))
        };
        by(OpenFlags::SQLITE_OPEN_READ_ONLY).or_else(|_| by(OpenFlags::SQLITE_OPEN_READ_WRITE))
    };
    check_bytes(path).is_ok()
        && number("SELECT count(*) FROM sqlite_schema").is_ok_and(|tables| tables == 0)
        && number("PRAGMA application_id").is_ok_and(|id| id == 0)
}

/// Checks that a database is a map of this version whose tables have exactly our schema.
pub(crate) fn check(connection: &Connection, path: &Path) -> Result<()> {
    let complaint = Complaint::about(path);
    let number = |pragma: &str| connection.pragma_query_value(None, pragma, |row| row.get::<_, i32>(0));
    let ours = definition(connection, "odograph_map").while_reading(&complaint)?;
    let Some(_) = ours.filter(|sql| !sql.to_ascii_uppercase().starts_with("CREATE VIRTUAL")) else {
        return Err(complaint.input("this database is not a map of odograph (it has no table odograph_map); give the map.gpkg that odograph run has \
             written"));
    };
    check_version(connection, path)?;
    if number("application_id").while_reading(&complaint)? != APPLICATION_ID {
        return Err(
            complaint.input("the map is not marked as a GeoPackage; it has been changed by another program: copy it again from where it \
                 came")
        );
    }
    for (table, sql) in MAP_TABLES {
        let found = definition(connection, table).while_reading(&complaint)?;
        if found.as_deref() != Some(sql) {
            return Err(complaint.input(format!(
                "the map's table {table} is {}; it is damaged or has been changed by another program: copy it again from where \
                 it came, or save the rest with odograph map repair",
                if found.is_none() { "missing" } else { "not as odograph makes it" }
            )));
        }
    }
    Ok(())
}

/// Checks that a map has the version of tables that this program reads.
pub(crate) fn check_version(connection: &Connection, path: &Path) -> Result<()> {
    let complaint = Complaint::about(path);
    let version: i64 = connection
        .query_row("SELECT schema_version FROM odograph_map WHERE id = 1", [], |row| row.get(0))
        .while_reading(&complaint)?;
    if !(SCHEMA_VERSION..=VERSION_OF_SEVERAL_CAMERAS).contains(&version) {
        return Err(complaint.input(format!(
            "the map has version {version} of its tables and this program reads versions {SCHEMA_VERSION} and {VERSION_OF_SEVERAL_CAMERAS}; \
             use the program that wrote it, \
             or make the map again"
        )));
    }
    Ok(())
}

/// Makes a table that only some maps have, unless it is there.
pub(crate) fn make_further(connection: &Connection, name: &str, sql: &str) -> rusqlite::Result<()> {
    if has_further(connection, name, sql)? {
        return Ok(());
    }
    connection.execute(sql, [])?;
    list_extension(connection, name)
}

/// Whether a map has a table that only some have, exactly as we make it.
pub(crate) fn has_further(connection: &Connection, name: &str, sql: &str) -> rusqlite::Result<bool> {
    Ok(definition(connection, name)?.as_deref() == Some(sql))
}

/// The statement that made a table; `None` if there is no such table.
fn definition(connection: &Connection, name: &str) -> rusqlite::Result<Option<String>> {
    connection
        .prepare_cached("SELECT sql FROM sqlite_schema WHERE type = 'table' AND name = ?1")?
        .query_row([name], |row| row.get(0))
        .optional()
}

/// Registers a table that is not part of GeoPackage (clause 2.3).
fn list_extension(connection: &Connection, table: &str) -> rusqlite::Result<()> {
    let insert = "INSERT INTO gpkg_extensions \
                  VALUES (?1, NULL, 'odograph_map', 'docs/map_file.md of odograph', 'write-only')";
    connection.execute(insert, [table])?;
    Ok(())
}

/// Marks a map as one that programs for a single camera cannot read.
pub(crate) fn mark_several_cameras(connection: &Connection) -> rusqlite::Result<()> {
    connection.execute("UPDATE odograph_map SET schema_version = ?1", [VERSION_OF_SEVERAL_CAMERAS])?;
    Ok(())
}

/// Checks that a map has no triggers, which would be executed on writing: a spatial index of
/// another program would need functions of that program.
pub(crate) fn check_writable(connection: &Connection, path: &Path) -> Result<()> {
    let complaint = Complaint::about(path);
    let trigger: Option<String> = connection
        .query_row("SELECT name FROM sqlite_schema WHERE type = 'trigger' LIMIT 1", [], |row| row.get(0))
        .optional()
        .while_reading(&complaint)?;
    trigger.map_or(Ok(()), |name| {
        Err(complaint.input(format!(
            "another program has put the trigger {name} into the map, so that it can be read but not written (a spatial index? remove it there, or odograph map repair makes a map without it)"
        )))
    })
}
