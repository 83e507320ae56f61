//! Recognising a place: from the picture of a piece of ground to the keyframes that show the same piece.

/// What a picture of the ground is recognised by.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Signature {
    /// The features, in no particular order.
    pub features: Vec<GroundFeature>,
}

/// A spot of the ground that can be told from others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundFeature {
    /// What it looks like, as bits: alike where few differ.
    pub descriptor: [u64; 4],
    /// Where it lies from the point below the camera, metres: in the direction that is up in the image, and to the left.
    pub position_m: [f32; 2],
    /// The direction of its pattern on the ground, counter-clockwise from the direction that is up in the image, radians.
    pub direction_rad: f32,
}
