//! The order of rows, which shows damage that SQLite does not see.
//!
//! In a damaged or malicious file pages may refer to the same pages again, so that a table of a few
//! kilobytes has more rows than anyone can read. Their keys are not in order then.

use rusqlite::{Error, Result, Row, ffi};

/// Checks that the keys of rows ascend, or with `descending` descend.
#[derive(Debug, Default)]
pub(crate) struct RowOrder {
    last: Option<i64>,
    descending: bool,
}

impl RowOrder {
    /// For rows from the highest key to the lowest.
    pub fn descending() -> Self {
        Self { descending: true, ..Self::default() }
    }

    /// Takes the key of the next row. Fails, as SQLite does of a damaged file, if it is not beyond
    /// the one before.
    pub fn check(&mut self, key: i64) -> Result<()> {
        let is_beyond = |last: i64| if self.descending { key < last } else { key > last };
        if self.last.replace(key).is_none_or(is_beyond) {
            return Ok(());
        }
        Err(Error::SqliteFailure(
            ffi::Error::new(ffi::SQLITE_CORRUPT),
            Some("its rows are not in order".to_owned()),
        ))
    }
}

/// Reads rows whose first column is their key, and fails if the keys do not ascend.
pub(crate) fn in_order<T>(mut read: impl FnMut(&Row<'_>) -> Result<T>) -> impl FnMut(&Row<'_>) -> Result<T> {
    let mut order = RowOrder::default();
    move |row| {
        order.check(row.get(0)?)?;
        read(row)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_that_comes_again_is_damage() {
        let fails = |mut order: RowOrder, keys: [i64; 3]| keys.iter().any(|&key| order.check(key).is_err());
        assert!(!fails(RowOrder::default(), [i64::MIN, -1, i64::MAX]));
        assert!(fails(RowOrder::default(), [1, 2, 2]));
        assert!(!fails(RowOrder::descending(), [3, 2, 0]));
        assert!(fails(RowOrder::descending(), [3, 2, 4]));
    }
}
