//! # odograph in a browser
//!
//! A drive ([`Drive`]) behind functions of the C ABI, which a page calls without generated code.
//! The page writes an argument that is no number at the address that [`input`] returns, and reads
//! a result that is no number at [`output`]. Both are memory of this module: no function reads
//! through an address that the page names.
//!
//! Functions that can fail return 0 and leave a sentence for people in the output.

mod drive;
mod picture;
mod settings;

pub use drive::{Drive, Summary, Taken};
pub use picture::{Layout, Picture};
pub use settings::{Settings, Setup};

use odograph_core::error::{Error, Result};
use odograph_core::mosaic::MosaicSquare;
use std::cell::RefCell;

/// Returned by functions that failed.
const FAILED: u32 = 0;
/// Returned by functions that did what was asked.
const DONE: u32 = 1;
/// Returned where the recording is to be given again from its first frame.
const AGAIN: u32 = 2;

/// A page has one drive at a time.
#[derive(Debug, Default)]
struct Module {
    input: Vec<u8>,
    output: Vec<u8>,
    drive: Option<Drive>,
}

thread_local! {
    static MODULE: RefCell<Module> = RefCell::default();
}

impl Module {
    fn drive(&mut self) -> Result<&mut Drive> {
        self.drive.as_mut().ok_or_else(|| Error::usage("no drive has begun"))
    }

    /// The frame of the last call of [`process`].
    fn last_picture(&mut self, layout: u32, full_range: bool, time_s: f64) -> Result<Taken> {
        let layout =
            Layout::numbered(layout).ok_or_else(|| Error::usage("there is no such layout of pixels"))?;
        let drive = self.drive.as_mut().ok_or_else(|| Error::usage("no drive has begun"))?;
        let picture = Picture::new(layout, full_range, drive.size(), &self.input)?;
        drive.process(picture, time_s)
    }
}

/// Runs `work` and turns an error into a sentence in the output.
fn answering(work: impl FnOnce(&mut Module) -> Result<u32>) -> u32 {
    MODULE.with_borrow_mut(|module| match work(module) {
        Ok(answer) => answer,
        Err(error) => {
            module.output = error.to_string().into_bytes();
            FAILED
        }
    })
}

fn json(value: &impl serde::Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|error| Error::output(error.to_string()))
}

/// The bytes of numbers in the order of WebAssembly, which is little-endian.
fn bytes_of(numbers: impl IntoIterator<Item = f32>) -> Vec<u8> {
    numbers.into_iter().flat_map(f32::to_le_bytes).collect()
}

/// Address of the input, made this long, bytes.
#[unsafe(no_mangle)]
pub extern "C" fn input(length: usize) -> *mut u8 {
    MODULE.with_borrow_mut(|module| {
        module.input.resize(length, 0);
        module.input.as_mut_ptr()
    })
}

/// Address of the output of the last call.
#[unsafe(no_mangle)]
pub extern "C" fn output() -> *const u8 {
    MODULE.with_borrow(|module| module.output.as_ptr())
}

/// Length of the output of the last call, bytes.
#[unsafe(no_mangle)]
pub extern "C" fn output_length() -> usize {
    MODULE.with_borrow(|module| module.output.len())
}

/// Begins a drive with frames of this size, pixels. Input: [`Settings`] as JSON. Output: the
/// [`Setup`] as JSON.
#[unsafe(no_mangle)]
pub extern "C" fn begin(width: usize, height: usize) -> u32 {
    answering(|module| {
        let settings: Settings =
            serde_json::from_slice(&module.input).map_err(|error| Error::usage(error.to_string()))?;
        let (drive, setup) = Drive::begin(&settings, (width, height))?;
        module.drive = Some(drive);
        module.output = json(&setup)?;
        Ok(DONE)
    })
}

