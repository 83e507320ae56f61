//! The stored ground: square tiles of pixels, only where something was seen.

use std::collections::BTreeMap;
use std::ops::Range;

/// Side of a tile, ground pixels.
pub(super) const TILE: i64 = 256;
const SIDE: usize = TILE as usize;

/// Red, green, blue and weight; weight 0 is ground not seen yet.
type WeightedTile = Vec<[u8; 4]>;

/// All tiles, by row (against world y) and column (along world x).
#[derive(Debug, Clone, Default)]
pub(super) struct Tiles {
    index: BTreeMap<(i64, i64), usize>,
    tiles: Vec<WeightedTile>,
    /// The revision in which each tile last changed.
    changed: Vec<u64>,
    revision: u64,
}

/// The tile looked up last, since the next one asked for is mostly the same.
pub(super) struct Lookup {
    last: Option<((i64, i64), usize)>,
}

impl Lookup {
    pub fn new() -> Self {
        Self { last: None }
    }
}

impl Tiles {
    pub fn count(&self) -> usize {
        self.tiles.len()
    }

    /// Begins a new revision, to which later changes belong.
    pub fn begin_revision(&mut self) {
        self.revision += 1;
    }

    /// Number of revisions.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Rows and columns of the tiles changed after `revision`.
    pub fn changed_since(&self, revision: u64) -> impl Iterator<Item = (i64, i64)> {
        self.index.iter().filter(move |&(_, &slot)| self.changed[slot] > revision).map(|(&key, _)| key)
    }

    /// The tile that holds a ground pixel, made where there was none.
    pub fn at(&mut self, lookup: &mut Lookup, column: i64, row: i64) -> &mut [[u8; 4]] {
        let key = (row.div_euclid(TILE), column.div_euclid(TILE));
        let slot = match lookup.last {
            Some((known, slot)) if known == key => slot,
            _ => *self.index.entry(key).or_insert_with(|| {
                self.tiles.push(vec![[0; 4]; SIDE * SIDE]);
                self.changed.push(0);
                self.tiles.len() - 1
            }),
        };
        if lookup.last.is_none_or(|(known, _)| known != key) {
            self.changed[slot] = self.revision;
        }
        lookup.last = Some((key, slot));
        &mut self.tiles[slot]
    }

    /// Whether there is a tile.
    pub fn contains(&self, row: i64, column: i64) -> bool {
        self.index.contains_key(&(row, column))
    }

    fn pixel(&self, column: i64, row: i64) -> [u8; 4] {
        let slot = self.index.get(&(row.div_euclid(TILE), column.div_euclid(TILE)));
        slot.map_or([0; 4], |&slot| {
            self.tiles[slot][row.rem_euclid(TILE) as usize * SIDE + column.rem_euclid(TILE) as usize]
        })
    }

    /// The weight of a ground pixel, 0 where it was not seen.
    pub fn weight(&self, column: i64, row: i64) -> u8 {
        self.pixel(column, row)[3]
    }

    /// The colour of a ground pixel, `None` where it was not seen.
    pub fn colour(&self, column: i64, row: i64) -> Option<[u8; 3]> {
        let [red, green, blue, weight] = self.pixel(column, row);
        (weight > 0).then_some([red, green, blue])
    }

    /// The same ground with pixels of twice the side: the weighted mean of the up to four that were
    /// seen.
    pub fn halved(&self) -> Self {
        let mut halved = Self { revision: self.revision + 1, ..Self::default() };
        let mut lookup = Lookup::new();
        for (&(row, column), &slot) in &self.index {
            let tile = &self.tiles[slot];
            let (left, top) = (column * TILE / 2, row * TILE / 2);
            let into = halved.at(&mut lookup, left, top);
            let start = top.rem_euclid(TILE) as usize * SIDE + left.rem_euclid(TILE) as usize;
            for y in 0..SIDE / 2 {
                for x in 0..SIDE / 2 {
                    let at = 2 * y * SIDE + 2 * x;
                    into[start + y * SIDE + x] =
                        mean([tile[at], tile[at + 1], tile[at + SIDE], tile[at + SIDE + 1]]);
                }
            }
        }
        halved
    }

    /// The least ranges of columns and rows that hold all ground seen; `None` where there is none.
    pub fn extent(&self) -> Option<(Range<i64>, Range<i64>)> {
        let mut extent: Option<[i64; 4]> = None;
        for (&(row, column), &slot) in &self.index {
            for (line, y) in self.tiles[slot].chunks_exact(SIDE).zip(row * TILE..) {
                let seen = |pixel: &[u8; 4]| pixel[3] > 0;
                let (Some(first), Some(last)) = (line.iter().position(seen), line.iter().rposition(seen))
                else {
                    continue;
                };
                let (from, to) = (column * TILE + first as i64, column * TILE + last as i64);
                let [left, right, top, bottom] = extent.unwrap_or([from, to, y, y]);
                extent = Some([left.min(from), right.max(to), top.min(y), bottom.max(y)]);
            }
        }
        extent.map(|[left, right, top, bottom]| (left..right + 1, top..bottom + 1))
    }

    /// A rectangle of ground as red, green, blue and opacity; white and transparent where it was
    /// not seen.
    pub fn rgba(&self, columns: &Range<i64>, rows: &Range<i64>) -> Vec<u8> {
        let (width, height) = ((columns.end - columns.start) as usize, (rows.end - rows.start) as usize);
        let mut rgba = [255, 255, 255, 0].repeat(width * height);
        let tile_rows = (rows.start.div_euclid(TILE), i64::MIN)..=((rows.end - 1).div_euclid(TILE), i64::MAX);
        for (&(row, column), &slot) in self.index.range(tile_rows) {
            let tile = &self.tiles[slot];
            let (left, top) = (column * TILE, row * TILE);
            if left >= columns.end || left + TILE <= columns.start {
                continue;
            }
            let (from, to) = (left.max(columns.start), (left + TILE).min(columns.end));
            for y in top.max(rows.start)..(top + TILE).min(rows.end) {
                for x in from..to {
                    let [red, green, blue, weight] = tile[(y - top) as usize * SIDE + (x - left) as usize];
                    if weight > 0 {
                        let at = 4 * ((y - rows.start) as usize * width + (x - columns.start) as usize);
                        rgba[at..at + 4].copy_from_slice(&[red, green, blue, 255]);
                    }
                }
            }
        }
        rgba
    }
}

fn mean(pixels: [[u8; 4]; 4]) -> [u8; 4] {
    let weight: u32 = pixels.iter().map(|p| u32::from(p[3])).sum();
    if weight == 0 {
        return [0; 4];
    }
    let channel = |c: usize| {
        let sum: u32 = pixels.iter().map(|p| u32::from(p[c]) * u32::from(p[3])).sum();
        ((sum + weight / 2) / weight) as u8
    };
    let heaviest = pixels.iter().map(|p| p[3]).max().unwrap_or(0);
    [channel(0), channel(1), channel(2), heaviest]
}
