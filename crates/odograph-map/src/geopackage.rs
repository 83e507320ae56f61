//! GeoPackage part of the database: geometry blobs and metadata tables (OGC 12-128r17, version
//! 1.3).

use rusqlite::{Connection, Result, params};

/// "GPKG" (requirement 2).
pub(crate) const APPLICATION_ID: i32 = 0x4750_4b47;
/// Version 1.3.0 (requirement 2).
pub(crate) const USER_VERSION: i32 = 10_300;
/// Spatial reference system without a position on Earth, in metres: "undefined Cartesian"
/// (requirement 11).
pub(crate) const UNDEFINED_CARTESIAN: i32 = -1;

/// Constant timestamp of the last change of a layer: no clock is read, so the same recording
/// produces the same file.
pub(crate) const NO_TIME: &str = "1970-01-01T00:00:00.000Z";

/// Bounding box: minimum x, minimum y, maximum x, maximum y, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Extent(pub [f64; 4]);

impl Extent {
    /// Bounding box of points; `None` without points.
    pub fn of(points: impl IntoIterator<Item = (f64, f64)>) -> Option<Self> {
        points.into_iter().map(|(x, y)| Self([x, y, x, y])).reduce(Self::with)
    }

    fn with(self, other: Self) -> Self {
        let (Self([a, b, c, d]), Self([e, f, g, h])) = (self, other);
        Self([a.min(e), b.min(f), c.max(g), d.max(h)])
    }
}

/// A point as GeoPackage geometry (clause 2.1.3): header without envelope, then well-known binary
/// (WKB).
pub(crate) fn point_geometry(x_m: f64, y_m: f64) -> Vec<u8> {
    let mut bytes = header(0);
    bytes.extend_from_slice(&[1, 1, 0, 0, 0]);
    [x_m, y_m].iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    bytes
}

/// A line as GeoPackage geometry: header with envelope (x, x, y, y), then well-known binary (WKB).
pub(crate) fn line_geometry(points: &[(f64, f64)]) -> Vec<u8> {
    let mut bytes = header(1);
    let Extent([left, bottom, right, top]) = Extent::of(points.iter().copied()).unwrap_or(Extent([0.0; 4]));
    [left, right, bottom, top].iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    bytes.extend_from_slice(&[1, 2, 0, 0, 0]);
    bytes.extend_from_slice(&(points.len() as u32).to_le_bytes());
    for (x, y) in points {
        bytes.extend_from_slice(&x.to_le_bytes());
        bytes.extend_from_slice(&y.to_le_bytes());
    }
    bytes
}

/// Magic number, version 0, flags (little-endian, envelope type), reference system.
fn header(envelope: u8) -> Vec<u8> {
    let mut bytes = vec![b'G', b'P', 0, 1 | (envelope << 1)];
    bytes.extend_from_slice(&UNDEFINED_CARTESIAN.to_le_bytes());
    bytes
}

/// Writes the three reference systems required in every GeoPackage (requirement 11).
pub(crate) fn write_reference_systems(connection: &Connection) -> Result<()> {
    let wgs84 = "GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563,AUTHORITY[\"EPSG\",\"7030\"]],\
                 AUTHORITY[\"EPSG\",\"6326\"]],PRIMEM[\"Greenwich\",0,AUTHORITY[\"EPSG\",\"8901\"]],UNIT[\"degree\",\
                 0.0174532925199433,AUTHORITY[\"EPSG\",\"9122\"]],AUTHORITY[\"EPSG\",\"4326\"]]";
    let systems = [
        ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "metres in the plane of the map"),
        ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinates"),
        ("WGS 84 geodetic", 4326, "EPSG", 4326, wgs84, "longitude and latitude, degrees"),
    ];
    for (name, id, organization, coordsys, definition, description) in systems {
        connection.execute(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
            params![name, id, organization, coordsys, definition, description],
        )?;
    }
    Ok(())
}

/// Registers a layer (clause 1.1.3).
pub(crate) fn list_layer(
    connection: &Connection,
    table: &str,
    data_type: &str,
    description: &str,
) -> Result<()> {
    connection.execute(
        "INSERT INTO gpkg_contents VALUES (?1, ?2, ?1, ?3, ?4, NULL, NULL, NULL, NULL, ?5)",
        params![table, data_type, description, NO_TIME, UNDEFINED_CARTESIAN],
    )?;
    Ok(())
}

/// Registers the geometry column of a layer (clause 2.1.5).
pub(crate) fn list_geometry(connection: &Connection, table: &str, geometry: &str) -> Result<()> {
    connection.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?1, 'geom', ?2, ?3, 0, 0)",
        params![table, geometry, UNDEFINED_CARTESIAN],
    )?;
    Ok(())
}

/// Extends the bounding box of a layer.
pub(crate) fn grow_extent(connection: &Connection, table: &str, extent: Extent) -> Result<()> {
    let Extent([left, bottom, right, top]) = extent;
    connection
        .prepare_cached(
            "UPDATE gpkg_contents SET min_x = min(ifnull(min_x, ?2), ?2), min_y = min(ifnull(min_y, ?3), ?3), \
             max_x = max(ifnull(max_x, ?4), ?4), max_y = max(ifnull(max_y, ?5), ?5) WHERE table_name = ?1",
        )?
        .execute(params![table, left, bottom, right, top])?;
    Ok(())
}

/// Sets the bounding box of a layer; `None` for an empty layer.
pub(crate) fn set_extent(connection: &Connection, table: &str, extent: Option<Extent>) -> Result<()> {
    let [left, bottom, right, top] = extent.map_or([None; 4], |Extent(sides)| sides.map(Some));
    connection.execute(
        "UPDATE gpkg_contents SET min_x = ?2, min_y = ?3, max_x = ?4, max_y = ?5 WHERE table_name = ?1",
        params![table, left, bottom, right, top],
    )?;
    Ok(())
}
