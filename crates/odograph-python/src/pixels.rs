//! Images as numpy has them.

use crate::error::{Failure, Result};
use numpy::ndarray::{ArrayView, Axis, Dimension, Ix2, Ix3};
use numpy::{PyReadonlyArrayDyn, PyUntypedArray, PyUntypedArrayMethods};
use odograph_core::image::{GrayImage, RgbImage};
use odograph_session::files::{png_from_gray, png_from_rgb};
use odograph_video::{Picture, SampleLayout};
use pyo3::prelude::*;

/// The samples of an image, copied from an array so that the interpreter need not wait.
pub struct Pixels {
    width: usize,
    height: usize,
    layout: SampleLayout,
    samples: Vec<u8>,
}

/// What an image is.
const FORM: &str = "an image is a numpy array of uint8, H×W (gray) or H×W×3 (RGB)";

impl Pixels {
    /// Copies an array of any strides.
    pub fn read(image: &Bound<'_, PyAny>) -> Result<Self> {
        let Ok(array) = image.cast::<PyUntypedArray>() else {
            let class = image.get_type().name()?;
            return Err(Failure::usage(format!("{FORM}; this is a {class}")));
        };
        let shape = || array.shape().iter().map(usize::to_string).collect::<Vec<_>>().join("×");
        let Ok(samples) = array.extract::<PyReadonlyArrayDyn<'_, u8>>() else {
            return Err(Failure::usage(format!("{FORM}; this one is of {}", array.dtype())));
        };
        let view = samples.as_array();
        if let Ok(gray) = view.view().into_dimensionality::<Ix2>() {
            let (height, width) = gray.dim();
            return Ok(Self { width, height, layout: SampleLayout::Gray, samples: copied(gray) });
        }
        match view.into_dimensionality::<Ix3>() {
            Ok(mut colors) if colors.dim().2 == 3 => {
                let (height, width, _) = colors.dim();
                // A view of BGR samples from their ends is the samples in the order of memory.
                let backwards = colors.strides()[2] == -1;
                if backwards {
                    colors.invert_axis(Axis(2));
                }
                let layout = if backwards { SampleLayout::Bgr } else { SampleLayout::Rgb };
                Ok(Self { width, height, layout, samples: copied(colors) })
            }
            _ => Err(Failure::usage(format!("{FORM}; this one is {}", shape()))),
        }
    }

    fn picture(&self) -> odograph_core::Result<Picture> {
        let line = self.width * self.layout.bytes_per_pixel();
        Picture::from_samples(self.layout, self.width, self.height, line, &self.samples, false)
    }

    /// The luminance, as the decoders make it.
    pub fn gray(self) -> odograph_core::Result<GrayImage> {
        match self.layout {
            SampleLayout::Gray => {
                let Self { width, height, samples, .. } = self;
                GrayImage::from_samples(width, height, samples).ok_or_else(|| {
                    odograph_core::Error::usage(format!("an image of {width}x{height} is not usable"))
                })
            }
            _ => Ok(self.picture()?.gray),
        }
    }

    /// The bytes of a PNG file.
    pub fn png(mut self) -> odograph_core::Result<Vec<u8>> {
        // Refuses sizes that cannot be.
        let picture = self.picture()?;
        match self.layout {
            SampleLayout::Gray => return png_from_gray(&picture.gray),
            SampleLayout::Bgr => self.samples.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.swap(0, 2)),
            _ => {}
        }
        let colors = RgbImage::from_samples(self.width, self.height, self.samples);
        png_from_rgb(&colors.unwrap_or_else(|| RgbImage::from(&picture.gray)))
    }
}

/// The samples in row order.
fn copied<D: Dimension + numpy::ndarray::RemoveAxis>(view: ArrayView<'_, u8, D>) -> Vec<u8> {
    if let Some(samples) = view.as_slice() {
        return samples.to_vec();
    }
    let mut samples = Vec::with_capacity(view.len());
    for row in view.outer_iter() {
        match row.as_slice() {
            Some(row) => samples.extend_from_slice(row),
            None => samples.extend(row.iter().copied()),
        }
    }
    samples
}
