//! Tables of the tile pyramid (OGC 12-128, clause 2.2).

use super::{MosaicLayer, staleness};
use crate::geopackage::{self, Extent, UNDEFINED_CARTESIAN};
use odograph::mosaic::{MOSAIC_TILE_PX, MosaicTile};
use rusqlite::{Connection, Result, params};
use std::ops::Range;

const SIDE: i64 = MOSAIC_TILE_PX as i64;

/// The pyramid while its finest level is written.
pub(super) struct TilePyramid {
    finest: u32,
    resolution_m: f64,
    /// Tile column and row of the upper left corner, relative to the world's origin.
    first: (i64, i64),
    /// Bounding box of the pixels that show ground, relative to the upper left corner: minimum and
    /// maximum column, minimum and maximum row.
    shown: Option<[i64; 4]>,
}

impl TilePyramid {
    /// Deletes the stored pyramid and starts one of 2ⁿ × 2ⁿ tiles that includes the given tile
    /// columns and rows at the given resolution, metres per pixel.
    pub fn begin(
        connection: &Connection,
        (columns, rows): (Range<i64>, Range<i64>),
        resolution_m: f64,
    ) -> Result<Self> {
        clear(connection)?;
        let tiles = (columns.end - columns.start).max(rows.end - rows.start).max(1);
        let finest = (tiles as u64).next_power_of_two().trailing_zeros();
        Ok(Self { finest, resolution_m, first: (columns.start, rows.start), shown: None })
    }

    pub fn finest(&self) -> u32 {
        self.finest
    }

    /// Column and row of the upper left tile, relative to the world's origin.
    pub fn first(&self) -> (i64, i64) {
        self.first
    }

    /// Whether any pixel shows ground.
    pub fn has_ground(&self) -> bool {
        self.shown.is_some()
    }

    /// Writes a tile of the finest level.
    pub fn put(&mut self, connection: &Connection, tile: &MosaicTile, png: &[u8]) -> Result<()> {
        let (column, row) = (tile.column - self.first.0, tile.row - self.first.1);
        let side = MOSAIC_TILE_PX;
        for (y, line) in tile.rgba.chunks_exact(4 * side).enumerate() {
            let opaque = |x: &usize| line[4 * x + 3] > 0;
            let (Some(left), Some(right)) = ((0..side).find(opaque), (0..side).rev().find(opaque)) else {
                continue;
            };
            let (x, y) = (column * SIDE, row * SIDE + y as i64);
            let (left, right) = (x + left as i64, x + right as i64);
            let [a, b, c, d] = self.shown.unwrap_or([left, right, y, y]);
            self.shown = Some([a.min(left), b.max(right), c.min(y), d.max(y)]);
        }
        insert(connection, self.finest, column as u64, row as u64, png)
    }

    /// Registers the levels, after all of them have been written.
    pub fn finish(&self, connection: &Connection) -> Result<()> {
        let side_m = SIDE as f64 * self.resolution_m;
        let (left, top) = (self.first.0 as f64 * side_m, -(self.first.1 as f64) * side_m);
        let whole_m = side_m * (1_u64 << self.finest) as f64;
        connection.execute(
            "INSERT INTO gpkg_tile_matrix_set VALUES ('mosaic', ?1, ?2, ?3, ?4, ?5)",
            params![UNDEFINED_CARTESIAN, left, top - whole_m, left + whole_m, top],
        )?;
        for level in 0..=self.finest {
            let tiles = 1_u64 << level;
            let pixel_m = whole_m / (tiles * MOSAIC_TILE_PX as u64) as f64;
            connection.execute(
                "INSERT INTO gpkg_tile_matrix VALUES ('mosaic', ?1, ?2, ?2, ?3, ?3, ?4, ?4)",
                params![level, tiles, SIDE, pixel_m],
            )?;
        }
        let extent = self.shown.map(|[a, b, c, d]| {
            let (x, y) =
                (|k: i64| left + k as f64 * self.resolution_m, |k: i64| top - k as f64 * self.resolution_m);
            Extent([x(a), y(d + 1), x(b + 1), y(c)])
        });
        geopackage::set_extent(connection, "mosaic", extent)
    }
}

/// Removes all tiles and levels.
fn clear(connection: &Connection) -> Result<()> {
    for sql in [
        "DELETE FROM mosaic",
        "DELETE FROM gpkg_tile_matrix WHERE table_name = 'mosaic'",
        "DELETE FROM gpkg_tile_matrix_set WHERE table_name = 'mosaic'",
    ] {
        connection.execute(sql, [])?;
    }
    staleness::reset(connection)
}

