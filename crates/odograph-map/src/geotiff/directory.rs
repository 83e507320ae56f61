//! The directories of a BigTIFF in bytes. A cloud-optimised file has them before all pixels, where
//! the `tiff` crate writes them after what they point to.

use tiff::tags::Tag;

/// Byte order, BigTIFF, eight bytes an offset, and where the first directory is.
const HEADER_BYTES: usize = 16;

/// By this GDAL knows how the file is laid out, and reads each tile with its length by one request.
/// It changes the NO if it edits the file, to YES and its line end, for which there is a space.
const LAYOUT: &str = "GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\n\
    LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\n\
    BLOCK_TRAILER=LAST_4_BYTES_REPEATED\nKNOWN_INCOMPATIBLE_EDITION=NO\n ";

/// Values of a tag.
pub(super) enum Values<'a> {
    U16(&'a [u16]),
    U32(&'a [u32]),
    U64(&'a [u64]),
    F64(&'a [f64]),
}

impl Values<'_> {
    /// The number of their type, how many there are, and the values themselves.
    fn encoded(&self) -> (u16, usize, Vec<u8>) {
        match self {
            Self::U16(values) => (3, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Self::U32(values) => (4, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Self::U64(values) => (16, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Self::F64(values) => (12, values.len(), values.iter().flat_map(|v| v.to_le_bytes()).collect()),
        }
    }
}

/// The beginning of a BigTIFF, up to its pixels: the directories one after the other, each followed
/// by those of its values that do not fit into it. Its length depends only on their numbers.
pub(super) fn beginning(directories: Vec<Vec<(Tag, Values<'_>)>>) -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.extend(b"II");
    for word in [43_u16, 8, 0] {
        bytes.extend(word.to_le_bytes());
    }
    let first_directory = (HEADER_BYTES + LAYOUT.len()).next_multiple_of(2);
    bytes.extend((first_directory as u64).to_le_bytes());
    bytes.extend(LAYOUT.bytes());
    bytes.resize(first_directory, 0);
    let last = directories.len() - 1;
    for (k, mut entries) in directories.into_iter().enumerate() {
        entries.sort_by_key(|(tag, _)| tag.to_u16());
        append(&mut bytes, &entries, k == last);
    }
    bytes
}

fn append(bytes: &mut Vec<u8>, entries: &[(Tag, Values<'_>)], is_last: bool) {
    const ENTRY_BYTES: usize = 20;
    let further_at = bytes.len() + 8 + ENTRY_BYTES * entries.len() + 8;
    let mut further = Vec::new();
    bytes.extend((entries.len() as u64).to_le_bytes());
    for (tag, values) in entries {
        let (kind, count, mut encoded) = values.encoded();
        bytes.extend(tag.to_u16().to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend((count as u64).to_le_bytes());
        encoded.resize(encoded.len().next_multiple_of(8), 0);
        if encoded.len() == 8 {
            bytes.extend(encoded);
        } else {
            bytes.extend(((further_at + further.len()) as u64).to_le_bytes());
            further.extend(encoded);
        }
    }
    let next = if is_last { 0 } else { further_at + further.len() };
    bytes.extend((next as u64).to_le_bytes());
    bytes.extend(further);
}
