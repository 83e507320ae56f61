//! Losses in the map file, in a table that only maps with a session that was lost somewhere have:
//! when the camera could not be followed, and why.

use crate::complaint::{Complaint, WithContext};
use crate::row_order::in_order;
use crate::schema;
use odograph::error::Result;
use odograph::trajectory::{LossReason, LostStretch};
use rusqlite::{Connection, params};

const NAME: &str = "odograph_loss";
const TABLE: &str = "CREATE TABLE odograph_loss (session INTEGER NOT NULL, number INTEGER NOT NULL, start_s DOUBLE NOT NULL, end_s DOUBLE NOT NULL, \
                     frames INTEGER NOT NULL, reasons TEXT NOT NULL, PRIMARY KEY (session, number)) WITHOUT ROWID";

/// Replaces the losses of a session.
pub(crate) fn write(connection: &Connection, session: u32, losses: &[LostStretch]) -> rusqlite::Result<()> {
    if !losses.is_empty() {
        schema::make_further(connection, NAME, TABLE)?;
    } else if !schema::has_further(connection, NAME, TABLE)? {
        return Ok(());
    }
    connection.execute("DELETE FROM odograph_loss WHERE session = ?1", [session])?;
    let mut insert =
        connection.prepare_cached("INSERT INTO odograph_loss VALUES (?1, ?2, ?3, ?4, ?5, ?6)")?;
    for (number, LostStretch { from_s, to_s, frames, reasons }) in losses.iter().enumerate() {
        let names: Vec<&str> = reasons.iter().map(|reason| reason.name()).collect();
        insert.execute(params![session, number, from_s, to_s, frames, names.join(" ")])?;
    }
    Ok(())
}

/// The losses of a session in order.
pub(crate) fn read(connection: &Connection, session: u32, complaint: &Complaint) -> Result<Vec<LostStretch>> {
    if !schema::has_further(connection, NAME, TABLE).while_reading(complaint)? {
        return Ok(Vec::new());
    }
    let select = "SELECT number, start_s, end_s, frames, reasons FROM odograph_loss WHERE session = ?1 ORDER BY number";
    let mut statement = connection.prepare(select).while_reading(complaint)?;
    let rows = statement
        .query_map([session], in_order(|row| Ok((row.get(1)?, row.get(2)?, row.get(3)?, row.get(4)?))))
        .while_reading(complaint)?;
    rows.map(|row| {
        let (from_s, to_s, frames, names): (f64, f64, u64, String) = row.while_reading(complaint)?;
        let reasons: Option<Vec<LossReason>> = names.split_whitespace().map(LossReason::named).collect();
        match reasons.filter(|_| from_s.is_finite() && to_s.is_finite() && from_s <= to_s) {
            Some(reasons) => Ok(LostStretch { from_s, to_s, frames, reasons }),
            None => Err(complaint.damage(format!("session {session} has a loss that cannot be one"))),
        }
    })
    .collect()
}
