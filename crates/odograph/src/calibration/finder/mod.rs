//! Finding a board in an image.

pub(crate) mod ring;
pub(crate) mod subpixel;
#[cfg(test)]
mod tests;
