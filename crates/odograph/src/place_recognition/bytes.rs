//! Signatures as bytes, as a map file keeps them.

use super::{GroundFeature, MAX_FEATURES, Signature};
use crate::error::{Error, Result};

/// First byte: the version of what follows.
const VERSION: u8 = 1;

/// Version and number of features.
const HEADER_BYTES: usize = 3;

/// Four times 8 bytes of descriptor, three times 4 of position and direction.
const FEATURE_BYTES: usize = 44;

/// No camera sees so much ground from anywhere, metres.
const FURTHEST_M: f32 = 1e5;

impl Signature {
    /// As bytes: version 1, the number of features (2 bytes), then for each the descriptor (4 × 8
    /// bytes), its position (x and y) and its direction (4 bytes each), all little-endian. Features
    /// beyond [`MAX_FEATURES`] are left out.
    pub fn to_bytes(&self) -> Vec<u8> {
        let features = &self.features[..self.features.len().min(MAX_FEATURES)];
        let mut bytes = Vec::with_capacity(HEADER_BYTES + FEATURE_BYTES * features.len());
        bytes.push(VERSION);
        bytes.extend((features.len() as u16).to_le_bytes());
        for feature in features {
            feature.descriptor.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
            let [x, y] = feature.position_m;
            [x, y, feature.direction_rad].iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        }
        bytes
    }

    /// From the bytes of [`Signature::to_bytes`]. Fails where the version is another, the length is
    /// not what the number of features asks for, or a number is not one that a camera over ground
    /// can give.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let [version, low, high, rest @ ..] = bytes else {
            return Err(Error::input(format!(
                "a signature has {} bytes; its header alone has {HEADER_BYTES}, so it was cut off",
                bytes.len()
            )));
        };
        if *version != VERSION {
            return Err(Error::input(format!(
                "a signature has version {version}; this program reads version {VERSION}"
            )));
        }
        let count = usize::from(u16::from_le_bytes([*low, *high]));
        if count > MAX_FEATURES {
            return Err(Error::input(format!(
                "a signature announces {count} features; at most {MAX_FEATURES} are kept, so it is damaged"
            )));
        }
        let (features, beyond) = rest.as_chunks::<FEATURE_BYTES>();
        if features.len() != count || !beyond.is_empty() {
            return Err(Error::input(format!(
                "a signature of {count} features has {} bytes instead of {}",
                bytes.len(),
                HEADER_BYTES + count * FEATURE_BYTES
            )));
        }
        let features = features.iter().enumerate().map(|(number, bytes)| feature(number, bytes));
        Ok(Self { features: features.collect::<Result<_>>()? })
    }
}

fn feature(number: usize, bytes: &[u8; FEATURE_BYTES]) -> Result<GroundFeature> {
    let (words, values) = bytes.split_at(32);
    let (words, values) = (words.as_chunks::<8>().0, values.as_chunks::<4>().0);
    let word = |at: usize| words.get(at).map_or(0, |word| u64::from_le_bytes(*word));
    let value = |at: usize| values.get(at).map_or(0.0, |value| f32::from_le_bytes(*value));
    let feature = GroundFeature {
        descriptor: [word(0), word(1), word(2), word(3)],
        position_m: [value(0), value(1)],
        direction_rad: value(2),
    };
    let [x, y] = feature.position_m;
    let near = |value: f32, most: f32| value.abs() <= most; // not so for NaN
    if !(near(x, FURTHEST_M) && near(y, FURTHEST_M) && near(feature.direction_rad, 7.0)) {
        return Err(Error::input(format!(
            "feature {number} of a signature lies at ({x}, {y}) m, direction {} rad; that is not on the ground below a camera",
            feature.direction_rad
        )));
    }
    Ok(feature)
}
