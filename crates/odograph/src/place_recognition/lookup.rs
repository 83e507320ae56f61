//! Locality-sensitive hash tables of descriptors.

/// Number of hash tables; each uses other bits of a descriptor.
const TABLES: usize = 8;

/// Bits of an address: with 3 million features a bucket holds about a dozen.
const ADDRESS_BITS: u32 = 18;

/// Features in a piece of a bucket: with their sketches a piece fills a cache line.
const PIECE: usize = 7;

/// Maximum Hamming distance of the 32-bit sketches of similar descriptors. It rejects nine in ten
/// unrelated ones, and three in a hundred of those that differ in 60 of 256 bits, the most that
/// counts as similar.
const MAX_SKETCH_DIFFERENCE: u32 = 12;

/// No further piece.
const NONE: u32 = u32::MAX;

/// Which feature: of which slot, and which of its features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct FeatureNumber(u32);

impl FeatureNumber {
    /// Features of a slot are below 2⁹, slots below 2²³.
    pub const FEATURE_BITS: u32 = 9;
    /// Maximum number of slots.
    pub const MAX_SLOTS: usize = 1 << (32 - Self::FEATURE_BITS);

    pub fn new(slot: usize, feature: usize) -> Self {
        Self((slot << Self::FEATURE_BITS | feature) as u32)
    }

    pub fn slot(self) -> usize {
        (self.0 >> Self::FEATURE_BITS) as usize
    }

    pub fn feature(self) -> usize {
        (self.0 & ((1 << Self::FEATURE_BITS) - 1)) as usize
    }
}

/// All tables. A bucket is a chain of pieces, taken from one pool and given back to it.
#[derive(Debug, Clone)]
pub(super) struct Buckets {
    /// Table after table.
    buckets: Vec<Bucket>,
    pieces: Vec<Piece>,
    /// The first of the pieces that are not in use.
    spare: u32,
}

#[derive(Debug, Clone, Copy)]
struct Bucket {
    features: u32,
    /// Its newest piece, the only one that may not be full.
    newest: u32,
}

#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Piece {
    features: [FeatureNumber; PIECE],
    /// A sketch of each descriptor, so that most dissimilar ones need not be fetched.
    sketches: [u32; PIECE],
    older: u32,
}

/// A bucket that a descriptor of the query leads to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Address {
    /// Number of features in the bucket. First, so that emptier ones sort first.
    pub features: u32,
    /// Which feature of the query led there.
    pub query: u32,
    bucket: u32,
}

/// Bits that are no part of an address, four of each half word.
fn sketch(descriptor: &[u64; 4]) -> u32 {
    let bits = |word: u64| (word >> ADDRESS_BITS & 0xf | (word >> (32 + ADDRESS_BITS) & 0xf) << 4) as u32;
    descriptor.iter().enumerate().fold(0, |sketch, (at, &word)| sketch | bits(word) << (8 * at))
}

fn addresses(descriptor: &[u64; 4]) -> [usize; TABLES] {
    std::array::from_fn(|table| {
        let part = descriptor[table / 2] >> (32 * (table % 2));
        table << ADDRESS_BITS | (part & ((1 << ADDRESS_BITS) - 1)) as usize
    })
}

impl Buckets {
    pub fn new() -> Self {
        let empty = Bucket { features: 0, newest: NONE };
        Self { buckets: vec![empty; TABLES << ADDRESS_BITS], pieces: Vec::new(), spare: NONE }
    }

    pub fn insert(&mut self, descriptor: &[u64; 4], number: FeatureNumber) {
        let sketch = sketch(descriptor);
        for at in addresses(descriptor) {
            let used = self.buckets[at].features as usize % PIECE;
            if used == 0 {
                let older = self.buckets[at].newest;
                self.buckets[at].newest = self.take_piece(older);
            }
            let bucket = &mut self.buckets[at];
            let piece = &mut self.pieces[bucket.newest as usize];
            (piece.features[used], piece.sketches[used]) = (number, sketch);
            bucket.features += 1;
        }
    }

    /// Removes what [`Buckets::insert`] added.
    pub fn remove(&mut self, descriptor: &[u64; 4], number: FeatureNumber) {
        for at in addresses(descriptor) {
            let Bucket { features, newest } = self.buckets[at];
            let Some((piece, place)) = self.position(at, number) else { continue };
            // The last one takes its place.
            let used = (features as usize - 1) % PIECE;
            let last = &self.pieces[newest as usize];
            let (feature, sketch) = (last.features[used], last.sketches[used]);
            let piece = &mut self.pieces[piece];
            (piece.features[place], piece.sketches[place]) = (feature, sketch);
            self.buckets[at].features -= 1;
            if used == 0 {
                self.buckets[at].newest = self.pieces[newest as usize].older;
                self.pieces[newest as usize].older = self.spare;
                self.spare = newest;
            }
        }
    }