/// Takes the next frame. Input: its pixels in a [`Layout`] by its number. Output: the values of
/// [`Taken::record`], `f32`. Where the camera proves to differ from what was assumed, it returns
/// 2, and the output is what was found, a sentence.
#[unsafe(no_mangle)]
pub extern "C" fn process(layout: u32, full_range: bool, time_s: f64) -> u32 {
    answering(|module| match module.last_picture(layout, full_range, time_s)? {
        Taken::Frame(record) => {
            module.output = bytes_of(record);
            Ok(DONE)
        }
        Taken::Again(found) => {
            module.output = found.into_bytes();
            Ok(AGAIN)
        }
    })
}

/// Output: the tracks of the last frame, five `i16` each: where it is, x and y, where its corner is
/// in the keyframe, x and y, quarters of a pixel; and whether it agrees with the motion, 0 or 1.
#[unsafe(no_mangle)]
pub extern "C" fn tracks() -> u32 {
    answering(|module| {
        let tracks = module.drive()?.tracks();
        module.output = tracks.into_iter().flatten().flat_map(i16::to_le_bytes).collect();
        Ok(DONE)
    })
}

/// Output: the mosaic's tiles that have changed since the last call, as JSON.
#[unsafe(no_mangle)]
pub extern "C" fn changed_ground() -> u32 {
    answering(|module| {
        module.output = json(&module.drive()?.changed_ground())?;
        Ok(DONE)
    })
}

/// Output: red, green, blue and opacity of a tile of the mosaic.
#[unsafe(no_mangle)]
pub extern "C" fn tile(column: i32, row: i32) -> u32 {
    answering(|module| {
        let square = MosaicSquare { column: column.into(), row: row.into() };
        let tile = module.drive()?.mosaic().tile_rgba(square);
        module.output = tile.ok_or_else(|| Error::usage("the mosaic has no such tile"))?;
        Ok(DONE)
    })
}

/// Ends the drive: closes its loops and places the mosaic accordingly. Output: the [`Summary`] as
/// JSON. `is_whole` says whether the recording was taken to its end; only then it may return 2, as
/// [`process`] does.
#[unsafe(no_mangle)]
pub extern "C" fn finish(is_whole: bool) -> u32 {
    answering(|module| match module.drive()?.finish(is_whole)? {
        Ok(summary) => {
            module.output = json(&summary)?;
            Ok(DONE)
        }
        Err(found) => {
            module.output = found.into_bytes();
            Ok(AGAIN)
        }
    })
}

/// Output: the records of all frames, `f32`; after [`finish`] in the frame of the map.
#[unsafe(no_mangle)]
pub extern "C" fn records() -> u32 {
    answering(|module| {
        module.output = bytes_of(module.drive()?.records().flatten());
        Ok(DONE)
    })
}

/// Output: the path as `trajectory.tum`.
#[unsafe(no_mangle)]
pub extern "C" fn trajectory_tum() -> u32 {
    answering(|module| {
        module.output = module.drive()?.trajectory_tum().into_bytes();
        Ok(DONE)
    })
}

/// Output: every frame as `trajectory.csv`.
#[unsafe(no_mangle)]
pub extern "C" fn trajectory_csv() -> u32 {
    answering(|module| {
        module.output = module.drive()?.trajectory_csv().into_bytes();
        Ok(DONE)
    })
}

/// Output: width and height of the mosaic, `u32` each, and its red, green, blue and opacity. No
/// side is longer than `longest_px`.
#[unsafe(no_mangle)]
pub extern "C" fn mosaic(longest_px: usize) -> u32 {
    answering(|module| {
        let picture = module.drive()?.mosaic().picture_within(longest_px);
        let picture = picture.ok_or_else(|| Error::input("no ground was seen yet"))?;
        let size = [picture.width, picture.height].map(|side| u32::try_from(side).unwrap_or(u32::MAX));
        module.output = size.into_iter().flat_map(u32::to_le_bytes).chain(picture.rgba).collect();
        Ok(DONE)
    })
}
