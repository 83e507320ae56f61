//! The map file: one SQLite database that is also a GeoPackage, so that what was seen of the ground survives the program and opens in the
//! tools that people have.