    fn take_piece(&mut self, older: u32) -> u32 {
        if self.spare == NONE {
            let (features, sketches) = ([FeatureNumber(NONE); PIECE], [0; PIECE]);
            self.pieces.push(Piece { features, sketches, older });
            return self.pieces.len() as u32 - 1;
        }
        let taken = self.spare;
        let piece = &mut self.pieces[taken as usize];
        self.spare = piece.older;
        piece.older = older;
        taken
    }

    fn position(&self, bucket: usize, number: FeatureNumber) -> Option<(usize, usize)> {
        self.runs(bucket).find_map(|(piece, features)| {
            features.iter().position(|&other| other == number).map(|place| (piece, place))
        })
    }

    /// The pieces of a bucket, with what is used of each.
    fn runs(&self, bucket: usize) -> impl Iterator<Item = (usize, &[FeatureNumber])> {
        let Bucket { features, newest } = self.buckets[bucket];
        let mut used = used_of_newest(features);
        let mut at = newest;
        std::iter::from_fn(move || {
            let number = at as usize;
            let piece = self.pieces.get(number)?;
            let features = &piece.features[..used];
            (at, used) = (piece.older, PIECE);
            Some((number, features))
        })
    }

    /// The buckets, not empty, that a descriptor of the query leads to.
    pub fn lead(&self, query: usize, descriptor: &[u64; 4]) -> impl Iterator<Item = Address> {
        addresses(descriptor).into_iter().filter_map(move |bucket| {
            let features = self.buckets[bucket].features;
            (features > 0).then_some(Address { features, query: query as u32, bucket: bucket as u32 })
        })
    }

    /// The features of buckets with similar sketches, with the query's feature of each.
    ///
    /// Most of it is not in the processor's caches, so reading it in sequence is mostly waiting.
    /// The newest pieces of many buckets are read together, then the next older of all of them, and
    /// so on: within a round no read waits for another.
    pub fn alike(&self, addresses: &[Address], query: &[[u64; 4]]) -> Vec<(FeatureNumber, u32)> {
        const AT_ONCE: usize = 32;
        let sketches: Vec<u32> = query.iter().map(sketch).collect();
        let mut alike = Vec::new();
        let mut open: Vec<(u32, usize, u32)> = Vec::with_capacity(AT_ONCE);
        for addresses in addresses.chunks(AT_ONCE) {
            let begin = |address: &Address| {
                let Bucket { features, newest } = self.buckets[address.bucket as usize];
                (newest, used_of_newest(features), address.query)
            };
            open.extend(addresses.iter().map(begin).filter(|&(piece, ..)| piece != NONE));
            while !open.is_empty() {
                let older: [u32; AT_ONCE] = std::array::from_fn(|at| {
                    open.get(at).map_or(NONE, |&(piece, ..)| self.pieces[piece as usize].older)
                });
                for &(piece, used, number) in &open {
                    let piece = &self.pieces[piece as usize];
                    let own = sketches[number as usize];
                    let near =
                        piece.sketches.map(|sketch| (sketch ^ own).count_ones() <= MAX_SKETCH_DIFFERENCE);
                    for (&feature, _) in piece.features[..used].iter().zip(near).filter(|(_, near)| *near) {
                        alike.push((feature, number));
                    }
                }
                let mut at = 0;
                open.retain_mut(|(piece, used, _)| {
                    (*piece, *used) = (older[at], PIECE);
                    at += 1;
                    *piece != NONE
                });
            }
        }
        alike
    }
}

/// Number of used places in the newest piece of a bucket with this number of features.
fn used_of_newest(features: u32) -> usize {
    match features as usize % PIECE {
        0 => PIECE,
        rest => rest,
    }
}

/// Hamming distance of two descriptors, if at most `most`. Most unrelated ones are rejected by the
/// first half: its limit is two thirds of `most`, while half of it is expected of similar ones.
#[inline]
pub(super) fn difference(a: &[u64; 4], b: &[u64; 4], most: u32) -> Option<u32> {
    let differing = |word: usize| (a[word] ^ b[word]).count_ones();
    let first = differing(0) + differing(1);
    if 3 * first > 2 * most {
        return None;
    }
    let all = first + differing(2) + differing(3);
    (all <= most).then_some(all)
}
