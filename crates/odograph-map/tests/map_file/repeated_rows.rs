//! Map files whose pages refer to each other.

use std::path::Path;

/// Makes a table of a few rows one of more rows than can be read: its root becomes the first of
/// three pages that each refer 300 times to the next, and the last of these to the page with the
/// rows.
pub fn repeat_rows(path: &Path, table: &str) {
    let connection = rusqlite::Connection::open(path).unwrap();
    let sql = "SELECT rootpage FROM sqlite_schema WHERE name = ?1";
    let root: usize = connection.query_row(sql, [table], |row| row.get(0)).unwrap();
    connection.close().unwrap();
    let mut bytes = std::fs::read(path).unwrap();
    let pages = bytes.len() / 4096;
    let place = 4096 * (root - 1)..4096 * root;
    let rows = bytes[place.clone()].to_vec();
    // File format of SQLite, 1.6: an interior page of a table.
    let referring = |to: usize| {
        let to = u32::try_from(to).unwrap().to_be_bytes();
        let mut page = vec![5, 0, 0, 1, 44, 0, 0, 0];
        page.extend(to);
        // Cells of five bytes at the end: a page number and a key.
        let first = 4096 - 5 * 300;
        page[5..7].copy_from_slice(&(first as u16).to_be_bytes());
        (0..300_u16).for_each(|cell| page.extend((first as u16 + 5 * cell).to_be_bytes()));
        page.resize(first, 0);
        (0..300).for_each(|_| page.extend(to.into_iter().chain([127])));
        page
    };
    bytes.extend(rows);
    bytes.extend(referring(pages + 1));
    bytes.extend(referring(pages + 2));
    bytes[place].copy_from_slice(&referring(pages + 3));
    bytes[28..32].copy_from_slice(&u32::try_from(pages + 3).unwrap().to_be_bytes());
    std::fs::write(path, bytes).unwrap();
}
