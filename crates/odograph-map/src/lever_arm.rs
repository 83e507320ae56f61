//! The lever arm of a map's rig: a table of its own, which only maps with a lever arm have.

use crate::schema;
use odograph::camera::LeverArm;
use rusqlite::{Connection, OptionalExtension, params};

const TABLE: &str = "CREATE TABLE odograph_lever_arm (id INTEGER PRIMARY KEY CHECK (id = 1), x_m DOUBLE NOT NULL, \
                     y_m DOUBLE NOT NULL, z_m DOUBLE NOT NULL)";

/// Writes the table.
pub(crate) fn write(connection: &Connection, arm: &LeverArm) -> rusqlite::Result<()> {
    schema::make_further(connection, "odograph_lever_arm", TABLE)?;
    connection.execute(
        "INSERT INTO odograph_lever_arm VALUES (1, ?1, ?2, ?3)",
        params![arm.x_m, arm.y_m, arm.z_m],
    )?;
    Ok(())
}

/// Reads it; `None` where there is no such table.
pub(crate) fn read(connection: &Connection) -> rusqlite::Result<Option<LeverArm>> {
    if !schema::has_further(connection, "odograph_lever_arm", TABLE)? {
        return Ok(None);
    }
    connection
        .query_row("SELECT x_m, y_m, z_m FROM odograph_lever_arm WHERE id = 1", [], |row| {
            Ok(LeverArm { x_m: row.get(0)?, y_m: row.get(1)?, z_m: row.get(2)? })
        })
        .optional()
}
