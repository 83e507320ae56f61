//! The records of a run, in blocks.

use odograph::formats::track_record::TrackRecord;

/// The records of all frames, 60 bytes each. They are stored in blocks, so that appending never
/// copies old records and no more than one block is allocated in advance.
#[derive(Default)]
pub(crate) struct TrackRecords {
    pieces: Vec<Vec<f32>>,
    count: usize,
}

impl TrackRecords {
    /// Records in a block, which is also the maximum in one message.
    pub const IN_A_PIECE: usize = 8192;

    /// Number of records.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Appends the record of the next frame.
    pub fn push(&mut self, record: &TrackRecord) {
        if self.count.is_multiple_of(Self::IN_A_PIECE) {
            self.pieces.push(Vec::with_capacity(Self::IN_A_PIECE * TrackRecord::LENGTH));
        }
        if let Some(piece) = self.pieces.last_mut() {
            piece.extend_from_slice(&record.values);
            self.count += 1;
        }
    }

    /// The records from index `first` to the end of its block.
    pub fn from(&self, first: usize) -> &[f32] {
        let (piece, before) = (first / Self::IN_A_PIECE, first % Self::IN_A_PIECE);
        self.pieces.get(piece).and_then(|piece| piece.get(before * TrackRecord::LENGTH..)).unwrap_or_default()
    }
}
