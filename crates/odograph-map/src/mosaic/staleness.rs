//! How far the keyframes have moved since the mosaic was rendered: a row in a table that only maps
//! with such a mosaic have. Poses and row are one transaction, so that a program killed before it
//! could render the mosaic again leaves a map that says so.

use crate::schema;
use rusqlite::{Connection, OptionalExtension, Result};

const NAME: &str = "odograph_mosaic_shift";
const TABLE: &str =
    "CREATE TABLE odograph_mosaic_shift (id INTEGER PRIMARY KEY CHECK (id = 1), shift_m DOUBLE NOT NULL)";

/// Adds the largest move of a keyframe, metres. The sum bounds every keyframe's displacement.
pub(crate) fn add(connection: &Connection, moved_m: f64) -> Result<()> {
    let has_mosaic =
        connection.query_row("SELECT EXISTS (SELECT 1 FROM mosaic)", [], |row| row.get::<_, bool>(0))?;
    if !has_mosaic || moved_m == 0.0 {
        return Ok(());
    }
    let sum_m = shift_m(connection)? + moved_m;
    schema::make_further(connection, NAME, TABLE)?;
    connection.execute("INSERT OR REPLACE INTO odograph_mosaic_shift VALUES (1, ?1)", [sum_m]).map(drop)
}

/// The sum of the moves since the mosaic was rendered, metres.
pub(super) fn shift_m(connection: &Connection) -> Result<f64> {
    if !schema::has_further(connection, NAME, TABLE)? {
        return Ok(0.0);
    }
    let select = "SELECT shift_m FROM odograph_mosaic_shift WHERE id = 1";
    Ok(connection.query_row(select, [], |row| row.get(0)).optional()?.unwrap_or(0.0))
}

/// Forgets the moves: another mosaic is rendered.
pub(super) fn reset(connection: &Connection) -> Result<()> {
    if schema::has_further(connection, NAME, TABLE)? {
        connection.execute("DELETE FROM odograph_mosaic_shift", [])?;
    }
    Ok(())
}
