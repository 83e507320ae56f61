//! Parser of the H.264 sequence parameter set (ITU-T H.264, 7.3.2.1.1 and E.1.1), limited to what
//! is used.

use super::bits::Bits;
use crate::frame::{ColorEncoding, Matrix};
use crate::nal::unescape;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SequenceParameters {
    pub profile: u8,
    pub chroma_format: u32,
    pub bit_depth: u32,
    /// Lossless macroblocks may occur (`qpprime_y_zero_transform_bypass_flag`).
    pub may_be_lossless: bool,
    pub order_count_type: u32,
    pub only_frames: bool,
    pub crops_left_or_top: bool,
    pub coded_width: usize,
    pub coded_height: usize,
    pub encoding: ColorEncoding,
    pub frames_per_second: Option<f64>,
    pub reorder_depth: Option<usize>,
}

impl SequenceParameters {
    /// Parses a NAL unit of type 7, including its header byte.
    pub fn read(unit: &[u8]) -> Option<Self> {
        if unit.first()? & 31 != 7 {
            return None;
        }
        let payload = unescape(&unit[1..]);
        let mut bits = Bits::new(&payload);
        let profile = bits.bits(8)? as u8;
        bits.skip(16)?;
        bits.ue()?;
        let (chroma_format, bit_depth, may_be_lossless) = match profile {
            100 | 110 | 122 | 244 | 44 | 83 | 86 | 118 | 128 | 138 | 139 | 134 | 135 => {
                read_format(&mut bits)?
            }
            _ => (1, 8, false),
        };
        bits.ue()?;
        let order_count_type = read_order_count_type(&mut bits)?;
        bits.ue()?;
        bits.bit()?;
        let coded_width = 16 * (bits.ue()? as usize).checked_add(1)?;
        let map_units = 16 * (bits.ue()? as usize).checked_add(1)?;
        let only_frames = bits.bit()?;
        if !only_frames {
            bits.bit()?;
        }
        bits.bit()?;
        let mut crops_left_or_top = false;
        if bits.bit()? {
            let [left, _, top, _] = [bits.ue()?, bits.ue()?, bits.ue()?, bits.ue()?];
            crops_left_or_top = left > 0 || top > 0;
        }
        let mut read = Self {
            profile,
            chroma_format,
            bit_depth,
            may_be_lossless,
            order_count_type,
            only_frames,
            crops_left_or_top,
            coded_width,
            coded_height: map_units * if only_frames { 1 } else { 2 },
            encoding: ColorEncoding::default(),
            frames_per_second: None,
            reorder_depth: None,
        };
        if bits.bit() == Some(true) {
            // Truncated usability information (VUI) is used as far as it can be read.
            let _ = read.usability(&mut bits);
        }
        Some(read)
    }

    fn usability(&mut self, bits: &mut Bits<'_>) -> Option<()> {
        read_color_encoding(bits, &mut self.encoding)?;
        if bits.bit()? {
            let (ticks, scale) = (bits.bits(32)?, bits.bits(32)?);
            bits.bit()?;
            if ticks > 0 && scale > 0 {
                // One tick is one field; a frame has two.
                self.frames_per_second = Some(f64::from(scale) / (2.0 * f64::from(ticks)));
            }
        }
        let nal = bits.bit()?;
        if nal {
            skip_hypothetical_decoder(bits)?;
        }
        let vcl = bits.bit()?;
        if vcl {
            skip_hypothetical_decoder(bits)?;
        }
        if nal || vcl {
            bits.bit()?;
        }
        bits.bit()?;
        if bits.bit()? {
            bits.bit()?;
            for _ in 0..4 {
                bits.ue()?;
            }
            self.reorder_depth = Some(bits.ue()?.min(16) as usize);
        }
        Some(())
    }

    /// Common name of the profile.
    pub fn profile_name(&self) -> &'static str {
        match self.profile {
            66 => "Baseline",
            77 => "Main",
            88 => "Extended",
            100 => "High",
            110 => "High 10",
            122 => "High 4:2:2",
            244 => "High 4:4:4 Predictive",
            44 => "CAVLC 4:4:4 Intra",
            _ => "another profile",
        }
    }
}

/// Reads the usability information up to the position of the chroma samples, which H.264 and H.265
/// have alike.
pub(super) fn read_color_encoding(bits: &mut Bits<'_>, encoding: &mut ColorEncoding) -> Option<()> {
    if bits.bit()? && bits.bits(8)? == 255 {
        bits.skip(32)?;
    }
    if bits.bit()? {
        bits.bit()?;
    }
    if bits.bit()? {
        bits.skip(3)?;
        encoding.full_range = bits.bit()?;
        if bits.bit()? {
            bits.skip(16)?;
            encoding.matrix = Matrix::from_h273(u64::from(bits.bits(8)?));
        }
    }
    if bits.bit()? {
        bits.ue()?;
        bits.ue()?;
    }
    Some(())
}

/// Reads the chroma format, the bit depth of the luminance, and whether lossless macroblocks may
/// occur, of a profile that states them.
fn read_format(bits: &mut Bits<'_>) -> Option<(u32, u32, bool)> {
    let chroma_format = bits.ue()?;
    if chroma_format == 3 {
        bits.bit()?;
    }
    let bit_depth = bits.ue()?.checked_add(8)?;
    bits.ue()?;
    let may_be_lossless = bits.bit()?;
    if bits.bit()? {
        for list in 0..if chroma_format == 3 { 12 } else { 8 } {
            if bits.bit()? {
                skip_scaling_list(bits, if list < 6 { 16 } else { 64 })?;
            }
        }
    }
    Some((chroma_format, bit_depth, may_be_lossless))
}

fn read_order_count_type(bits: &mut Bits<'_>) -> Option<u32> {
    let order_count_type = bits.ue()?;
    if order_count_type == 0 {
        bits.ue()?;
    } else if order_count_type == 1 {
        bits.bit()?;
        bits.se()?;
        bits.se()?;
        for _ in 0..bits.ue()? {
            bits.se()?;
        }
    }
    Some(order_count_type)
}

fn skip_scaling_list(bits: &mut Bits<'_>, size: u32) -> Option<()> {
    let (mut last, mut next) = (8i32, 8i32);
    for _ in 0..size {
        if next != 0 {
            next = (last.wrapping_add(bits.se()?)).rem_euclid(256);
        }
        last = if next == 0 { last } else { next };
    }
    Some(())
}

fn skip_hypothetical_decoder(bits: &mut Bits<'_>) -> Option<()> {
    let count = bits.ue()?;
    bits.skip(8)?;
    for _ in 0..=count.min(31) {
        bits.ue()?;
        bits.ue()?;
        bits.bit()?;
    }
    bits.skip(20)
}
