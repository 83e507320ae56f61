//! Image folders and single images as sources.

mod decode;
mod exif_data;
mod folder;
mod portable;
mod positions;

pub(crate) use decode::{decode, is_picture};
pub(crate) use folder::{name_of, natural_order, open_folder, open_picture};
pub use positions::picture_fixes;