/// Removes the finest level of a pyramid; everything where it is the only one.
pub(super) fn remove_finest(connection: &Connection, layer: &MosaicLayer) -> Result<()> {
    let Some(next) = layer.finest.checked_sub(1) else {
        clear(connection)?;
        return geopackage::set_extent(connection, "mosaic", None);
    };
    connection.execute("DELETE FROM mosaic WHERE zoom_level > ?1", [next])?;
    connection
        .execute("DELETE FROM gpkg_tile_matrix WHERE table_name = 'mosaic' AND zoom_level > ?1", [next])?;
    // The extent is of whole pixels of the level that is the finest now.
    let pixel_m = 2.0 * layer.resolution_m;
    let [left, right] = [layer.columns.start / 2, layer.columns.end.div_ceil(2)];
    let [top, bottom] = [layer.rows.start / 2, layer.rows.end.div_ceil(2)];
    let (x, y) = (|k: u64| layer.left_m + k as f64 * pixel_m, |k: u64| layer.top_m - k as f64 * pixel_m);
    geopackage::set_extent(connection, "mosaic", Some(Extent([x(left), y(bottom), x(right), y(top)])))
}

/// Size of all tiles, bytes.
pub(super) fn bytes(connection: &Connection) -> Result<u64> {
    connection.query_row("SELECT ifnull(sum(length(tile_data)), 0) FROM mosaic", [], |row| row.get(0))
}

/// Writes a tile.
pub(super) fn insert(connection: &Connection, level: u32, column: u64, row: u64, png: &[u8]) -> Result<()> {
    connection
        .prepare_cached("INSERT INTO mosaic VALUES (NULL, ?1, ?2, ?3, ?4)")?
        .execute(params![level, column, row, png])?;
    Ok(())
}

/// Reads the PNG of a tile.
pub(super) fn select(connection: &Connection, level: u32, column: u64, row: u64) -> Result<Vec<u8>> {
    connection
        .prepare_cached(
            "SELECT tile_data FROM mosaic WHERE zoom_level = ?1 AND tile_column = ?2 AND tile_row = ?3",
        )?
        .query_row(params![level, column, row], |row| row.get(0))
}

/// Tiles of a level that show ground, as (column, row), row by row.
pub(super) fn tiles(connection: &Connection, level: u32) -> Result<Vec<(u64, u64)>> {
    let side = 1_i64 << level;
    let mut statement = connection.prepare(
        "SELECT tile_column, tile_row FROM mosaic WHERE zoom_level = ?1 AND tile_column >= 0 AND tile_column < ?2 \
         AND tile_row >= 0 AND tile_row < ?2 ORDER BY tile_row, tile_column",
    )?;
    let rows = statement.query_map(params![level, side], |row| Ok((row.get(0)?, row.get(1)?)))?;
    rows.collect()
}

/// Tiles of a level that have a child in the next finer level.
pub(super) fn parents(connection: &Connection, level: u32) -> Result<Vec<(u64, u64)>> {
    let mut statement = connection.prepare(
        "SELECT DISTINCT tile_column / 2, tile_row / 2 FROM mosaic WHERE zoom_level = ?1 ORDER BY 2, 1",
    )?;
    let rows = statement.query_map([level + 1], |row| Ok((row.get(0)?, row.get(1)?)))?;
    rows.collect()
}

/// Reads the geometry of the pyramid.
pub(super) fn layer(connection: &Connection) -> Result<MosaicLayer> {
    let (left_m, top_m): (f64, f64) = connection.query_row(
        "SELECT min_x, max_y FROM gpkg_tile_matrix_set WHERE table_name = 'mosaic'",
        [],
        |row| Ok((row.get(0)?, row.get(1)?)),
    )?;
    let (finest, resolution_m): (u32, f64) = connection.query_row(
        "SELECT zoom_level, pixel_x_size FROM gpkg_tile_matrix WHERE table_name = 'mosaic' ORDER BY zoom_level DESC LIMIT 1",
        [],
        |row| Ok((row.get(0)?, row.get(1)?)),
    )?;
    let [min_x, min_y, max_x, max_y]: [f64; 4] = connection.query_row(
        "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = 'mosaic'",
        [],
        |row| Ok([row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?]),
    )?;
    let pixel = |metres: f64| (metres / resolution_m).round() as u64;
    Ok(MosaicLayer {
        finest,
        resolution_m,
        left_m,
        top_m,
        columns: pixel(min_x - left_m)..pixel(max_x - left_m),
        rows: pixel(top_m - max_y)..pixel(top_m - min_y),
    })
}
